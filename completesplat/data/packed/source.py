"""Reader of a packed store, in a folder or behind an address (http, https, s3, gs, hf, ...).

A shard is mapped into memory when one of its sequences is read. From an address, fsspec fetches it into a local folder.
"""

import hashlib
import logging
import os
from collections.abc import Sequence
from pathlib import Path

from filelock import FileLock

from completesplat.data.packed.manifest import MANIFEST, Shard, read_manifest
from completesplat.data.packed.rows import SCHEMA, from_row
from completesplat.data.packed.shards import OpenShard
from completesplat.data.sequences import PosedSequence, SequenceSource
from completesplat.data.validation import path_below, require_file
from completesplat.errors import BadAnnotation, ChangedFile, DataError, MissingFile, UnreadableFile, errors_at
from completesplat.files import atomic_path, home_path, user_cache, write_bytes
from completesplat.weights import sha256_of

ADDRESS = "address.txt"
logger = logging.getLogger(__name__)


def local_root(root: str) -> Path:
    """Return a local folder as it is. For an address, fetch the manifest into a folder below `COMPLETESPLAT_CACHE`.

    A store that was made again at the same address gets another folder, which depends on the manifest's digest.

    Raises:
        DataError: nothing can be fetched from the address.
    """
    if "://" not in root:
        return Path(root)
    place = os.environ.get("COMPLETESPLAT_CACHE")
    folder = (home_path(place) if place else user_cache()) / "stores" / _digest(root.encode())
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / ".lock"):
        try:
            with atomic_path(folder / MANIFEST) as temporary:
                _get(root, MANIFEST, temporary)
        except MissingFile as error:
            if not (folder / MANIFEST).is_file():
                raise
            logger.warning("%s; the manifest fetched before is used", error)
        manifest = (folder / MANIFEST).read_bytes()
        store = folder / _digest(manifest)
        store.mkdir(exist_ok=True)
        write_bytes(store / ADDRESS, root.encode())
        write_bytes(store / MANIFEST, manifest)
    return store


def _fetch(address: str, shard: Shard, path: Path) -> None:
    """Fetch a shard if its local file is missing. One process fetches it, and all that need it wait.

    Raises:
        MissingFile: the shard cannot be fetched.
        ChangedFile: its checksum differs from the manifest's.
    """
    if path.is_file():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{path.name}.lock")):
        if not path.is_file():
            with atomic_path(path) as temporary:
                _get(address, shard.file, temporary)
                if sha256_of(temporary) != shard.sha256:
                    raise ChangedFile("its checksum is not that of the manifest", f"{address}/{shard.file}")


def _get(address: str, name: str, path: Path) -> None:
    import fsspec  # a slow import

    try:
        files, folder = fsspec.core.url_to_fs(address.rstrip("/"))
        files.get_file(f"{folder}/{name}", str(path))
    except Exception as error:  # each kind of store raises other exceptions
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MissingFile(f"cannot be fetched ({reason})", f"{address}/{name}") from error


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


class PackedSource(SequenceSource):
    """One split of a packed store, with images of `image_size` (None: the size that they are stored in).

    Raises:
        DataError: the split does not exist, the manifest is malformed, or a shard is missing or has another size.
    """

    def __init__(self, root: Path, split: str, image_size: int | None = None) -> None:
        splits = read_manifest(root).splits
        if split not in splits:
            raise DataError(f"no split {split} in this packed store; there are: {', '.join(splits)}", str(root))
        entry = splits[split]
        super().__init__(list(entry.names), entry.listed, [], {})
        self.root = root
        self.image_size = image_size
        self.shards = entry.shards
        self._fingerprint = entry.fingerprint
        self._places: dict[str, tuple[int, int]] = {}
        for number, shard in enumerate(self.shards):
            for row, name in enumerate(shard.sequences):
                self._places[name] = (number, row)
        self._opened: dict[int, OpenShard] = {}
        address = root / ADDRESS
        # None: the store was made or copied here.
        self.address = address.read_text() if address.is_file() else None
        with errors_at(file=root / MANIFEST):
            for shard in self.shards:
                path = path_below(root, shard.file)
                if self.address is not None and not path.is_file():
                    continue  # it is fetched when it is read
                size = require_file(path).stat().st_size
                if size != shard.bytes:
                    reason = f"{size:,} bytes, {shard.bytes:,} were written: prepare again into the same folder"
                    raise ChangedFile(reason, str(path))

    def read(self, name: str) -> PosedSequence:
        """Read one sequence, unless its shard is damaged. Its images are decoded one by one when they are read."""
        number, row = self._places[name]
        path = self.root / self.shards[number].file
        with errors_at(file=path, sequence=name):
            table = self._shard(number, path)[row]
        return from_row(table, str(path), name, self.image_size)

    def _shard(self, number: int, path: Path) -> OpenShard:
        if number not in self._opened:
            shard = self.shards[number]
            if self.address is not None:
                _fetch(self.address, shard, path)
            opened = OpenShard(require_file(path))
            if not opened.schema.equals(SCHEMA):
                raise UnreadableFile("its columns are not those of a packed store")
            if len(opened.places) != len(shard.sequences):
                raise BadAnnotation(f"{len(opened.places)} sequences, the manifest says {len(shard.sequences)}")
            self._opened[number] = opened
        return self._opened[number]

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        """Group sequences by shard if shards have to be fetched, so that training can start after the first one."""
        if self.address is None:
            return super().groups(names)
        groups: dict[int, list[int]] = {}
        for index, name in enumerate(names):
            groups.setdefault(self._places[name][0], []).append(index)
        return list(groups.values())

    def fingerprint(self) -> str:
        """Return the fingerprint of the source that the store was made from."""
        return self._fingerprint

    def verify(self) -> list[ChangedFile]:
        """Read all shards of this split that are on this machine, and return those that changed."""
        reason = "its checksum is no longer that of the manifest: remove it and prepare again into the same folder"
        changed = []
        for shard in self.shards:
            path = self.root / shard.file
            if self.address is not None and not path.exists():
                continue
            if sha256_of(require_file(path)) != shard.sha256:
                changed.append(ChangedFile(reason, str(path)))
        return changed

    def __getstate__(self) -> dict[str, object]:
        # Worker processes open the files themselves and share their memory pages.
        return {**self.__dict__, "_opened": {}}
