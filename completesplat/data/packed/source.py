"""Reading a packed store: opened by its manifest, memory-mapped shard by shard when a sequence is read."""

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
    """One split of a packed store; what was refused while it was made is in its manifest.

    `DataError` if there is no such split, or for a malformed manifest, or a shard that is missing or of another size.
    """

    def __init__(self, root: Path, split: str) -> None:
        splits = read_manifest(root).splits
        if split not in splits:
            there = ", ".join(splits) or "none"
            raise DataError(f"no split {split} in this packed store; there are: {there}", str(root))
        entry = splits[split]
        self.root = root
        self.shards = entry.shards
        self.names = list(entry.names)
        self.refused: list[DataError] = []
        self.left_out: dict[str, list[str]] = {}
        self.listed = entry.listed
        self._fingerprint = entry.fingerprint
        self._places = {
            name: (number, row) for number, shard in enumerate(self.shards) for row, name in enumerate(shard.sequences)
        }
        self._opened: dict[int, Any] = {}
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
        """One sequence; its pictures are decoded one by one when they are read. `DataError` if its shard is damaged."""
        number, row = self._places[name]
        shard = self.shards[number]
        path = self.root / shard.file
        if number not in self._opened:
            with at(sequence=name):
                if self.address is not None:
                    fetched(self.address, shard, path)
                self._opened[number] = open_shard(path, shard)
        return from_row(self._opened[number][row], str(path), name)

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        """Shard by shard where they have to be fetched: training starts with the first one. Else in any order."""
        if self.address is None:
            return super().groups(names)
        groups: dict[int, list[int]] = {}
        for index, name in enumerate(names):
            groups.setdefault(self._places[name][0], []).append(index)
        return list(groups.values())

    def fingerprint(self) -> str:
        """That of the source which the store was made from."""
        return self._fingerprint

    def verify(self) -> list[ChangedFile]:
        """The shards of this split that are no longer those whose checksums are in the manifest; reads all of them."""
        reason = "its checksum is no longer that of the manifest: remove it and prepare again into the same folder"
        paths = {require_file(self.root / shard.file): shard.sha256 for shard in self.shards}
        return [ChangedFile(reason, str(path)) for path, checksum in paths.items() if sha256_of(path) != checksum]

    def __getstate__(self) -> dict[str, Any]:
        # Worker processes open the files themselves and share their pages.
        return {**self.__dict__, "_opened": {}}


def open_shard(path: Path, shard: Shard) -> Any:
    """A memory-mapped `datasets.Dataset`, one row a sequence; `DataError` if missing, damaged or not as expected."""
    from datasets import Dataset  # See `features`.

    with at(file=path):
        try:
            dataset = Dataset.from_file(str(require_file(path)))
        # A damaged header may fail in the library's own reading of it too: KeyError, TypeError, JSON errors, ...
        except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise UnreadableFile(f"not a readable Arrow file ({error})") from None
        if dataset.features != features() or dataset.data.schema.types != features().arrow_schema.types:
            raise UnreadableFile("its columns are not those of a packed store")
        if len(dataset) != len(shard.sequences):
            raise BadAnnotation(f"{len(dataset)} sequences, the manifest says {len(shard.sequences)}")
        return dataset.with_format("arrow")
