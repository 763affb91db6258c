"""Inputs as people bring them, in `tests/cases`: each is read as the scene that it shows, or refused in one line.

The captures show one scene, whose true cameras are in `cases/transforms.json`.
"""

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import meshes
import numpy as np
import pytest
import torch
import trimesh
from numpy.lib.recfunctions import repack_fields
from PIL import Image, ImageCms, ImageFilter
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation
from support import exif_turned, some_gaussians, strict_json

from completesplat.data.captures.capture_images import copy_photos
from completesplat.data.captures.capture_set import read_splits
from completesplat.data.captures.films import split_video
from completesplat.data.captures.importing import import_capture
from completesplat.data.captures.module import CaptureDataModule
from completesplat.data.captures.turntable import import_turntables
from completesplat.data.rendered.blender import find_blender
from completesplat.data.rendered.mesh_reading import read_mesh
from completesplat.data.rendered.rendering import render
from completesplat.errors import CompleteSplatError
from completesplat.export.ply import write_ply
from completesplat.export.reading import read_gaussians
from completesplat.generator import CompleteSplat
from completesplat.settings.sweeps import check_sweep
from completesplat.viewer.sample import read_scene
from completesplat.weights import shipped

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


def frames_of(case: str, suffix: str = ".jpg", name: str = "{1}") -> Callable[[Path], list[str]]:
    """Read a capture whose photos have other names, and return the photos that have cameras."""

    def read(folder: Path) -> list[str]:
        shutil.copytree(CASES / case, folder / case)
        (folder / case / "images").mkdir()
        for number, path in enumerate(sorted((CASES / "images").iterdir())):
            shutil.copy(path, folder / case / "images" / f"{name.format(number, path.stem)}{suffix}")
        data = CaptureDataModule(str(folder / case), image_size=SIZE)
        sequences = [data.source(split).read(case) for split in ("train", "test")]
        sequences[0].read(0)
        return sorted(photo for sequence in sequences for photo in sequence.photos)

    return read


def film(path: str, frames: int) -> Callable[[Path], list[Image.Image]]:
    """Split a film."""

    def read(folder: Path) -> list[Image.Image]:
        split_video(CASES / path, folder, frames)
        return [Image.open(image) for image in sorted(folder.iterdir())]

    return read


def patches_of(path: str) -> Callable[[Path], list[tuple[int, ...]]]:
    """Return the colours of the upper row of a film's patches, 64 pixels wide each."""

    def read(folder: Path) -> list[tuple[int, ...]]:
        frame = film(path, 1)(folder)[0]
        return [frame.getpixel((64 * number + 32, 32)) for number in range(4)]

    return read


def in_srgb(path: Path) -> Image.Image:
    """Return a photo, converted by its profile."""
    photo = Image.open(path)
    profile = ImageCms.ImageCmsProfile(io.BytesIO(photo.info["icc_profile"]))
    converted = ImageCms.profileToProfile(photo, profile, ImageCms.createProfile("sRGB"))
    converted.info.pop("icc_profile")
    return converted


def turn_in_p3(folder: Path) -> float:
    """Import photos in Display P3, and return how much the object differs from that of the same photos in sRGB."""
    settings = {"photos_of_a_turn": None, "elevation": 20, "fov": 18, "direction": None, "height": "ring"}
    settings |= {"background": "white", "splits": None}
    (folder / "srgb/apple").mkdir(parents=True)
    for path in sorted((CASES / "p3_turn/apple").iterdir()):
        in_srgb(path).save(folder / "srgb/apple" / path.name, quality=95)
    for name, photos in (("p3", CASES / "p3_turn"), ("twin", folder / "srgb")):
        import_turntables(photos, folder / name, settings)
    first, second = (inner_colors(folder / name / "apple") for name in ("p3", "twin"))
    return float(np.abs(first - second).mean())


