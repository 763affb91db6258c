"""Captures of bright blobs, drawn where an independent lens model puts known points."""

import json
import logging
import re
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support import change_json, exif_turned, flip_bit, write_capture

from completesplat.data.captures import transforms_json
from completesplat.data.captures.captured_frames import CapturedFrame
from completesplat.data.captures.colmap import read_colmap
from completesplat.data.captures.module import CaptureDataModule, members
from completesplat.data.captures.transforms_json import read_photographs, read_transforms
from completesplat.data.sequences import PosedSequence
from completesplat.errors import (
    BadAnnotation,
    BadCamera,
    BadImage,
    CompleteSplatError,
    DataError,
    MissingFile,
    OutsidePath,
)
from completesplat.geometry.cameras import look_at, project
from completesplat.installation import install_command

pycolmap = pytest.importorskip("pycolmap")

POINTS = np.random.default_rng(7).uniform(-1, 1, (14, 3)) * [1.4, 0.9, 1.2]
FRAMES, WIDTH, HEIGHT = 8, 210, 150
BLOB = 1.8  # standard deviation in pixels
WINDOW = 7
SQUARE = 132  # side of the largest square around the principal point
PINHOLE = {"fl_x": 190.0, "fl_y": 205.0, "cx": 112.5, "cy": 66.0, "w": WIDTH, "h": HEIGHT}
BARREL = {"k1": -0.18, "k2": 0.04, "p1": 0.002, "p2": -0.003}
PINCUSHION = {"k1": 0.12, "k2": 0.02, "k3": 0.01, "p1": -0.002, "p2": 0.001}
MODELS = {
    "SIMPLE_PINHOLE": [200, 112.5, 66],
    "PINHOLE": [190, 205, 112.5, 66],
    "SIMPLE_RADIAL": [200, 100, 80, -0.15],
    "RADIAL": [200, 112.5, 66, 0.1, 0.03],
    "OPENCV": [190, 205, 112.5, 66, *BARREL.values()],
}
Change = Callable[[dict], object]


def opengl_poses() -> np.ndarray:
    """Camera-to-world, +x right, +y up, +z backward, on a rising arc around the origin."""
    angles = torch.linspace(0.3, 4.0, FRAMES, dtype=torch.float64)
    eyes = torch.stack([4.2 * angles.sin(), 0.6 + 0.2 * angles, 4.2 * angles.cos()], dim=-1)
    poses = look_at(eyes, torch.zeros_like(eyes), eyes.new_tensor([0.1, 1, 0])).inverse().numpy()
    return poses @ np.diag([1, -1, -1, 1])


def local_points(pose: np.ndarray) -> np.ndarray:
    """The points in OpenCV's axes of an OpenGL camera."""
    return (POINTS - pose[:3, 3]) @ pose[:3, :3] * [1, -1, -1]


def distorted_pixels(pose: np.ndarray, lens: dict[str, float]) -> np.ndarray:
    """Where a camera sees the points, by OpenCV's model, written down anew."""
    k1, k2, k3, p1, p2 = (lens.get(key, 0.0) for key in ("k1", "k2", "k3", "p1", "p2"))
    x, y = (local_points(pose)[:, :2] / local_points(pose)[:, 2:]).T
    square = x**2 + y**2
    radial = 1 + k1 * square + k2 * square**2 + k3 * square**3
    u = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2)
    v = y * radial + p1 * (square + 2 * y**2) + 2 * p2 * x * y
    return np.stack([lens["fl_x"] * u + lens["cx"], lens["fl_y"] * v + lens["cy"]], axis=1)


def draw(pixels: np.ndarray) -> Image.Image:
    """Blobs on black; the centre of the first pixel is (0.5, 0.5)."""
    offsets = (np.arange(side)[:, None] + 0.5 - place for side, place in zip((WIDTH, HEIGHT), pixels.T, strict=True))
    columns, rows = (np.exp(-(offset**2) / (2 * BLOB**2)) for offset in offsets)
    grey = np.round(230 * np.clip(rows @ columns.T, 0, 1)).astype(np.uint8)
    return Image.fromarray(np.repeat(grey[..., None], 3, axis=2))


