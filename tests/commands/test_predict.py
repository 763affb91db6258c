import hashlib
import re
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from hydra.errors import HydraException
from omegaconf import OmegaConf
from PIL import Image
from plyfile import PlyData
from support import compose_config, strict_json

from completesplat.autoreconstructor.skips import allowed_skip_weight
from completesplat.commands.generator import check_settings
from completesplat.commands.predict import RANGES, visible_part
from completesplat.errors import CompleteSplatError

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


BOX = "box=[0.5,0,1,1]"


def test_what_a_box_hides_has_no_influence(command, pipeline, tmp_path):
    """The picture is larger than the model's, and resized: its border pixels mix with their neighbours."""
    rng = np.random.default_rng(0)
    one = rng.integers(0, 256, (100, 120, 3), dtype=np.uint8)
    other = one.copy()
    other[:, 60:110] = 255 - one[:, 60:110]  # the box, in the central square's pixels 10 to 110
    found = []
    for name, pixels in (("one", one), ("other", other)):
        (tmp_path / name).mkdir()
        Image.fromarray(pixels).save(tmp_path / name / "picture.png")
        image = tmp_path / name / "picture.png"
        assert predict(command, pipeline, tmp_path / name / "out", BOX, image=image).status == 0
        found.append(hashes(tmp_path / name / "out/picture"))
    assert found[0] == found[1]
    scene = strict_json(tmp_path / "one/out/picture/scene.json")["settings"]
    assert (scene["box"], scene["mask"], scene["skip_weight"]) == ([0.5, 0, 1, 1], None, 0)


def test_a_mask_hides_what_a_box_hides(command, pipeline, tmp_path):
    pixels = np.zeros((32, 32), np.uint8)
    pixels[:, 16:] = 255
    Image.fromarray(pixels).save(tmp_path / "mask.png")
    found = []
    for setting in (BOX, f"mask={tmp_path / 'mask.png'}", "skip_weight=0"):
        assert predict(command, pipeline, tmp_path / str(len(found)), setting).status == 0
        found.append(hashes(tmp_path / str(len(found)) / pipeline.photograph().stem))
    assert set(found[0]) == set(found[1])
    assert splats(tmp_path / "0", pipeline) == splats(tmp_path / "1", pipeline) != splats(tmp_path / "2", pipeline)


def splats(out: Path, pipeline) -> bytes:
    """A sample without the settings that its file records."""
    return PlyData.read(out / pipeline.photograph().stem / "sample_00.ply")["vertex"].data.tobytes()


@pytest.mark.parametrize(("name", "scheduler"), [("dpm20", "DPMSolverMultistepScheduler"), (None, "DDIMScheduler")])
def test_the_sampler_can_be_another_one(command, pipeline, tmp_path, name, scheduler):
    settings = [] if name is None else [f"sampler={name}"]
    assert predict(command, pipeline, tmp_path / "out", *settings, "steps=null", "batch=1").status == 0
    scene = strict_json(tmp_path / "out" / pipeline.photograph().stem / "scene.json")["settings"]
    assert scene["sampler"] == scheduler
    # Of the configuration, or those that the weights were saved with.
    assert scene["steps"] == (20 if name else 2)


def test_a_setting_without_a_meaning_is_refused_in_one_line(command, pipeline, tmp_path):
    finished = predict(command, pipeline, tmp_path / "out", "steps=3")
    assert finished.status == 2
    assert finished.err.splitlines()[-1].startswith("error: ")
    assert "steps=3: DDIM's must divide 1000" in finished.err.splitlines()[-1]
    assert not (tmp_path / "out" / pipeline.photograph().stem).exists()


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("sampler=nonsense", "nonsense"),
        ("batch=0", "batch=0: must be at least 1"),
        ("steps=1001", "steps=1001: must lie between 1 and 1000"),
        ("background=2", "background=2: must lie between 0 and 1"),
        ("skip_weight=2", "skip_weight=2: must lie between 0 and 1"),
        ("guidance_weight=-1", "guidance_weight=-1: must lie between 0 and 1"),
    ],
)
def test_settings_have_ranges(setting, said):
    with pytest.raises((CompleteSplatError, HydraException), match=re.escape(said)):
        check_settings(compose_config("predict", "image=a.png", setting), RANGES)


@pytest.mark.parametrize(
    ("hidden", "said"),
    [
        ({"box": [0, 0, 1]}, "box=[0, 0, 1]: give [x0,y0,x1,y1]"),
        ({"box": 0.5}, "box=0.5: give [x0,y0,x1,y1]"),
        ({"box": ["a", "b", "c", "d"]}, "give [x0,y0,x1,y1]"),
        ({"box": [0.5, 0, 0.5, 1]}, "needs 0 <= x0 < x1 <= 1"),
        ({"mask": "nowhere.png"}, "nowhere.png: no such file"),
        ({"mask": "nowhere.png", "box": [0.5, 0, 1, 1]}, "not both"),
    ],
)
def test_what_hides_nothing_is_refused(tmp_path, hidden, said):
    image = tmp_path / "a.png"
    Image.new("RGB", (32, 32)).save(image)
    config = OmegaConf.create({"box": None, "mask": None} | hidden)
    with pytest.raises(CompleteSplatError, match=re.escape(said)):
        visible_part(config, image, 32)


def test_skips_are_refused_where_something_is_hidden():
    with pytest.raises(CompleteSplatError, match="skip_weight=1: must be 0 where the picture is hidden"):
        allowed_skip_weight(1, torch.zeros(1, 2, 2))


def test_maps_are_written_if_wanted(command, pipeline, tmp_path):
    assert predict(command, pipeline, tmp_path / "out", "maps=true").status == 0
    folder = tmp_path / "out" / pipeline.photograph().stem
    names = {f"{kind}_{index:02}.png" for kind in ("depth", "normals", "opacity") for index in (0, 1)}
    assert {Image.open(folder / name).size for name in names} == {(32, 32)}
    scene = strict_json(folder / "scene.json")
    assert names <= set(scene["files"].values())
    near, far = scene["settings"]["depth_map_ends"]
    assert 0 < near < far