def inner_colors(turn: Path) -> np.ndarray:
    """Return the mean colour of each photo's object without its edge, which lies elsewhere if white is another."""
    colors = []
    for path in sorted((turn / "images").iterdir()):
        mask = Image.open(turn / "masks" / f"{path.stem}.png").filter(ImageFilter.MinFilter(21))
        colors.append(np.asarray(Image.open(path))[np.asarray(mask) > 127].mean(0))
    return np.array(colors)


def capture_in_p3(folder: Path) -> float:
    """Return how much a photo in Display P3 differs from the same in sRGB, read as part of a capture."""
    profile = Image.open(CASES / "p3_turn/apple/009.jpg").info["icc_profile"]
    p3 = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    capture("", folder / "srgb")
    capture("", folder / "p3")
    for path in (folder / "p3/images").iterdir():
        photo = ImageCms.profileToProfile(Image.open(path), ImageCms.createProfile("sRGB"), p3)
        photo.save(path, quality=95, icc_profile=profile)
    return float((first_image(folder / "p3") - first_image(folder / "srgb")).abs().mean())


def copied_in_p3(folder: Path) -> float:
    """Copy a photo in Display P3 for COLMAP, and return how much the copy differs from the photo in sRGB."""
    (folder / "photos").mkdir()
    (folder / "images").mkdir()
    shutil.copy(CASES / "p3_turn/apple/009.jpg", folder / "photos")
    copy_photos(folder / "photos", folder / "images")
    copy = Image.open(folder / "images/009.jpg")
    assert "icc_profile" not in copy.info
    return float(np.abs(np.asarray(copy).astype(float) - np.asarray(in_srgb(CASES / "p3_turn/apple/009.jpg"))).mean())


def splat_values(name: str) -> Callable[[Path], list[float]]:
    """Return scales and opacities of a file's Gaussians in one list."""

    def read(folder: Path) -> list[float]:
        gaussians = read_gaussians(CASES / name)
        return [*gaussians.scales.flatten().tolist(), *gaussians.opacities.tolist()]

    return read


def texture_color(name: str) -> Callable[[Path], list[float]]:
    """Return the mean linear colour of a mesh's first texture."""
    return lambda folder: mean_texel(CASES / name, CASES)


def mean_texel(path: Path, root: Path) -> list[float]:
    mesh = read_mesh(path, root.resolve())
    start, width, height = mesh.textures.levels[0, 0]
    texels = mesh.textures.texels[start : start + 4 * width * height].reshape(-1, 4)
    return (texels[:, :3].mean(0) / 65535).tolist()


def texture_in_another_case(folder: Path) -> list[float]:
    """Return the mean linear colour of a mesh's texture, whose file's name has other letters than the .mtl says."""
    shutil.copytree(CASES / "mtl_backslash", folder / "mesh")
    (folder / "mesh/tex/back.png").rename(folder / "mesh/tex/Back.PNG")
    return mean_texel(folder / "mesh/back.obj", folder)


def linear_mean(name: str) -> list[float]:
    values = np.asarray(Image.open(CASES / name).convert("RGB")) / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).mean((0, 1)).tolist()


BRIGHT = [(220, 30, 30), (30, 180, 40), (30, 50, 200), (230, 200, 40)]
FUSED = splat_values("mip_filter3d/mip_fused.ply")(CASES)
MUG = "gso/gso_Mug/materials/textures/texture.png"
RIGHT: dict[str, tuple[Callable[[Path], object], object, float]] = {
    "v1_bt709": (patches_of("v1_bt709/patch_bt709.mp4"), BRIGHT, 3),
    "v3_coverfirst": (lambda folder: len(film("v3_coverfirst/coverfirst.mp4", 8)(folder)), 8, 0),
    "p3_turn": (turn_in_p3, 0, 1.5),
    "p3_capture": (capture_in_p3, 0, 1.5),
    "p3_copied": (copied_in_p3, 0, 1.5),
    "two_spaces": (lambda folder: len(frames_of("two_spaces", name="IMG 2024 ({0})")(folder)), 16, 0),
    "upper_JPG": (lambda folder: len(frames_of("upper_JPG", ".JPG")(folder)), 16, 0),
    "mip_filter3d": (splat_values("mip_filter3d/mip_filter3d.ply"), FUSED, 1e-5),
    "negative_splat": (lambda folder: splat_values("negative_splat/negscale.splat")(folder)[:9], [0.1] * 9, 1e-6),
    "gso": (texture_color("gso/gso_Mug/meshes/model.obj"), linear_mean(MUG), 1e-4),
    "mtl_backslash": (texture_color("mtl_backslash/back.obj"), linear_mean("mtl_backslash/tex/back.png"), 1e-4),
    "mtl_case": (texture_in_another_case, linear_mean("mtl_backslash/tex/back.png"), 1e-4),
}