def write_transforms(folder: Path, suffix: str = ".png", change: Change | None = None, **lens: float) -> Path:
    """A capture in `folder`, and the path of its transforms.json, whose content `change` edits."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for number, pose in enumerate(opengl_poses()):
        name = f"images/r_{number}{suffix}"
        draw(distorted_pixels(pose, PINHOLE | lens)).save(folder / name, quality=97, subsampling=0)
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    content = {**PINHOLE, **lens, "frames": frames}
    if change is not None:
        change(content)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder / "transforms.json"


def write_model(folder: Path, model: str, binary: bool = True) -> Path:
    """A capture with images drawn by COLMAP's own lens model and a model written by COLMAP; returns its folder."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, model, 200.0, WIDTH, HEIGHT)
    camera.params = MODELS.get(model, camera.params)
    reconstruction.add_camera_with_trivial_rig(camera)
    (folder / "images/left").mkdir(parents=True)
    for number, pose in enumerate(opengl_poses(), start=1):
        matrix = np.linalg.inv(pose @ np.diag([1, -1, -1, 1]))
        image = pycolmap.Image()
        image.name, image.camera_id, image.image_id = f"left/{number}.png", 1, number
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D([1.0, 2.0])] * number)
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(matrix[:3, :3]), matrix[:3, 3])
        reconstruction.add_image_with_trivial_frame(image, rigid)
        draw(camera.img_from_cam(local_points(pose))).save(folder / "images" / image.name)
    for number, point in enumerate(POINTS, start=1):
        track = pycolmap.Track()
        if number <= FRAMES:
            track.add_element(number, 0)
        reconstruction.add_point3D(point, track, np.array([10, 20, 30], dtype=np.uint8))
    (folder / "sparse/0").mkdir(parents=True)
    (reconstruction.write_binary if binary else reconstruction.write_text)(str(folder / "sparse/0"))
    return folder / "sparse/0"


def reprojection_errors(folder: Path, kind: str = "image", size: int = SQUARE) -> np.ndarray:
    """Distances in pixels between projections by the cameras and the blobs in the images or masks, in both splits."""
    data, errors = CaptureDataModule(str(folder), image_size=size), list[float]()
    for split, frames in {"train": (1, 2, 4, 5, 7), "test": (0, 3, 6)}.items():
        (name,) = data.source(split).names
        sequence = data.source(split).read(name)
        assert sequence.frames == frames
        points = sequence.scale * (POINTS - sequence.origin)
        for index in range(len(frames)):
            projected = project(sequence.cameras[index], torch.from_numpy(points))[0].numpy()
            pixels = getattr(sequence.read(index), kind)[0].numpy().astype(float)
            for number, (u, v) in enumerate(projected):
                distances = np.abs(np.delete(projected, number, axis=0) - [u, v]).max(axis=1)
                if not (10 < u < size - 10 and 10 < v < size - 10) or distances.min() < 2 * WINDOW:
                    continue
                left, top = int(u) - WINDOW, int(v) - WINDOW
                window = pixels[top : top + 2 * WINDOW + 1, left : left + 2 * WINDOW + 1]
                assert window.sum() > 1000  # there is a blob
                rows, columns = np.mgrid[: window.shape[0], : window.shape[1]] + 0.5
                blob = np.array([(window * columns).sum(), (window * rows).sum()]) / window.sum() + [left, top]
                errors.append(np.linalg.norm(blob - [u, v]))
    assert len(errors) > 20
    return np.array(errors)


def first_frame(path: Path) -> CapturedFrame:
    return read_transforms(path).frames[0]


def first_sequence(folder: Path) -> PosedSequence:
    data = CaptureDataModule(str(folder)).source("train")
    return data.read(data.names[0])


@pytest.mark.parametrize(
    ("lens", "suffix"), [({}, ".jpg"), (BARREL, ".png"), (PINCUSHION, ".png")], ids=["pinhole", "barrel", "pincushion"]
)
def test_known_points_are_where_the_cameras_of_transforms_see_them_in_images_and_masks(tmp_path, lens, suffix):
    path = write_transforms(tmp_path, suffix, **lens)
    assert reprojection_errors(tmp_path).max() < 0.1
    assert (first_sequence(tmp_path).read(2).mask == 255).all()  # Without masks, everything is foreground.

    def add_masks(content):
        for frame in content["frames"]:
            frame["mask_path"] = Path(frame["file_path"]).with_suffix(".mask.png").as_posix()
            Image.open(tmp_path / frame["file_path"]).convert("L").save(tmp_path / frame["mask_path"])

    change_json(path, add_masks)
    assert reprojection_errors(tmp_path, "mask").max() < 0.1


@pytest.mark.parametrize(("model", "binary"), [*((model, True) for model in MODELS), ("OPENCV", False)])
def test_known_points_are_where_the_cameras_of_a_colmap_model_see_them(tmp_path, model, binary):
    folder = write_model(tmp_path, model, binary)
    assert reprojection_errors(tmp_path).max() < 0.1
    points = read_colmap(folder, tmp_path / "images").points
    order, expected = np.lexsort(points.T), np.lexsort(POINTS.T)
    np.testing.assert_allclose(points[order], POINTS[expected], atol=1e-12)


