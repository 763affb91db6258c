"""Reading back what an offline run left for Weights & Biases."""

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from support import waited_for

BLOCK, FILE_HEADER, CHUNK_HEADER = 2**15, 7, 7
TYPES = {"image": "image-file", "video": "video-file"}


@dataclass(frozen=True)
class OfflineRun:
    """A run's own file, and the folder that it is in."""

    folder: Path
    records: list[Any]

    def only(self, kind: str) -> Any:
        """The one record of a kind (`run`, `exit`)."""
        (result,) = (getattr(record, kind) for record in self.records if record.WhichOneof("record_type") == kind)
        return result

    @property
    def history(self) -> list[dict[str, Any]]:
        """The rows that were logged."""
        rows = [record.history.item for record in self.records if record.WhichOneof("record_type") == "history"]
        return [{"/".join(i.nested_key) or i.key: json.loads(i.value_json) for i in items} for items in rows]

    def merged(self) -> dict[str, Any]:
        """The last value of each key."""
        return {key: value for row in self.history for key, value in row.items()}


def offline_runs(out: Path) -> list[OfflineRun]:
    """The runs of a run directory in their order; one that was continued has several."""
    return [_finished(path) for path in sorted(out.glob("wandb/offline-run-*/run-*.wandb"))]


def _finished(path: Path) -> OfflineRun:
    """W&B's process may write the file a moment after the run was closed."""
    from wandb.proto.wandb_internal_pb2 import Record

    def records() -> list[Any]:
        return [Record.FromString(record) for record in raw_records(path.read_bytes())]

    ended = lambda: any(record.WhichOneof("record_type") == "exit" for record in records())  # noqa: E731
    assert waited_for(ended), f"{path} has no end"
    return OfflineRun(path.parent, records())


def raw_records(data: bytes) -> Iterator[bytes]:
    """LevelDB's log format (blocks of chunks with checksum, length, kind)."""
    position, record = FILE_HEADER, b""
    while position + CHUNK_HEADER <= len(data):
        if BLOCK - position % BLOCK < CHUNK_HEADER:  # The rest of a block is filled up.
            position += BLOCK - position % BLOCK
            continue
        _, length, kind = struct.unpack_from("<IHB", data, position)
        record += data[position + CHUNK_HEADER : position + CHUNK_HEADER + length]
        position += CHUNK_HEADER + length
        if kind in (1, 4):  # The whole of a record, or the last part of it.
            yield record
            record = b""


def logged(values: dict[str, Any], keys: str, kind: str) -> set[str]:
    """Return the keys of this kind that match the pattern `keys` (`*` stands for anything)."""
    if kind == "number":
        return {key for key, x in values.items() if fnmatchcase(key, keys) and isinstance(x, float | int)}
    types = {key.removesuffix("/_type"): x for key, x in values.items() if key.endswith("/_type")}
    return {key for key, x in types.items() if fnmatchcase(key, keys) and x == TYPES[kind]}
