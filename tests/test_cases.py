"""Inputs as people bring them, in `tests/cases`: each is read as the scene that it shows, or refused in one line.

The captures show one scene, whose true cameras are in `cases/transforms.json`.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import meshes
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from plyfile import PlyData
from scipy.spatial.transform import Rotation
from support import exif_turned, some_gaussians, strict_json

from completesplat.data.captures.module import CaptureDataModule
from completesplat.data.rendered.blender import find_blender
from completesplat.data.rendered.rendering import render
from completesplat.errors import CompleteSplatError
from completesplat.export.ply import write_ply
from completesplat.export.reading import read_gaussians
from completesplat.generator import CompleteSplat
from completesplat.settings.sweeps import check_sweep
from completesplat.viewer.sample import read_scene

CASES = Path(__file__).with_name("cases")
ORIGIN, UTM = np.zeros(3), np.array([447123.25, 5411876.5, 312.0])
SIZE = 32
SHARE = SIZE / (2 * 57)  # the largest square around the principal point reaches the image's upper edge
LENS = [[190 * SHARE, 0, SIZE / 2], [0, 188 * SHARE, SIZE / 2], [0, 0, 1]]
QUICK = meshes.SETTINGS | {"views": 2, "size": 16, "samples": 1, "workers": 1, "progress": False}
Change = Callable[[Image.Image], Image.Image]
Values = dict[str, np.ndarray]


def capture(name: str, folder: Path, change: Change = lambda image: image, orientation: int = 1) -> Path:
    """Write a case's cameras, and the photos beside them, changed and tagged to be turned."""
    shutil.copytree(CASES / name, folder) if name else folder.mkdir()
    if not name:
        shutil.copy(CASES / "transforms.json", folder)
    (folder / "images").mkdir()
    for path in sorted((CASES / "images").iterdir()):
        change(Image.open(path)).save(folder / "images" / path.name, quality=95, exif=exif_turned(orientation))
    return folder


def read_cameras(folder: Path) -> Values:
    """Return centers in the capture's units, rotations and intrinsics of all frames."""
    data, rows = CaptureDataModule(str(folder), image_size=SIZE), {}
    for split in ("train", "test"):
        source = data.source(split)
        sequence = source.read(source.names[0])
        cameras = sequence.cameras
        centers = cameras.centers.numpy() / sequence.scale + np.array(sequence.origin)
        parts = centers, cameras.world_to_camera[:, :3, :3].numpy(), cameras.intrinsics.numpy()
        rows |= dict(zip(sequence.frames, zip(*parts, strict=True), strict=True))
    columns = zip(*(rows[frame] for frame in sorted(rows)), strict=True)
    return dict(zip(("centers", "rotations", "intrinsics"), map(np.array, columns), strict=True))


def true_cameras(shift: np.ndarray) -> Values:
    frames = json.loads((CASES / "transforms.json").read_text())["frames"]
    poses = np.array([frame["transform_matrix"] for frame in frames])
    rotations = (poses[:, :3, :3] * [1, -1, -1]).transpose(0, 2, 1)  # OpenGL's axes
    lenses = np.broadcast_to(LENS, (len(frames), 3, 3))
    return {"centers": poses[:, :3, 3] + shift, "rotations": rotations, "intrinsics": lenses}


CAPTURES: dict[str, tuple[Callable[[Path], Path], np.ndarray]] = {
    "base": (lambda folder: capture("", folder), ORIGIN),
    "t11_exif": (lambda folder: capture("", folder, orientation=6), ORIGIN),
    "c06_downscaled": (lambda folder: capture("c07_two", folder, lambda image: image.resize((80, 60))), ORIGIN),
    "c07_two": (lambda folder: capture("c07_two", folder), ORIGIN),
    "c17_utm": (lambda folder: capture("c17_utm", folder), UTM),
    "c21_blankfirst": (lambda folder: capture("c21_blankfirst", folder), ORIGIN),
}


def first_image(folder: Path) -> torch.Tensor:
    source = CaptureDataModule(str(folder), image_size=SIZE).source("train")
    return source.read(source.names[0]).read(0).image.float()


@pytest.mark.parametrize("case", CAPTURES)
def test_a_capture_has_the_cameras_and_images_of_its_scene(case: str, tmp_path: Path) -> None:
    write, shift = CAPTURES[case]
    cameras, expected = read_cameras(write(tmp_path / case)), true_cameras(shift)
    for name, values in expected.items():
        np.testing.assert_allclose(cameras[name], values, atol=1e-6, rtol=0, err_msg=name)
    assert (first_image(tmp_path / case) - first_image(capture("", tmp_path / "truth"))).abs().mean() < 4


@pytest.mark.slow
def test_a_fit_far_from_the_origin_is_as_good_as_at_the_origin(command, tmp_path: Path) -> None:
    quick = ["experiment=capture", "data.image_size=32", "trainer.max_steps=60", "trainer.accelerator=cpu"]
    quick += ["model.formats=[]", "model.frames=2", "model.fitting.most=600", "trainer.val_check_interval=100"]
    scores = {}
    for case in ("c21_blankfirst", "c17_utm"):
        root = capture(case, tmp_path / case)
        command.succeeds("fit", *quick, f"data.root={root}", f"out={case}_run", "callbacks.progress=null")
        scores[case] = strict_json(tmp_path / f"{case}_run/metrics.json")["test"]["model"]["full"]["novel"]["psnr"]
    near, far = scores.values()
    assert near > 12
    assert far == pytest.approx(near, abs=0.1)


def converted(name: str) -> Callable[[Path], object]:
    return lambda folder: read_gaussians(CASES / "splats" / name)


