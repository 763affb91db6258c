"""Memory-mapped Arrow files, whose rows are parsed when they are read."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa

from completesplat.errors import UnreadableFile


class OpenShard:
    """Memory-mapped Arrow file, each record batch of which is one row.

    Arrow's description of a parsed batch takes 8 kB, or half a gigabyte in every process for all RealEstate10K clips.

    Args:
        advice: end of the message about a damaged file.

    Raises:
        UnreadableFile: the file is damaged.
    """

    def __init__(self, path: Path, advice: str = "") -> None:
        self._advice = advice
        self.places: list[int] = []
        with refused_as_damaged(advice):
            with pa.memory_map(str(path)) as file:
                self._content = file.read_buffer()  # not a copy; the file itself need not stay open
            stream = pa.BufferReader(self._content)
            self.schema = pa.ipc.read_schema(stream)
            place = stream.tell()
            while place < self._content.size:
                try:
                    pa.ipc.read_message(stream)
                except EOFError:  # the end-of-stream mark
                    break
                self.places.append(place)
                place = stream.tell()

    def __getitem__(self, row: int) -> pa.Table:
        """Return one row, whose values are in the file's memory.

        Raises:
            UnreadableFile: the row is damaged.
        """
        with refused_as_damaged(self._advice):
            stream = pa.BufferReader(self._content)
            stream.seek(self.places[row])
            table = pa.Table.from_batches([pa.ipc.read_record_batch(pa.ipc.read_message(stream), self.schema)])
            table.validate(full=True)  # Without this check, damaged offsets could crash the process.
        return table


@contextmanager
def refused_as_damaged(advice: str = "") -> Iterator[None]:
    """Turn the errors by which Arrow and NumPy notice damage into an UnreadableFile with some advice."""
    try:
        yield
    except (pa.ArrowException, OSError, ValueError, LookupError, AttributeError) as error:
        raise UnreadableFile(f"damaged, or not an Arrow file ({error}){advice}") from None
