import gzip
import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from completesplat.data import validation
from completesplat.data.validation import field, finite_array, path_below, read_json, read_text, require_rotation
from completesplat.errors import BadAnnotation, BadCamera, MissingFile, OutsidePath, UnreadableFile

CONTENT = [{"name": "Bär", "numbers": [1, 2.5, None]}] * 50
TEXT = json.dumps(CONTENT, ensure_ascii=False).encode()


# name: (file name, content, part of the message)
BAD: dict[str, tuple[str, bytes, str]] = {
    "empty": ("a.json", b"", "Expecting value"),
    "nan": ("a.json", b'{"x": NaN}', "NaN is no JSON"),
    "latin_1": ("a.json", TEXT.decode().encode("latin-1"), "utf-8"),
    "deep_lists": ("a.json", b"[" * 10**5 + b"]" * 10**5, "recursion"),
    "not_gzipped": ("a.jgz", TEXT, "Not a gzipped file"),
    "cut_gzip": ("a.jgz", gzip.compress(TEXT)[:-12], "not a JSON file"),
    "gzip_bomb": ("a.jgz", gzip.compress(b"[" + b" " * 2**27 + b"]"), "hold more than"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_by_name(name, tmp_path):
    file, content, part = BAD[name]
    (tmp_path / file).write_bytes(content)
    tracemalloc.start()
    with pytest.raises(UnreadableFile) as caught:
        read_json(tmp_path / file)
    assert tracemalloc.get_traced_memory()[1] < 2**26  # the limit of a bomb is 2^24 bytes
    tracemalloc.stop()
    assert caught.value.file == str(tmp_path / file)
    assert part in caught.value.reason


def test_good_files_are_read_up_to_a_limit_on_the_bytes_of_their_text_and_missing_ones_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(validation, "MOST_BYTES", len(TEXT))
    (tmp_path / "a.json").write_bytes(TEXT)
    (tmp_path / "a.jgz").write_bytes(gzip.compress(TEXT[:100]) + gzip.compress(TEXT[100:]))
    assert read_json(tmp_path / "a.json") == read_json(tmp_path / "a.jgz") == CONTENT
    monkeypatch.setattr(validation, "MOST_BYTES", len(TEXT) + 3)
    (tmp_path / "mark.json").write_bytes(b"\xef\xbb\xbf" + TEXT)
    assert read_json(tmp_path / "mark.json") == json.loads(read_text(tmp_path / "mark.json")) == CONTENT
    (tmp_path / "nan.json").write_text("[NaN]")
    assert np.isnan(read_json(tmp_path / "nan.json", allow_nan=True)[0])
    monkeypatch.setattr(validation, "MOST_BYTES", len(TEXT) - 1)
    for file in ("a.json", "a.jgz"):
        with pytest.raises(UnreadableFile, match=f"more than {len(TEXT) - 1:,} bytes"):
            read_json(tmp_path / file)
    for path in (tmp_path / "b.json", tmp_path / "b.jgz", tmp_path):
        with pytest.raises(MissingFile):
            read_json(path)


@pytest.mark.parametrize(
    "relative", ["../a", "a/../../b", "/a", "C:/a", "\\\\server\\a", "..\\b", "a\\..\\b", "file:///a", "a\0", "", "."]
)
def test_paths_that_are_not_plainly_below_the_root_are_refused(tmp_path, relative):
    with pytest.raises(OutsidePath):
        path_below(tmp_path, relative)


def test_backslashes_are_separators_and_absolute_paths_may_lead_inside(tmp_path: Path, monkeypatch):
    (tmp_path / "link").symlink_to(tmp_path / "root")
    (tmp_path / "root/a").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    for root in (tmp_path / "root", tmp_path / "link", Path("link")):
        assert path_below(root, "a\\b.png") == root / "a/b.png"
        for absolute in ("root/a/b.png", "link/a/b.png"):
            assert path_below(root, str(tmp_path / absolute)) == root / "a/b.png"
    for elsewhere in ("/home/somebody/a.png", "C:\\Users\\somebody\\a.png", "D:/a.png"):
        with pytest.raises(OutsidePath, match="another machine; make it relative to link"):
            path_below(Path("link"), elsewhere)
    (tmp_path / "b.png").touch()
    with pytest.raises(OutsidePath, match="outside of link"):
        path_below(Path("link"), str(tmp_path / "b.png"))


def test_links_must_not_leave_the_root_which_may_be_a_link(tmp_path: Path):
    root, alias = tmp_path / "root", tmp_path / "alias"
    (root / "a").mkdir(parents=True)
    (tmp_path / "root_of_others").mkdir()
    targets = {"out": tmp_path, "sibling": tmp_path / "root_of_others", "hop": "out", "within": "a", "ring": "ring"}
    for name, target in targets.items():
        (root / name).symlink_to(target)
    alias.symlink_to(root)
    for relative in ("out", "sibling/x.png", "hop/x.png", "within/../out/x"):
        with pytest.raises(OutsidePath):
            path_below(root, relative)
    for relative in ("a/x.png", "within/x.png", "not_there/x.png", "...", "a/..x", "ring"):
        assert path_below(root, relative) == root / relative
        assert path_below(alias, relative) == alias / relative


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