def prediction(name: str) -> Callable[[Path], object]:
    """Read a description of a prediction beside 3,000 Gaussians."""

    def read(folder: Path) -> object:
        write_ply(folder / "sample_00.ply", some_gaussians(1)[0][torch.zeros(3000).long()])
        shutil.copy(CASES / f"scene_json/{name}.json", folder / "scene.json")
        return read_scene(folder)

    return read


def rendered(name: str, *others: str) -> Callable[[Path], object]:
    """Render a mesh."""

    def read(folder: Path) -> object:
        (folder / "meshes").mkdir()
        for file in (name, *others):
            shutil.copy(CASES / "meshes" / file, folder / "meshes")
        return render(str(folder / "meshes"), out=folder / "data", **QUICK)

    return read


@pytest.fixture
def blender(request: pytest.FixtureRequest) -> None:
    """Skip what needs Blender where there is none."""
    if request.node.get_closest_marker("blender"):
        try:
            find_blender()
        except CompleteSplatError as reason:
            pytest.skip(str(reason))


UNREADABLE = "cannot be read: damaged, or a pointer of Git LFS"
UNPACKS = "x.ply` unpacks it, or install splat-transform"
REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "wild_pose": (
        lambda folder: CaptureDataModule(str(CASES / "wild_pose"), image_size=SIZE).source("train").read("wild_pose"),
        "images.bin, wild_pose, frame 1: the pose is not finite in float32",
    ),
    "ref.sog": (converted("ref.sog"), f"ref.sog: SOG; `splat-transform ref.sog {UNPACKS}"),
    "minimal.ksplat": (converted("minimal.ksplat"), f"KSPLAT; `splat-transform minimal.ksplat {UNPACKS}"),
    "ref.compressed.ply": (converted("ref.compressed.ply"), "SuperSplat's compressed PLY; `splat-transform ref.c"),
    "badtex": (rendered("badtex.glb", "bad.png"), f"its texture bad.png {UNREADABLE}"),
    "cuttex": (rendered("cuttex.glb", "cut.png"), f"its texture cut.png {UNREADABLE}"),
    "lfstex": (rendered("lfstex.glb", "lfs.png"), f"its texture lfs.png {UNREADABLE}"),
    "lfs_weights": (
        lambda folder: CompleteSplat.from_pretrained(CASES / "lfs_weights"),
        "model.safetensors: a pointer of Git LFS in place of the file; run `git lfs pull`",
    ),
    "glob_none": (
        lambda folder: check_sweep(["experiment=toy_var", "ablation=glob(zzz*)"]),
        "ablation=glob(zzz*): stands for no value, so there is no job; there are full, m1",
    ),
    "ktx2only": (rendered("ktx2only.glb", "t.ktx2"), "a texture in a format that Blender does not read, such as KTX2"),
}


NEED_BLENDER = ("badtex", "cuttex", "lfstex", "ktx2only")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.blender if case in NEED_BLENDER else ()) for case in REFUSED]
)
@pytest.mark.usefixtures("blender")
def test_what_cannot_be_read_right_is_refused_in_one_line(case: str, tmp_path: Path, monkeypatch) -> None:
    read, reason = REFUSED[case]
    monkeypatch.setenv("PATH", "/usr/bin:/bin")  # without splat-transform
    with pytest.raises(CompleteSplatError) as caught:
        read(tmp_path)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("case", "left_out"), [("ref.ply", ""), ("ext_coord.spz", ""), ("nan.ply", "left out 2 of 200 Gaussians")]
)
def test_splats_are_where_the_reference_has_them(case: str, left_out: str, caplog: pytest.LogCaptureFixture) -> None:
    truth = PlyData.read(CASES / "splats" / (case if case == "nan.ply" else "ref.ply"))["vertex"]
    names = [one.name for one in truth.properties]
    table = np.stack([truth[name] for name in names], axis=1)
    table = table[np.isfinite(table).all(axis=1)]
    columns = {name: table[:, number] for number, name in enumerate(names)}
    gaussians = read_gaussians(CASES / "splats" / case)
    means = np.stack([columns[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(gaussians.means.numpy(), means, atol=1e-3)
    turned = Rotation.from_quat(np.stack([columns[f"rot_{number}"] for number in (1, 2, 3, 0)], axis=1)).as_matrix()
    axes = turned * np.exp(np.stack([columns[f"scale_{number}"] for number in range(3)], axis=1))[:, None]
    covariances = axes @ axes.transpose(0, 2, 1)
    np.testing.assert_allclose(gaussians.covariances().numpy(), covariances, atol=0.1 * np.abs(covariances).max())
    assert left_out in caplog.text
    assert bool(caplog.text) == bool(left_out)


def test_thousands_of_layers_are_shown_as_one(tmp_path: Path) -> None:
    samples, _ = prediction("layers")(tmp_path)
    assert samples[0].layers == 1


def test_a_point_that_float32_cannot_hold_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    sequence = CaptureDataModule(str(CASES / "wild_point"), image_size=SIZE).source("train").read("wild_point")
    assert sequence.points.shape == (49, 3)
    assert sequence.points.isfinite().all()
    assert "1 of 50 points" in caplog.text


@pytest.mark.blender
@pytest.mark.usefixtures("blender")
def test_stray_faces_far_from_the_mesh_are_left_out(tmp_path: Path) -> None:
    whole = trimesh.load(CASES / "meshes/stray25.glb", force="mesh")
    far = np.linalg.norm(whole.triangles_center, axis=1) > 10
    rendered("stray25.glb")(tmp_path)
    assert strict_json(tmp_path / "data/rendered/stray25.glb/object.json")["left_out"] == far.sum() > 0