@pytest.mark.parametrize("case", RIGHT)
def test_what_people_bring_is_read_right(case: str, tmp_path: Path) -> None:
    read, expected, tolerance = RIGHT[case]
    np.testing.assert_allclose(read(tmp_path), expected, atol=tolerance, rtol=0)


def without_masks(folder: Path) -> object:
    """Import a capture whose masks are black."""
    root = capture("masks_empty", folder / "masks_empty")
    (root / "masks").mkdir()
    for path in (root / "images").iterdir():
        Image.new("L", Image.open(path).size).save(root / "masks" / f"{path.name}.png")
    return import_capture(str(root), None, 100, 1000, folder / "out")


def opened(name: str) -> Callable[[Path], object]:
    """Import a case as a capture."""

    def read(folder: Path) -> object:
        root = capture(name, folder / name)
        return import_capture(str(root), None, 100, 1000, folder / "out")

    return read


def unknown_splits(folder: Path) -> object:
    """Read splits of other names, which give no captures."""
    (folder / "splits.json").write_text('{"training": ["a"], "Test": ["b"]}')
    return read_splits(folder / "splits.json", ["a", "b"])


def flat_gaussians(folder: Path) -> object:
    """Read a file of 2DGS, which has two scales."""
    vertices = PlyData.read(CASES / "splats/ref.ply")["vertex"].data
    names = [name for name in vertices.dtype.names if name != "scale_2"]
    PlyData([PlyElement.describe(repack_fields(vertices[names]), "vertex")]).write(folder / "flat.ply")
    return read_gaussians(folder / "flat.ply")


def broken_config(folder: Path) -> object:
    """Open weights whose image size no network has."""
    shutil.copytree(shipped()["toy_objects"], folder / "weights")
    (folder / "weights/SHA256SUMS").unlink()
    shutil.copy(CASES / "image_size_33/config.json", folder / "weights")
    return CompleteSplat.from_pretrained(folder / "weights")


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
    "t5_opencv_points": (opened("t5_opencv_points"), "axes=opencv"),
    "masks_empty": (without_masks, "its masks are black everywhere"),
    "fisheye_bin": (opened("fisheye_bin"), "OPENCV_FISHEYE"),
    "splits_null": (lambda folder: read_splits(CASES / "splits_null/splits.json", ["a"]), "not None"),
    "splits_unknown": (unknown_splits, "must be an object with train, val, test alone, not training, Test"),
    "2dgs": (flat_gaussians, "flat Gaussians of 2DGS"),
    "image_size_33": (broken_config, "image_size"),
    "wild_pose": (
        lambda folder: CaptureDataModule(str(CASES / "wild_pose"), image_size=SIZE).source("train").read("wild_pose"),
        "images.bin, wild_pose, frame 1: the pose is not finite in float32",
    ),
    "ref.sog": (converted("ref.sog"), f"ref.sog: SOG; `splat-transform ref.sog {UNPACKS}"),
    "minimal.ksplat": (converted("minimal.ksplat"), f"KSPLAT; `splat-transform minimal.ksplat {UNPACKS}"),
    "ref.compressed.ply": (converted("ref.compressed.ply"), "SuperSplat's compressed PLY; `splat-transform ref.c"),
    "K0": (prediction("K0"), "intrinsics of no camera: [[0, 0, 0]"),
    "size_inf": (prediction("size_inf"), "Infinity is no JSON"),
    "up_nan": (prediction("up_nan"), "NaN is no JSON"),
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
