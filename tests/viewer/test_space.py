"""The page of a Space, without gradio: its packages, and its results for an image. In a browser: `test_browser`."""

import html
import re
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from support import strict_json, tiny_generator

from completesplat.errors import CompleteSplatError, ImageError
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.viewer.space import completed, make_space

pytest.importorskip("viser", reason="the viewer's extra is not installed")
SETTINGS = {"samples": 2, "skip_weight": 1.0, "guidance_weight": 0.0, "seed": 3}


@pytest.mark.parametrize("missing", ["gradio", "viser"])
def test_without_its_packages_the_extra_is_named(monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.delitem(sys.modules, "completesplat.viewer.panel", raising=False)
    with pytest.raises(CompleteSplatError, match=r'pip install "completesplat\[space\]"'):
        make_space("nothing")


@pytest.mark.processes
def test_without_weights_it_is_one_line():
    done = subprocess.run([sys.executable, "-m", "completesplat.viewer.space"], capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith("error: give the weights")


def test_an_image_becomes_a_frame_for_each_sample_a_sheet_and_files(tmp_path):
    image, out = tmp_path / "photo.png", tmp_path / "out"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (40, 50, 3), np.uint8)).save(image)
    frames_html, sheet, files = completed(tiny_generator(), ReferenceRasterizer(), image, out, SETTINGS)
    frames = re.findall(r'<iframe sandbox="allow-scripts" [^>]*srcdoc="([^"]*)"></iframe>', frames_html)
    pages = [out / f"sample_0{i}.html" for i in range(2)]
    assert [html.unescape(frame) for frame in frames] == [page.read_text() for page in pages]
    assert sheet == str(out / "sheet.png")
    assert files == [str(out / f"sample_0{i}.{kind}") for i in range(2) for kind in ("html", "ply")] + [
        str(out / "scene.json")
    ]
    assert strict_json(out / "scene.json")["settings"].items() >= {**SETTINGS, "image": "photo.png"}.items()
    # A page holds one sample; earlier ones of the same process are not in it.
    assert pages[0].stat().st_size == pytest.approx(pages[1].stat().st_size, rel=0.1)
    image.write_bytes(image.read_bytes()[:60])
    with pytest.raises(ImageError, match=r"photo\.png"):
        completed(tiny_generator(), ReferenceRasterizer(), image, out, SETTINGS)
