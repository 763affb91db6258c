"""Depth maps of CO3D, written as float16 in a PNG."""

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from completesplat.data.co3d.depth_maps import read_depth
from completesplat.errors import BadImage

DEEP = np.random.default_rng(1).integers(0, 65536, (6, 8), dtype=np.uint16)


def saved(pixels: np.ndarray, kind: str = "PNG") -> bytes:
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, kind)
    return content.getvalue()


DEPTH = np.array([[0.0, 0.5, 1.25], [3.0, 65504.0, 2.0**-14]], dtype=np.float16)


def depth_png(depth: object) -> bytes:
    return saved(np.asarray(depth, dtype=np.float16).view(np.uint16))


@pytest.mark.parametrize("scale", [1.0, 0.37, 250.0])
def test_a_depth_map_is_float16_times_the_scale_and_unknown_where_not_finite(tmp_path, scale):
    holes = np.where([[False, True, False], [True, False, False]], [np.inf, np.nan, 0], DEPTH)
    for stored, known in ((DEPTH, DEPTH), (holes, np.nan_to_num(holes, posinf=0)), (0 * DEPTH, 0 * DEPTH)):
        (tmp_path / "d.png").write_bytes(depth_png(stored))
        expected = torch.from_numpy(known.astype(np.float32))[None] * scale
        torch.testing.assert_close(read_depth(tmp_path / "d.png", scale), expected, rtol=1e-7, atol=0)


@pytest.mark.parametrize(
    ("content", "scale", "part"),
    [
        (saved(DEEP.astype(np.uint8)), 1.0, "16 bits"),
        (saved(DEEP, "TIFF"), 1.0, "formats PNG"),
        (depth_png([[1.0, -0.5]]), 1.0, "negative"),
        *((depth_png(np.ones((2, 2))), scale, "scale adjustment") for scale in (0.0, float("nan"), float("inf"))),
    ],
    ids=["eight_bits", "tiff", "negative", "zero", "nan", "infinite"],
)
def test_a_bad_depth_map_is_refused_by_name(tmp_path: Path, content, scale, part):
    path = tmp_path / "d.png"
    path.write_bytes(content)
    with pytest.raises(BadImage) as caught:
        read_depth(path, scale)
    assert caught.value.file == str(path)
    assert part in caught.value.reason
