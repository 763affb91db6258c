"""Files that appear whole or not at all."""

from pathlib import Path

import pytest

from completesplat.atomic import atomic_path, write_text


def test_a_file_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    for text in ("one", "two ±"):
        write_text(path, text)
        assert path.read_text(encoding="utf-8") == text
    assert list(path.parent.iterdir()) == [path]


def test_after_an_exception_the_old_file_is_as_it_was_and_nothing_lies_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError) as caught, atomic_path(path) as temporary:
        raise ZeroDivisionError(temporary.parent, temporary.suffix, temporary.write_text("ne"))
    assert caught.value.args[:2] == (path.parent, ".txt")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
