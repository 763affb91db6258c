"""PLY files against plyfile, an independent reader and writer, and those that are refused."""

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from plyfile import PlyData, PlyElement

from completesplat.data.co3d.category_writers import write_points
from completesplat.errors import PlyError
from completesplat.ply_files import TYPES, read_vertices

POINT = [("x", "f4"), ("y", "f8"), ("z", "f4"), ("red", "u1"), ("label", "i2")]


def written(form: str, elements: list[PlyElement]) -> bytes:
    """Return a file of plyfile, as `ascii`, `<` or `>`."""
    file = io.BytesIO()
    PlyData(elements, text=form == "ascii", byte_order="=" if form == "ascii" else form, comments=["a b"]).write(file)
    return file.getvalue()


def cameras(count: int) -> PlyElement:
    return PlyElement.describe(np.ones(count, [("focal", "f8"), ("id", "u2")]), "camera")


def faces(count: int) -> PlyElement:
    rows = np.empty(count, [("vertex_indices", "O"), ("flags", "u1")])
    for number in range(count):
        rows[number] = np.arange(number, dtype="i4"), 1
    return PlyElement.describe(rows, "face", len_types={"vertex_indices": "u1"}, val_types={"vertex_indices": "i4"})


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("ply") / "a.ply"


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_files_of_plyfile_are_read(data, file):
    kinds = data.draw(st.lists(st.sampled_from(sorted(set(TYPES.values()))), min_size=1, max_size=6))
    dtype = [(f"p{number}", kind) for number, kind in enumerate(kinds)]
    vertices = data.draw(arrays(np.dtype(dtype), st.integers(0, 5)))
    elements = [cameras(2)] * data.draw(st.integers(0, 1)) + [PlyElement.describe(vertices, "vertex")]
    elements += [faces(data.draw(st.integers(0, 4)))] * data.draw(st.integers(0, 1))
    file.write_bytes(written(data.draw(st.sampled_from(["ascii", "<", ">"])), elements))
    result = read_vertices(file, ["p0"])
    assert result.dtype.names == vertices.dtype.names
    for name in result.dtype.names:
        np.testing.assert_array_equal(result[name], vertices[name])
        assert result[name].dtype.newbyteorder("=") == vertices[name].dtype


def test_point_clouds_have_the_bytes_that_plyfile_writes(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 3))
    colors = rng.integers(0, 256, (20, 3), dtype=np.uint8)
    write_points(tmp_path / "a.ply", points, colors)
    dtype = [(axis, "<f4") for axis in "xyz"] + [(channel, "u1") for channel in ("red", "green", "blue")]
    expected = np.rec.fromarrays([*points.T, *colors.T], dtype=dtype)
    PlyData([PlyElement.describe(expected, "vertex")], byte_order="<").write(tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_both_generations_of_types_comments_and_line_ends_are_read(tmp_path):
    lines = ["ply", "format ascii 1.0", "comment a b", "obj_info c", "element vertex 2", "property float32 x"]
    lines += ["property uint8 red", "end_header", "1.5 7", "", "-2e-3\t255"]
    for end in ("\n", "\r\n"):
        (tmp_path / "a.ply").write_bytes(end.join(lines).encode())
        result = read_vertices(tmp_path / "a.ply", ["red"])
        assert result.tolist() == [(1.5, 7), (pytest.approx(-2e-3), 255)]


@pytest.mark.parametrize("form", ["ascii", "<", ">"])
def test_other_sizes_than_the_headers_are_refused(form, file):
    points = PlyElement.describe(np.arange(4).astype(POINT), "vertex")
    for elements in ([points], [cameras(1), points], [points, cameras(1)], [points, faces(2)]):
        good = written(form, elements)
        file.write_bytes(good)
        assert read_vertices(file, "xyz")["y"].tolist() == [0, 1, 2, 3]
        assert good.count(b"vertex 4\n") == 1
        damaged = [good.replace(b"vertex 4\n", b"vertex %d\n" % count) for count in (5, 10**14)]
        # How long records with lists are is not known before they are read: at least as if all were empty.
        in_bytes_with_lists = len(elements) == 2 and elements[1].name == "face" and form != "ascii"
        if not in_bytes_with_lists:
            damaged += [good + b"1 2\n", good.replace(b"vertex 4\n", b"vertex 3\n")]
        # A number of a text that lost its last digit, or a line its end, is not noticed.
        ends = [at for at in range(0, len(good), 3) if form != "ascii" or good[at - 1 : at] == b"\n"]
        damaged += [good[:end] for end in ends[: -2 if in_bytes_with_lists else None]]
        for content in damaged:
            file.write_bytes(content)
            with pytest.raises(PlyError):
                read_vertices(file, "xyz")
