"""Files appear whole or not at all, and a disk that refuses is named."""

import errno
from pathlib import Path
from unittest.mock import Mock

import pytest

from completesplat import files
from completesplat.errors import CompleteSplatError, DiskError


def test_a_written_file_replaces_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    for text in ("one", "two ±"):
        files.write_text(path, text)
        assert path.read_text(encoding="utf-8") == text
    assert list(path.parent.iterdir()) == [path]


def test_an_exception_leaves_the_old_file_unchanged_and_no_unfinished_one(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError) as caught, files.atomic_path(path) as temporary:
        raise ZeroDivisionError(temporary.parent, temporary.suffix, temporary.write_text("ne"))
    assert caught.value.args[:2] == (path.parent, ".txt")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["x.txt", ".x.txt.unfinished"])
def test_a_link_at_the_path_of_a_file_or_of_its_unfinished_version_is_replaced(tmp_path: Path, name: str) -> None:
    target = tmp_path / "target"
    target.write_text("kept")
    (tmp_path / name).symlink_to(target)
    with files.atomic_path(tmp_path / "x.txt", ".x.txt.unfinished") as temporary:
        temporary.write_text("new")
    assert (target.read_text(), (tmp_path / "x.txt").read_text()) == ("kept", "new")
    assert not (tmp_path / "x.txt").is_symlink()


def test_a_folder_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "folder").symlink_to("elsewhere")
    with pytest.raises(CompleteSplatError, match="folder: is a link, and results are not written through links"):
        files.make_folder(tmp_path / "folder")


def test_only_errors_about_unusable_file_names_become_refusals(tmp_path: Path) -> None:
    for name, message in (("x" * 5000, "name too long"), (f"{tmp_path}", "exists"), (f"{__file__}/x", "Not a dir")):
        with pytest.raises(OSError, match=message) as caught:
            Path(name).mkdir()
        assert str(files.file_refusal(caught.value)).startswith(name[:200])
    assert files.file_refusal(FileNotFoundError(2, "No such file", "x")) is None
    assert files.file_refusal(ValueError("x")) is None


def test_a_disk_that_fails_is_named_by_the_users_file_even_if_the_unfinished_one_cannot_be_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = OSError(errno.EROFS, "Read-only file system")
    monkeypatch.setattr(Path, "unlink", Mock(side_effect=failed))
    with pytest.raises(DiskError, match=r"x\.txt: cannot be written") as caught:
        files.write_text(tmp_path / "x.txt", "a")
    assert ".x" not in str(caught.value).removeprefix(str(tmp_path))