def test_the_object_fills_its_half_size_and_stray_points_are_left_out(tmp_path):
    def add_points(content):
        rows = [*POINTS.tolist(), [900.0, 0.0, 0.0]]
        header = "ply\nformat ascii 1.0\nelement vertex 15\n" + "".join(f"property float {a}\n" for a in "xyz")
        text = "\n".join(" ".join(map(str, row)) for row in rows)
        (tmp_path / "sparse.ply").write_text(f"{header}end_header\n{text}\n")
        content.update(ply_file_path="sparse.ply")

    write_transforms(tmp_path, change=add_points)
    sequence = first_sequence(tmp_path / "transforms.json")
    extent = np.abs(POINTS - POINTS.mean(axis=0)).max()
    assert sequence.scale == pytest.approx(0.57 / extent, rel=0.3)  # Its axes are turned.


def test_the_field_of_view_gives_the_same_cameras_as_the_focal_length(tmp_path, caplog):
    def only_the_angle(content):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del content[key]
        content["camera_angle_x"] = 2 * float(np.arctan(105 / 190))
        for frame in content["frames"]:
            frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")

    centred = {"fl_y": 190.0, "cx": 105.0, "cy": 75.0}
    given, angle = write_transforms(tmp_path / "a", **centred), write_transforms(tmp_path / "b", change=only_the_angle)
    with caplog.at_level(logging.WARNING):
        pairs = zip(*(read_transforms(path).frames for path in (given, angle)), strict=True)
    assert caplog.text == ""
    for one, other in pairs:
        assert one.lens.focal == pytest.approx(other.lens.focal)
        assert (one.lens.center, one.lens.image_size) == (other.lens.center, other.lens.image_size)
        np.testing.assert_array_equal(one.world_to_camera, other.world_to_camera)


def test_intrinsics_of_a_frame_go_before_those_of_the_file(tmp_path):
    path = write_transforms(tmp_path, change=lambda content: content["frames"][3].update(fl_x=250.0))
    assert [frame.lens.focal[0] for frame in read_transforms(path).frames] == [190] * 3 + [250] + [190] * 4


