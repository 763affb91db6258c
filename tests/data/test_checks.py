"""JSON files and paths that are refused, and those that are not."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from completesplat.data import validation
from completesplat.data.validation import (
    BadAnnotation,
    BadCamera,
    MissingFile,
    OutsidePath,
    UnreadableFile,
    field,
    finite_array,
    inside,
    read_json,
    require_rotation,
)

CONTENT = [{"name": "Bär", "numbers": [1, 2.5, None]}] * 50
TEXT = json.dumps(CONTENT, ensure_ascii=False).encode()


def flipped(position: int) -> bytes:
    """Gzipped, with a byte changed: the first one behind gzip's header is a type of block, the last are checksums."""
    packed = bytearray(gzip.compress(TEXT))
    packed[position] ^= 7 ^ packed[10] if position == 10 else 1
    return bytes(packed)


# name: (file name, content, part of the message)
BAD: dict[str, tuple[str, bytes, str]] = {
    "empty": ("a.json", b"", "Expecting value"),
    "two_values": ("a.json", b"[1][2]", "Extra data"),
    "nan": ("a.json", b'{"x": NaN}', "NaN is no JSON"),
    "latin_1": ("a.json", TEXT.decode().encode("latin-1"), "utf-8"),
    "deep_lists": ("a.json", b"[" * 10**5 + b"]" * 10**5, "recursion"),
    "huge_integer": ("a.json", b"1" * 10**4, "not a JSON file"),
    "empty_gzip": ("a.jgz", b"", "not a JSON file"),
    "not_gzipped": ("a.jgz", TEXT, "Not a gzipped file"),
    "cut_gzip": ("a.jgz", gzip.compress(TEXT)[:-12], "not a JSON file"),
    "gzip_with_wrong_checksum": ("a.jgz", flipped(-6), "CRC check failed"),
    "broken_deflate": ("a.jgz", flipped(10), "invalid block type"),
    "trailing_garbage": ("a.jgz", gzip.compress(TEXT) + b"garbage", "Not a gzipped file"),
    "gzipped_nan": ("a.jgz", gzip.compress(b"[NaN]"), "NaN is no JSON"),
    "gzip_bomb": ("a.jgz", gzip.compress(b"[" + b" " * 2**27 + b"]"), "hold more than"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_by_name(name, tmp_path):
    file, content, part = BAD[name]
    (tmp_path / file).write_bytes(content)
    with pytest.raises(UnreadableFile) as caught:
        read_json(tmp_path / file)
    assert caught.value.file == str(tmp_path / file)
    assert part in caught.value.reason


def test_good_files_are_read(tmp_path):
    (tmp_path / "a.json").write_bytes(TEXT)
    (tmp_path / "a.jgz").write_bytes(gzip.compress(TEXT[:100]) + gzip.compress(TEXT[100:]))
    assert read_json(tmp_path / "a.json") == read_json(tmp_path / "a.jgz") == CONTENT
    (tmp_path / "nan.json").write_text("[NaN]")
    assert np.isnan(read_json(tmp_path / "nan.json", allow_nan=True)[0])


@pytest.mark.parametrize("file", ["a.json", "a.jgz"])
def test_the_limit_on_bytes_is_on_the_text(tmp_path, file, monkeypatch):
    (tmp_path / file).write_bytes(gzip.compress(TEXT) if file == "a.jgz" else TEXT)
    monkeypatch.setattr(validation, "MOST_BYTES", len(TEXT))
    assert read_json(tmp_path / file) == CONTENT
    monkeypatch.setattr(validation, "MOST_BYTES", len(TEXT) - 1)
    with pytest.raises(UnreadableFile, match=f"more than {len(TEXT) - 1:,} bytes"):
        read_json(tmp_path / file)


def test_missing_files_are_refused(tmp_path):
    for path in (tmp_path / "a.json", tmp_path / "a.jgz", tmp_path):
        with pytest.raises(MissingFile):
            read_json(path)


@pytest.mark.parametrize(
    "relative", ["../a", "a/../../b", "/a", "C:/a", "\\\\server\\a", "a\\..\\b", "file:///a", "a\0", "", "."]
)
def test_paths_that_are_not_plainly_below_the_root_are_refused(tmp_path, relative):
    with pytest.raises(OutsidePath):
        inside(tmp_path, relative)


@pytest.fixture
def linked(tmp_path: Path) -> Path:
    root = tmp_path / "root"
    (root / "a").mkdir(parents=True)
    (tmp_path / "root_of_others").mkdir()
    (root / "out").symlink_to(tmp_path)
    (root / "sibling").symlink_to(tmp_path / "root_of_others")
    (root / "hop").symlink_to("out")
    (root / "within").symlink_to("a")
    (root / "ring").symlink_to("ring")
    (tmp_path / "alias").symlink_to(root)
    return root


@pytest.mark.parametrize("relative", ["out", "sibling/x.png", "hop/x.png", "within/../out/x"])
def test_links_that_leave_the_root_are_refused(linked, relative):
    with pytest.raises(OutsidePath):
        inside(linked, relative)


@pytest.mark.parametrize("relative", ["a/x.png", "within/x.png", "not_there/x.png", "...", "a/..x", "ring"])
def test_paths_below_the_root_are_taken_also_where_the_root_is_a_link(linked, relative):
    assert inside(linked, relative) == linked / relative
    assert inside(linked.parent / "alias", relative) == linked.parent / "alias" / relative


def test_fields_have_exactly_the_asked_type():
    assert field({"n": 3}, "n", int) == 3
    for entry in ({"n": True}, {"n": 3.0}, {"n": None}, {}, None, [3]):
        with pytest.raises(BadAnnotation, match="n"):
            field(entry, "n", int)


def test_arrays_are_finite_numbers_of_the_asked_shape():
    assert finite_array([[1, 2.5]], (1, 2), "x").tolist() == [[1.0, 2.5]]
    for value in ([1, 2.5], [[1, "2"]], [[1, None]], [[1, float("nan")]], [[1, float("inf")]], [[1], [2, 3]], None, {}):
        with pytest.raises(BadAnnotation, match="x"):
            finite_array(value, (1, 2), "x")


def test_rotations_may_be_off_by_rounding_only():
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    require_rotation(rotation.astype(np.float32).astype(np.float64), "R")
    require_rotation(rotation * 1.0004, "R")
    for matrix, part in ((rotation * 1.0006, "orthonormal"), (-rotation, "reflection"), (rotation * 0, "orthonormal")):
        with pytest.raises(BadCamera, match=part):
            require_rotation(matrix, "R")
