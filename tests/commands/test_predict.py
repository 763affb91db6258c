from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData
from support import python, strict_json

FEW = ["samples=2", "frames=4", "steps=2", "color_fits=1"]
UNNEEDED = ["lightning", "matplotlib", "pandas", "torchmetrics", "viser", "wandb"]
UNNEEDED += [
    f"completesplat.{part}" for part in ("data.captures", "data.loading", "metrics", "evaluation.scorer", "training")
]


@pytest.fixture
def predict(command, pipeline, tmp_path):
    """Run the command with the pipeline's weights; the folder of the photograph's files."""

    def run(*settings: str, image: Path | None = None, out: str = "out") -> Path:
        image = image or pipeline.photograph()
        given = [f"image={image}", f"weights={pipeline.weights}", f"out={tmp_path / out}", *FEW, *settings]
        finished = command("predict", *given)
        assert finished.status == 0, finished.err
        folder = tmp_path / out / image.stem
        assert finished.out.splitlines()[-2:] == [str(tmp_path / out), f"look at {folder / 'sheet.png'}"]
        assert (folder / "sheet.png").is_file()
        return folder

    return run


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.ply")}


def splats(folder: Path) -> list[bytes]:
    """The samples without the settings that their files record."""
    return [PlyData.read(path)["vertex"].data.tobytes() for path in sorted(folder.glob("*.ply"))]


def test_every_file_is_there_and_opens(predict):
    folder = predict("steps=null")
    names = {"sample_00.ply", "sample_01.ply", "orbit_00.mp4", "orbit_01.mp4", "sheet.png", "scene.json", "photo.png"}
    assert {path.name for path in folder.iterdir()} == names
    vertices = PlyData.read(folder / "sample_01.ply")["vertex"].data
    assert len(vertices) == 2 * 32 * 32
    assert all(np.isfinite(vertices[name]).all() for name in vertices.dtype.names)
    assert len(imageio.mimread(folder / "orbit_00.mp4", memtest=False)) == 4
    Image.open(folder / "sheet.png").verify()
    scene = strict_json(folder / "scene.json")
    settings = scene["settings"]
    assert (scene["seed"], settings["gaussians"]) == (0, [2048, 2048])
    assert (settings["sampler"], settings["steps"]) == ("DDIMScheduler", 2)  # those that the weights were saved with


@pytest.mark.processes
def test_a_prediction_imports_only_what_it_needs_and_the_garbage_collector_leaves_that_alone(pipeline, tmp_path):
    """In a separate process."""
    given = [str(pipeline.photograph()), f"weights={pipeline.weights}", "samples=1", "video=[]"]
    program = f"import gc, sys; sys.argv = {['completesplat', 'predict', *given, f'out={tmp_path}']}\n"
    program += "from completesplat.cli import main; main()\n"
    program += f"print([name for name in {UNNEEDED} if name in sys.modules], gc.isenabled(), gc.get_freeze_count())"
    unneeded, enabled, frozen = python(program).splitlines()[-1].rsplit(" ", 2)
    assert (unneeded, enabled) == ("[]", "True")
    assert int(frozen) > 100_000


def test_maps_another_sampler_and_a_field_of_view_can_be_asked_for(predict):
    folder = predict("maps=true", "fov=90", "sampler=dpm20", "steps=null", "batch=1")
    names = {f"{kind}_{index:02}.png" for kind in ("depth", "normals", "opacity") for index in (0, 1)}
    assert {Image.open(folder / name).size for name in names} == {(32, 32)}
    scene = strict_json(folder / "scene.json")
    assert names <= set(scene["files"].values())
    assert scene["reference_camera"]["intrinsics"][0][0] == pytest.approx(16)
    settings = scene["settings"]
    near, far = settings["depth_map_ends"]
    assert 0 < near < far
    assert settings["fov_source"] == "given"
    assert (settings["sampler"], settings["steps"]) == ("DPMSolverMultistepScheduler", 20)


def test_the_seed_decides_the_bytes_and_each_control_changes_every_scene(predict):
    first = predict("video=[]")
    assert files(first) == files(predict("seed=0", "video=[]", out="same"))
    controls = ["seed=1", "skip_weight=0", "guidance_weight=0.5", "steps=4", "sampler=dpm20"]
    made = [splats(predict(control, "video=[]", out=str(index))) for index, control in enumerate(controls)]
    made.append(splats(first))
    assert len({scene for scenes in made for scene in scenes}) == 2 * len(made)


def test_pixels_in_a_box_or_a_mask_have_no_influence(predict, tmp_path):
    """The image is larger than the model's and resized, so that its border pixels mix with their neighbours."""
    rng = np.random.default_rng(0)
    one = rng.integers(0, 256, (100, 120, 3), dtype=np.uint8)
    other = one.copy()
    other[:, 60:110] = 255 - one[:, 60:110]  # within the box, which is the right half
    result = []
    for name, pixels in (("one", one), ("other", other)):
        image = tmp_path / name / "photo.png"
        image.parent.mkdir()
        Image.fromarray(pixels).save(image)
        result.append(predict("box=[0.5,0,1,1]", "video=[]", image=image, out=f"{name}/out"))
    assert files(result[0]) == files(result[1])
    scene = strict_json(result[0] / "scene.json")["settings"]
    assert (scene["box"], scene["mask"], scene["skip_weight"]) == ([0.5, 0, 1, 1], None, 0)
    hidden = np.zeros((100, 120), np.uint8)
    hidden[:, 60:] = 255
    Image.fromarray(hidden).save(tmp_path / "mask.png")
    masked = predict(f"mask={tmp_path / 'mask.png'}", "video=[]", image=tmp_path / "one/photo.png", out="masked")
    whole = predict("skip_weight=0", "video=[]", image=tmp_path / "one/photo.png", out="whole")
    assert splats(masked) == splats(result[0])
    assert not set(splats(masked)) & set(splats(whole))


def test_detail_gives_smaller_gaussians_and_larger_pictures(predict, tmp_path):
    photo = tmp_path / "photo.png"
    Image.effect_noise((70, 64), 80).convert("RGB").save(photo)
    folder = predict("samples=1", "detail=64", "video=[wobble]", image=photo)
    scene = strict_json(folder / "scene.json")
    assert scene["reference_camera"]["image_size"] == [64, 64]
    assert scene["settings"]["detail"] == 64
    (count,) = scene["settings"]["gaussians"]
    assert 2 * 32 * 32 < count <= 2 * 32 * 32 + 64 * 64 / 2
    assert len(PlyData.read(folder / "sample_00.ply")["vertex"].data) == count
    assert Image.open(folder / "photo.png").size == (64, 64)
