"""Reader of a packed store, which maps a shard into memory when one of its sequences is read."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from completesplat.data.packed.manifest import MANIFEST, Shard, read_manifest
from completesplat.data.packed.remote import address_of, fetched
from completesplat.data.packed.rows import features, from_row
from completesplat.data.sequences import PosedSequence, SequenceSource
from completesplat.data.validation import BadAnnotation, ChangedFile, UnreadableFile, at, inside, require_file
from completesplat.errors import DataError
from completesplat.weights import sha256_of


class PackedSource(SequenceSource):
    """One split of a packed store, with images of `image_size` (None: the size that they are stored in).

    Raises:
        DataError: the split does not exist, the manifest is malformed, or a shard is missing or has another size.
    """

    def __init__(self, root: Path, split: str, image_size: int | None = None) -> None:
        splits = read_manifest(root).splits
        if split not in splits:
            there = ", ".join(splits) or "none"
            raise DataError(f"no split {split} in this packed store; there are: {there}", str(root))
        entry = splits[split]
        self.root = root
        self.image_size = image_size
        self.shards = entry.shards
        self.names = list(entry.names)
        self.refused: list[DataError] = []
        self.left_out: dict[str, list[str]] = {}
        self.listed = entry.listed
        self._fingerprint = entry.fingerprint
        self._places = {
            name: (number, row) for number, shard in enumerate(self.shards) for row, name in enumerate(shard.sequences)
        }
        self._opened: dict[int, OpenShard] = {}
        self.address = address_of(root)
        with at(file=root / MANIFEST):
            for shard in self.shards:
                path = inside(root, shard.file)
                if self.address is not None and not path.is_file():
                    continue
                size = require_file(path).stat().st_size
                if size != shard.bytes:
                    reason = f"{size:,} bytes, {shard.bytes:,} were written: prepare again into the same folder"
                    raise ChangedFile(reason, str(path))

    def read(self, name: str) -> PosedSequence:
        """Read one sequence, unless its shard is damaged; its images are decoded one by one when they are read."""
        number, row = self._places[name]
        shard = self.shards[number]
        path = self.root / shard.file
        if number not in self._opened:
            with at(sequence=name):
                if self.address is not None:
                    fetched(self.address, shard, path)
                self._opened[number] = open_shard(path, shard)
        with at(file=path, sequence=name):
            try:
                table = self._opened[number][row]
            except (pa.ArrowException, OSError, ValueError) as error:
                raise UnreadableFile(f"damaged ({error})") from None
        return from_row(table, str(path), name, self.image_size)

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
        """Read all shards of this split and return those whose checksum differs from the manifest's."""
        reason = "its checksum is no longer that of the manifest: remove it and prepare again into the same folder"
        paths = {require_file(self.root / shard.file): shard.sha256 for shard in self.shards}
        return [ChangedFile(reason, str(path)) for path, checksum in paths.items() if sha256_of(path) != checksum]

    def __getstate__(self) -> dict[str, Any]:
        # Worker processes open the files themselves and share their memory pages.
        return {**self.__dict__, "_opened": {}}


class OpenShard:
    """Memory-mapped shard, whose rows are record batches that are parsed when they are read.

    Arrow's description of a parsed batch takes 8 kB, or half a gigabyte in every process for all RealEstate10K clips.

    Raises:
        ArrowException, OSError: the file is damaged.
    """

    def __init__(self, path: Path) -> None:
        with pa.memory_map(str(path)) as file:
            self._content = file.read_buffer()  # not a copy; the file itself need not stay open
        stream = pa.BufferReader(self._content)
        self.schema = pa.ipc.read_schema(stream)
        self._places: list[int] = []
        while (place := stream.tell()) < self._content.size:
            try:
                pa.ipc.read_message(stream)
            except EOFError:  # the end-of-stream mark
                break
            self._places.append(place)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, row: int) -> pa.Table:
        """Return a table of one row."""
        stream = pa.BufferReader(self._content)
        stream.seek(self._places[row])
        return pa.Table.from_batches([pa.ipc.read_record_batch(pa.ipc.read_message(stream), self.schema)])


def open_shard(path: Path, shard: Shard) -> OpenShard:
    """Open a shard, which has one row for each sequence, after a check of its columns and number of rows."""
    with at(file=path):
        try:
            opened = OpenShard(require_file(path))
        except (pa.ArrowException, OSError, ValueError) as error:
            raise UnreadableFile(f"not a readable Arrow file ({error})") from None
        if not opened.schema.equals(features().arrow_schema):
            raise UnreadableFile("its columns are not those of a packed store")
        if len(opened) != len(shard.sequences):
            raise BadAnnotation(f"{len(opened)} sequences, the manifest says {len(shard.sequences)}")
        return opened
