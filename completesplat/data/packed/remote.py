"""A packed store behind an address (http, https, s3, gs, hf, ...): fsspec fetches a shard when it is first read.

What was fetched lies in a folder of this machine, and is read from there as any packed store, memory-mapped.
"""

import hashlib
import os
from pathlib import Path

from filelock import FileLock

from completesplat.atomic import atomic_path
from completesplat.data.packed.manifest import MANIFEST, Shard
from completesplat.data.validation import ChangedFile, MissingFile
from completesplat.weights import sha256_of

ADDRESS = "address.txt"


def local_root(root: str) -> Path:
    """The folder itself; of an address its folder on this machine, below `COMPLETESPLAT_CACHE`, with the manifest.

    A store that was made anew at the same address gets another folder. `DataError`: nothing can be fetched from there.
    """
    if "://" not in root:
        return Path(root)
    place = os.environ.get("COMPLETESPLAT_CACHE", "~/.cache/completesplat")
    folder = Path(place).expanduser() / "stores" / _digest(root.encode())
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / ".lock"):
        _get(root, MANIFEST, folder / MANIFEST)
        store = folder / _digest((folder / MANIFEST).read_bytes())
        store.mkdir(exist_ok=True)
        for name, content in ((ADDRESS, root.encode()), (MANIFEST, (folder / MANIFEST).read_bytes())):
            with atomic_path(store / name) as temporary:
                temporary.write_bytes(content)
    return store


def address_of(root: Path) -> str | None:
    """Where a folder's shards are fetched from; None for a store that was made or copied here."""
    return (root / ADDRESS).read_text() if (root / ADDRESS).is_file() else None


def fetched(address: str, shard: Shard, path: Path) -> Path:
    """The file of a shard, here, which one of several processes fetches whole while the others wait for it.

    Raises:
        MissingFile: it cannot be fetched.
        ChangedFile: it is not the one that the manifest names.
    """
    if path.is_file():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{path.name}.lock")):
        if not path.is_file():
            with atomic_path(path, size=shard.bytes) as temporary:
                _get(address, shard.file, temporary)
                if sha256_of(temporary) != shard.sha256:
                    raise ChangedFile("its checksum is not that of the manifest", f"{address}/{shard.file}")
    return path


def _get(address: str, name: str, path: Path) -> None:
    import fsspec  # takes its time

    try:
        files, folder = fsspec.core.url_to_fs(address.rstrip("/"))
        files.get_file(f"{folder}/{name}", str(path))
    except Exception as error:  # each kind of store has its own
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MissingFile(f"cannot be fetched ({reason})", f"{address}/{name}") from error


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
