import hashlib
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData
from support import strict_json

FEW = ["samples=2", "frames=4", "steps=2"]


def hashes(folder: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.glob("*.ply")}


def predict(command, pipeline, out: Path, *settings: str, image: Path | None = None):
    image = image or pipeline.photograph()
    return command("predict", f"image={image}", f"weights={pipeline.weights}", f"out={out}", *FEW, *settings)


def test_every_file_is_there_and_opens(command, pipeline, tmp_path):
    finished = predict(command, pipeline, tmp_path / "out")
    assert finished.status == 0
    folder = tmp_path / "out" / pipeline.photograph().stem
    assert finished.out.splitlines()[-1] == str(tmp_path / "out")
    names = {"sample_00.ply", "sample_01.ply", "orbit_00.mp4", "orbit_01.mp4", "sheet.png", "scene.json"}
    assert {path.name for path in folder.iterdir()} == names
    vertices = PlyData.read(folder / "sample_01.ply")["vertex"].data
    assert len(vertices) == 2 * 32 * 32
    assert all(np.isfinite(vertices[name]).all() for name in vertices.dtype.names)
    assert len(imageio.mimread(folder / "orbit_00.mp4", memtest=False)) == 4
    Image.open(folder / "sheet.png").verify()
    scene = strict_json(folder / "scene.json")
    assert scene["seed"] == 0
    assert scene["settings"]["gaussians"] == [2048, 2048]


def test_the_seed_decides_the_bytes(command, pipeline, tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        assert predict(command, pipeline, tmp_path / name, f"seed={seed}").status == 0
    stem = pipeline.photograph().stem
    first, same, other = (hashes(tmp_path / name / stem) for name in "abc")
    assert first == same
    assert not set(first.values()) & set(other.values())
    assert len(set(first.values())) == 2


def test_the_field_of_view_reaches_the_scene(command, pipeline, tmp_path):
    assert predict(command, pipeline, tmp_path / "out", "fov=90").status == 0
    scene = strict_json(tmp_path / "out" / pipeline.photograph().stem / "scene.json")
    assert scene["settings"]["fov_source"] == "given"
    assert scene["reference_camera"]["intrinsics"][0][0] == pytest.approx(16)


@pytest.mark.parametrize("content", [b"", b"no image", b"\xff\xd8\xff\xe0 truncated"])
def test_what_is_no_picture_is_refused_in_one_line(command, pipeline, tmp_path, content):
    image = tmp_path / "broken.jpg"
    image.write_bytes(content)
    finished = predict(command, pipeline, tmp_path / "out", image=image)
    assert finished.status == 2
    assert finished.err.startswith("error: ")
    assert finished.err.count("\n") == 1
    assert "broken.jpg" in finished.err
    assert not (tmp_path / "out" / "broken").exists()


@pytest.mark.parametrize("mode", ["L", "RGBA", "I;16"])
def test_any_kind_of_picture_is_accepted(command, pipeline, tmp_path, mode):
    image = tmp_path / "picture.png"
    Image.new(mode, (50, 40), 30000 if mode == "I;16" else 0).save(image)
    assert predict(command, pipeline, tmp_path / "out", image=image).status == 0