def test_a_pincushion_shows_only_what_was_seen(tmp_path):
    path = write_transforms(tmp_path, k1=0.15)
    framed = np.full((HEIGHT, WIDTH, 3), 60, dtype=np.uint8)
    framed[2:-2, 2:-2] = inner = 250, 200, 100
    Image.fromarray(framed).save(tmp_path / "images/r_0.png")
    undistorted = np.asarray(first_frame(path).read()[0])
    assert undistorted.shape[:2] == first_frame(path).camera().image_size < (HEIGHT, WIDTH)
    assert undistorted.shape[1] < WIDTH
    assert undistorted.min() >= 60  # no blank pixels
    assert tuple(undistorted[HEIGHT // 2, WIDTH // 2]) == inner


def test_alpha_becomes_the_mask_over_white(tmp_path):
    path = write_transforms(tmp_path)
    pixels = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
    pixels[..., 0] = 100
    pixels[:, :70, 3], pixels[:, 70:140, 3] = 255, 102
    Image.fromarray(pixels).save(tmp_path / "images/r_0.png")
    image, mask = map(np.asarray, first_frame(path).read())
    np.testing.assert_array_equal(mask, pixels[..., 3])
    # 0.4 of (100, 0, 0) and 0.6 of white.
    assert [image[9, x].tolist() for x in (10, 100, 200)] == [[100, 0, 0], [193, 153, 153], [255, 255, 255]]


@pytest.mark.parametrize("name", ["{}.png.png", "{}.png"])
def test_masks_of_a_colmap_model_have_the_names_of_their_images(tmp_path, name):
    model = write_model(tmp_path, "PINHOLE")
    (tmp_path / "masks/left").mkdir(parents=True)
    for number in range(1, 9):
        Image.new("L", (WIDTH, HEIGHT), 20 * number).save(tmp_path / "masks/left" / name.format(number))
    sequence = first_sequence(tmp_path)
    assert [int(sequence.read(index).mask[0, 3, 4]) for index in range(5)] == [40, 60, 100, 120, 160]
    for path in (tmp_path / "masks/left").iterdir():
        path.unlink()
    with pytest.raises(DataError, match=r"left/1\.png\.png, frame 1: no such file, nor 1\.png"):
        read_colmap(model, tmp_path / "images", tmp_path / "masks")


def test_frames_without_an_image_are_named_and_left_out(tmp_path, caplog):
    path = write_transforms(tmp_path)
    for number in (2, 5):
        (tmp_path / f"images/r_{number}.png").unlink()
    frames = read_transforms(path).frames
    named = "images/r_2.png, images/r_5.png"
    assert f"{path}: 2 of 8 frames have no image and are left out: {named}" in caplog.text
    centers = [np.linalg.inv(frame.world_to_camera)[:3, 3] for frame in frames]
    np.testing.assert_allclose(centers, opengl_poses()[[0, 1, 3, 4, 6, 7], :3, 3], atol=1e-9)


def test_a_missing_frame_costs_one_resolved_path(tmp_path, monkeypatch):
    """Resolving the links of every ending that an image may have took a minute for 100,000 missing frames."""
    write_capture(tmp_path, 6)
    gone = [{"file_path": f"gone/{number}", "transform_matrix": np.eye(4).tolist()} for number in range(50)]
    change_json(tmp_path / "transforms.json", lambda content: content["frames"].extend(gone))
    resolved, path_below = [], transforms_json.path_below
    monkeypatch.setattr(transforms_json, "path_below", lambda *given: resolved.append(given) or path_below(*given))
    assert len(read_transforms(tmp_path / "transforms.json").frames) == 6
    assert len(resolved) <= 6 + 50


def test_every_eighth_frame_is_held_out_and_three_at_least_are_on_either_side():
    assert members(8, True, 40) == [0, 8, 16, 24, 32]
    assert members(8, True, 16) == [0, 7, 14]
    for frames, hold_out in product(range(6, 40), (2, 3, 8, 1000)):
        training, held_out = members(hold_out, False, frames), members(hold_out, True, frames)
        assert sorted(training + held_out) == list(range(frames))
        assert min(len(training), len(held_out)) >= 3


def test_frames_stand_in_the_order_of_the_numbers_in_their_names(tmp_path):
    def rename(content):
        (tmp_path / "images/r_3.png").rename(tmp_path / "images/r_10.png")
        content["frames"][3].update(file_path="images/r_10.png")
        content["frames"].reverse()

    frames = read_transforms(write_transforms(tmp_path, change=rename)).frames
    assert [frame.image.name for frame in frames] == [f"r_{number}.png" for number in (0, 1, 2, 4, 5, 6, 7, 10)]


def test_captures_in_folders_are_sequences_and_broken_ones_are_counted(tmp_path):
    for name in ("kitchen table", "b", "c"):
        path = write_transforms(tmp_path / name)
    (tmp_path / "empty").mkdir()
    path.write_text("{}")
    data = CaptureDataModule(str(tmp_path), batch_size=2)
    source = data.source("train")
    assert (source.names, source.listed) == (["b", "kitchen table"], 3)
    assert [(error.file, error.sequence) for error in source.refused] == [(str(path), "c")]
    data.setup("fit")
    fingerprint = source.fingerprint()
    (tmp_path / "b/transforms.json").unlink()
    other = CaptureDataModule(str(tmp_path)).source("train")
    assert other.names == ["kitchen table"]
    assert other.fingerprint() != fingerprint
    with pytest.raises(BadAnnotation, match=r"c/transforms\.json, c: no frames"):
        CaptureDataModule(str(tmp_path / "c")).source("train")
    for name, reason in {"empty": "no cameras there", "nowhere": "no such file or folder"}.items():
        with pytest.raises(MissingFile, match=f"{name}: {reason}"):
            CaptureDataModule(str(tmp_path / name)).source("train")


def test_photographs_have_the_cameras_of_their_squares(tmp_path):
    numbers = [2, 0, 5]
    for lens in ({}, {"k1": -0.1}):
        folder = tmp_path / f"{len(lens)}"
        path = write_transforms(folder, **lens)
        views = read_photographs([folder / f"images/r_{n}.png" for n in numbers], path, 75)
        poses = opengl_poses()[numbers]
        assert views.cameras.world_to_camera[0].allclose(torch.eye(4), atol=1e-5)
        projected = project(views.cameras, torch.from_numpy(local_points(poses[0])).float())[0].numpy()
        for image, pixels, pose in zip(views.images, projected, poses, strict=True):
            if not lens:
                expected = (distorted_pixels(pose, PINHOLE) - [(WIDTH - HEIGHT) / 2, 0]) * 75 / HEIGHT
                np.testing.assert_allclose(pixels, expected, atol=1e-3)
            inside = pixels[((pixels > 3) & (pixels < 72)).all(1)].astype(int)
            assert (image[0, inside[:, 1], inside[:, 0]] > 0.5).all()
    with pytest.raises(CompleteSplatError, match=r"r_0.png: .*transforms.json has no frame with this image"):
        read_photographs([tmp_path / "0/images/r_0.png"], path, 32)


IMAGES = {
    "upside down by EXIF": (lambda path: Image.open(path).save(path, exif=exif_turned(3)), r"EXIF orientation 3"),
    "damaged": (flip_bit, "cannot be decoded"),
    "of another size": (lambda path: Image.new("RGB", (WIDTH, 9)).save(path), "has 9 x 210 pixels"),
    "of another size, with alpha": (lambda path: Image.new("RGBA", (HEIGHT, WIDTH)).save(path), "has 210 x 150 pixels"),
}


@pytest.mark.parametrize(("damage", "message"), IMAGES.values(), ids=IMAGES)
def test_a_bad_image_is_refused(tmp_path, damage, message):
    write_transforms(tmp_path)
    damage(tmp_path / "images/r_5.png")
    sequence = first_sequence(tmp_path)
    with pytest.raises(BadImage, match=rf"images/r_5\.png, {tmp_path.name}, frame 5: .*{message}"):
        sequence.read(3)


@pytest.mark.parametrize("k1", [-4.0, -1.0, 4.0, 1e15])
def test_distortion_that_leaves_no_image_is_refused(tmp_path, k1):
    write_transforms(tmp_path, change=lambda content: content.update(k1=k1))
    with pytest.raises(BadCamera, match=r"r_0\.png, .*, frame 0: distortion .* leaves no usable image"):
        first_sequence(tmp_path)


def replaced(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    return lambda content: content.replace(old, new)


LENS = r"cameras\.\w+: camera model .* is not supported"
# a fault: (file, change of its content, error, message)
COLMAP = {
    "an image outside": ("images.txt", replaced(b"left/3.png", b"../3.png"), OutsidePath, "frame 3: leads outside"),
    "an image twice": ("images.txt", replaced(b"left/3.png", b"left/4.png"), DataError, "frame 4: the same image"),
    "a word for a number": ("points3D.txt", lambda content: b"1 2 three\n", DataError, r"points3D\.txt"),
    "another lens": ("cameras.txt", replaced(b"PINHOLE", b"FOV"), BadCamera, LENS),
    "another lens in binary": ("cameras.bin", lambda content: content[:12] + b"\x08" + content[13:], BadCamera, LENS),
}


@pytest.mark.parametrize(("file", "change", "kind", "message"), COLMAP.values(), ids=COLMAP)
def test_a_bad_model_of_colmap_is_refused(tmp_path, file, change, kind, message):
    model = write_model(tmp_path, "PINHOLE", binary=file.endswith(".bin"))
    (model / file).write_bytes(change((model / file).read_bytes()))
    with pytest.raises(kind, match=message):
        read_colmap(model, tmp_path / "images")


def test_missing_images_are_left_out_and_a_folder_or_file_that_is_missing_is_refused(tmp_path, caplog):
    model, images = write_model(tmp_path, "PINHOLE", binary=False), tmp_path / "images"
    for number in (3, 5):
        (images / f"left/{number}.png").unlink()
    assert [frame.number for frame in read_colmap(model, images).frames] == [1, 2, 4, 6, 7, 8]
    assert "images.txt: 2 of 8 frames have no image and are left out: left/3.png, left/5.png" in caplog.text
    with pytest.raises(MissingFile, match="nowhere: no such folder"):
        read_colmap(model, tmp_path / "nowhere")
    (model / "points3D.txt").unlink()
    with pytest.raises(MissingFile, match=r"points3D\.txt: no such file"):
        read_colmap(model, images)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_file_that_a_binary_model_lacks_is_named_and_a_whole_text_model_is_read_instead(tmp_path, file):
    model, images = write_model(tmp_path, "PINHOLE"), tmp_path / "images"
    frames = len(read_colmap(model, images).frames)
    (model / file).unlink()
    with pytest.raises(MissingFile, match=f"{file}: no such file"):
        read_colmap(model, images)
    for text in write_model(tmp_path / "text", "PINHOLE", binary=False).glob("*.txt"):
        text.rename(model / text.name)
    assert len(read_colmap(model, images).frames) == frames


def test_pycolmap_is_needed_for_distorted_lenses_only(monkeypatch, tmp_path):
    write_model(tmp_path / "plain", "PINHOLE")
    write_transforms(tmp_path / "barrel", **BARREL)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    first_sequence(tmp_path / "plain").read(0)
    with pytest.raises(CompleteSplatError, match=re.escape(install_command("colmap"))):
        first_sequence(tmp_path / "barrel")
