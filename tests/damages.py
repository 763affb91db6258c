"""Kinds of damage to files, and what is expected where a reader meets them: rows of the tables of `test_damaged_*`."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from readers import READERS, Damage, Usable

from completesplat.errors import CompleteSplatError

WHOLE = {(name, frame) for name in ("a", "b") for frame in range(4)}
"""Frames of the training sequences of `write_co3d`."""


class Refused(NamedTuple):
    """A kind of damage, and the one line with which it is refused.

    Attributes:
        place: file in the input's folder, sequence and frame, with which the line begins; DIR is that folder.
        reason: part of the rest.
        gone: frames of sequence a that are not usable; those of the others all are. None: the row does not say.
        others: how many refusals follow.
    """

    damage: Damage
    kind: type[CompleteSplatError]
    place: str
    reason: str
    gone: list[int] | None = None
    others: int = 0


def content(file: str, data: bytes) -> Damage:
    """Replace the content of a file, or add a file."""
    return lambda folder: (folder / file).write_bytes(data)


def cut(file: str, size: int) -> Damage:
    """Keep the first bytes; a negative size counts from the end."""
    return lambda folder: (folder / file).write_bytes((folder / file).read_bytes()[:size])


def longer(file: str) -> Damage:
    """Add a byte to a file."""
    return lambda folder: (folder / file).write_bytes((folder / file).read_bytes() + b"\0")


def gone(file: str) -> Damage:
    """Remove a file."""
    return lambda folder: (folder / file).unlink()


def replaced(file: str, make: Callable[[Path], object]) -> Damage:
    """Make something else at a file's place."""

    def damage(folder: Path) -> None:
        (folder / file).unlink()
        make(folder / file)

    return damage


def both(first: Damage, second: Damage) -> Damage:
    def damage(folder: Path) -> None:
        first(folder)
        second(folder)

    return damage


def rows(tables: dict[str, list[Refused]]) -> list[object]:
    """Return the parameters `reader` and `expected` of a test."""
    return [
        pytest.param(reader, row, id=f"{reader} {row.place}: {row.reason}")
        for reader, table in tables.items()
        for row in table
    ]


def intact(reader: str, built_once: Callable[[str, Callable], Path]) -> Path:
    """Return the folder of a reader's intact input, which all tests share."""

    def write(folder: Path) -> None:
        (folder / "input").mkdir()
        READERS[reader].write(folder / "input")

    return built_once(f"intact_{reader}", write) / "input"


def must_read_whole(reader: str, built_once: Callable[[str, Callable], Path]) -> None:
    value = READERS[reader].read(intact(reader, built_once))
    assert not isinstance(value, Usable) or value.refused == []


def must_refuse(reader: str, expected: Refused, source: Path, folder: Path) -> None:
    """Damage a copy of an input, and check how it is refused and that nothing else is lost."""
    shutil.copytree(source, folder, symlinks=True)
    expected.damage(folder)
    frames = None
    try:
        usable = READERS[reader].read(folder)
        assert isinstance(usable, Usable), "the damage was not noticed"
        refused = usable.refused
        frames = usable.frames
    except CompleteSplatError as error:
        refused = [error]
    assert len(refused) == 1 + expected.others
    message = str(refused[0])
    assert "\n" not in message
    message = message.replace(f"{folder}/", "").replace(str(folder), "DIR")
    assert message.startswith(f"{expected.place}: " if expected.place else "")
    assert expected.reason in message
    assert isinstance(refused[0], expected.kind)
    if expected.gone is not None:
        assert frames == WHOLE - {("a", frame) for frame in expected.gone}
