"""Captures as people really bring them: each is read as the same cameras as the plain capture that it was made from."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from realestate10k_trees import make_clip, module, write_tree
from support import change_json, exif_turned

from completesplat.baselines.fitting import gaussians_at_points
from completesplat.data.captures.colmap import read_colmap
from completesplat.data.captures.importing import import_capture
from completesplat.data.captures.module import CaptureDataModule
from completesplat.data.captures.transforms_json import read_photographs, read_transforms
from completesplat.data.sequences import PosedSequence
from completesplat.errors import BadCamera, BadImage, BadPlacement, MissingFile
from completesplat.geometry.cameras import Cameras, look_at
from completesplat.scene import Views

FRAMES, WIDTH, HEIGHT = 8, 16, 12
POINTS = np.random.default_rng(2).uniform(-1, 1, (40, 3))
FAR = np.array([447123.3, 5411876.4, 312.5])  # UTM coordinates in metres
Change = Callable[[Path], object]


def world_to_camera() -> np.ndarray:
    """Cameras on a circle that look at the origin, [frame 4 4] in OpenCV's axes."""
    angles = torch.arange(FRAMES, dtype=torch.float64) * 2 * torch.pi / FRAMES
    eyes = torch.stack([3 * angles.cos(), 3 * angles.sin(), torch.full_like(angles, 1.2)], dim=-1)
    return look_at(eyes, torch.zeros(3).double(), torch.tensor([0, 0, 1.0]).double()).numpy()


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """The quaternion (w, x, y, z) of a rotation, as the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = [[a + e + i, h - f, c - g, d - b], [h - f, a - e - i, b + d, c + g]]
    matrix += [[c - g, b + d, e - a - i, f + h], [d - b, c + g, f + h, i - a - e]]
    return np.linalg.eigh(np.array(matrix))[1][:, -1]


def write_images(folder: Path) -> None:
    for number in range(FRAMES):
        pixels = np.full((HEIGHT, WIDTH, 3), 20 + 20 * number, np.uint8)
        pixels[: HEIGHT // 2] //= 2  # the upper half is dark, so that a turn shows
        (folder / f"{number}.png").parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(folder / f"{number}.png")


def write_colmap(folder: Path, shift: np.ndarray | float = 0.0) -> None:
    """A text model and its images, with the world's origin moved by -`shift`."""
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    write_images(folder / "images")
    (model / "cameras.txt").write_text(f"# cameras\n1 PINHOLE {WIDTH} {HEIGHT} 19 19.5 8 6\n")
    lines = ["# images"]
    for number, pose in enumerate(world_to_camera()):
        numbers = *quaternion(pose[:3, :3]), *(pose[:3, 3] - pose[:3, :3] @ (np.zeros(3) + shift))
        lines += [f"{number + 1} {' '.join(map(repr, map(float, numbers)))} 1 {number}.png", "1.5 2.5 -1"]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    rows = (f"{number} {x} {y} {z} 9 9 9 0.5 1 0\n" for number, (x, y, z) in enumerate(POINTS + shift))
    (model / "points3D.txt").write_text("".join(rows))


def write_transforms(folder: Path, shift: np.ndarray | float = 0.0, digits: int = 17) -> None:
    write_images(folder / "images")
    frames = []
    for number, pose in enumerate(np.linalg.inv(world_to_camera())):
        pose[:3, :3] = np.round(pose[:3, :3] * [1, -1, -1], digits)
        pose[:3, 3] += shift
        frames.append({"file_path": f"images/{number}.png", "transform_matrix": pose.tolist()})
    lens = {"fl_x": 19, "fl_y": 19.5, "w": WIDTH, "h": HEIGHT}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))


def sequence(folder: Path, split: str = "train") -> PosedSequence:
    source = CaptureDataModule(str(folder), image_size=HEIGHT).source(split)
    return source.read(source.names[0])


def must_agree(one: PosedSequence, other: PosedSequence, tolerance: float = 1e-7) -> None:
    """Check that two captures have the same frames, cameras and points."""
    assert one.frames == other.frames
    assert one.scale == pytest.approx(other.scale, rel=tolerance)
    for name in ("world_to_camera", "intrinsics"):
        actual, expected = (getattr(sequence.cameras, name) for sequence in (one, other))
        torch.testing.assert_close(actual, expected, atol=tolerance, rtol=tolerance)
    if other.points is not None:
        torch.testing.assert_close(one.points, other.points, atol=1e-6, rtol=0)


@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_a_capture_far_from_the_origin_is_the_same_as_at_the_origin(tmp_path, write):
    write(tmp_path / "near/a")
    write(tmp_path / "far/a", FAR)
    near, far = (sequence(tmp_path / name / "a") for name in ("near", "far"))
    must_agree(far, near)
    np.testing.assert_allclose(np.subtract(far.origin, near.origin), FAR, atol=1e-8)


def test_rotations_of_six_digits_move_no_camera_far_from_the_origin(tmp_path):
    write_transforms(tmp_path / "near")
    write_transforms(tmp_path / "far", FAR, digits=6)
    must_agree(sequence(tmp_path / "far"), sequence(tmp_path / "near"), 1e-5)


def test_the_first_gaussians_have_the_same_size_wherever_the_points_are():
    views = Views(
        torch.zeros(1, 3, 8, 8), Cameras(torch.eye(4)[None], torch.eye(3)[None], (8, 8)), torch.ones(1, 1, 8, 8)
    )
    points = torch.randint(-64, 64, (60, 3), generator=torch.Generator().manual_seed(0)) / 64
    near, far = (gaussians_at_points(points + shift, views, 0.1).log_scales for shift in (0, 8192))  # exact sums
    torch.testing.assert_close(far, near)


def test_photographs_far_from_the_origin_have_the_same_relative_cameras(tmp_path):
    for name, shift in (("near", 0.0), ("far", FAR)):
        write_transforms(tmp_path / name, shift)
    near, far = (
        read_photographs([tmp_path / name / f"images/{i}.png" for i in (0, 3)], tmp_path / name / "transforms.json", 12)
        for name in ("near", "far")
    )
    torch.testing.assert_close(far.cameras.world_to_camera, near.cameras.world_to_camera)


def lines_of_images(change: Callable[[list[str]], list[str]]) -> Change:
    """A change to the lines of `images.txt`."""

    def edit(folder: Path) -> None:
        path = folder / "sparse/0/images.txt"
        path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")

    return edit


def rename_with_two_spaces(folder: Path) -> None:
    (folder / "images/3.png").rename(folder / "images/3  b.png")
    lines_of_images(lambda lines: [line.replace("3.png", "3  b.png  ") for line in lines])(folder)


def write_byte_order_marks(folder: Path) -> None:
    for path in (folder / "sparse/0").iterdir():
        path.write_text(path.read_text(), encoding="utf-8-sig")


def write_windows_paths(folder: Path) -> None:
    (folder / "images/left").mkdir()
    for number in range(FRAMES):
        (folder / f"images/{number}.png").rename(folder / f"images/left/{number}.png")
    lines_of_images(lambda lines: [line.replace(" 1 ", " 1 left\\") for line in lines])(folder)


COLMAP: dict[str, Change] = {
    "a blank line first": lines_of_images(lambda lines: ["", *lines]),
    "a blank line behind the comment": lines_of_images(lambda lines: [lines[0], "", *lines[1:]]),
    "blank lines between images": lines_of_images(
        lambda lines: [part for line in lines for part in ((line, "") if line.startswith("1.5") else (line,))]
    ),
    "images without features": lines_of_images(
        lambda lines: ["" if line.startswith("1.5") else line for line in lines]
    ),
    "Windows' line ends": lines_of_images(lambda lines: [f"{line}\r" for line in lines]),
    "two spaces in a name": rename_with_two_spaces,
    "byte order marks": write_byte_order_marks,
    "backslashes in names": write_windows_paths,
}


def test_images_without_lines_for_their_features_are_all_read(tmp_path):
    write_colmap(tmp_path / "all")
    write_colmap(tmp_path / "none")
    lines_of_images(lambda lines: [line for line in lines if not line.startswith("1.5")])(tmp_path / "none")
    must_agree(sequence(tmp_path / "none"), sequence(tmp_path / "all"))


def test_a_full_lens_of_opencv_keeps_all_its_coefficients(tmp_path):
    write_colmap(tmp_path)
    lens = f"1 FULL_OPENCV {WIDTH} {HEIGHT} 19 19.5 8 6 0.1 0.2 0.3 0.4 0.5 0.6 0.7 0.8\n"
    (tmp_path / "sparse/0/cameras.txt").write_text(lens)
    capture = read_colmap(tmp_path / "sparse/0", tmp_path / "images")
    assert capture.frames[0].lens.distortion == (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)


@pytest.mark.parametrize(("listed", "suffix"), [("", ".png"), (".PNG", ".png"), (".png", ".PNG"), ("", ".PNG")])
@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_photos_are_found_whatever_the_case_of_their_suffix_and_without_one(tmp_path, write, listed, suffix):
    write(tmp_path / "a")
    expected = sequence(tmp_path / "a")
    for path in sorted((tmp_path / "a/images").iterdir()):
        path.rename(path.with_suffix(suffix))
    for path in (tmp_path / "a/sparse/0/images.txt", tmp_path / "a/transforms.json"):
        if path.is_file():
            path.write_text(path.read_text().replace(".png", listed))
    must_agree(sequence(tmp_path / "a"), expected)


def poses_changed(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    def edit(content) -> None:
        for frame in content["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    change_json(folder / "transforms.json", edit)


OTHERS = {
    "axes=opencv matrices=camera_to_world": lambda pose: pose * [1, -1, -1, 1],
    "axes=opengl matrices=world_to_camera": np.linalg.inv,
    "axes=opencv matrices=world_to_camera": lambda pose: np.linalg.inv(pose * [1, -1, -1, 1]),
}


@pytest.mark.parametrize("settings", OTHERS)
@pytest.mark.parametrize("with_points", [False, True])
def test_cameras_that_look_away_are_refused_with_the_settings_that_turn_them(tmp_path, settings, with_points):
    write_transforms(tmp_path / "a")
    if with_points:
        write_cloud(tmp_path / "a/points.ply", POINTS)
        change_json(tmp_path / "a/transforms.json", lambda content: content | {"ply_file_path": "points.ply"})
    expected = sequence(tmp_path / "a")
    poses_changed(tmp_path / "a", OTHERS[settings])
    with pytest.raises(BadPlacement, match=settings):
        sequence(tmp_path / "a")
    axes, matrices = (part.partition("=")[2] for part in settings.split())
    import_capture(str(tmp_path / "a"), None, 100, 1000, tmp_path / "out", axes, matrices)
    must_agree(sequence(tmp_path / "out/a"), expected, 1e-6)


def write_cloud(path: Path, points: np.ndarray) -> None:
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    rows = "\n".join(" ".join(map(repr, row)) for row in points.tolist())
    path.write_text(header + "".join(f"property double {axis}\n" for axis in "xyz") + f"end_header\n{rows}\n")


def test_rotations_that_are_nearly_right_are_made_right_with_a_word(tmp_path, caplog):
    write_transforms(tmp_path)
    expected = sequence(tmp_path)
    poses_changed(tmp_path, lambda pose: pose * [0.99, 0.99, 0.99, 1])
    must_agree(sequence(tmp_path), expected)
    assert "rotations are not orthonormal (R R^T - I up to 0.02) and are made so" in caplog.text
    poses_changed(tmp_path, lambda pose: pose * [0.9, 0.9, 0.9, 1])
    with pytest.raises(BadCamera, match="is not orthonormal"):
        sequence(tmp_path)


def test_intrinsics_of_another_size_than_the_photos_are_refused(tmp_path):
    write_transforms(tmp_path)
    change_json(tmp_path / "transforms.json", lambda content: content | {"cx": 0.13 * WIDTH, "cy": 0.13 * HEIGHT})
    with pytest.raises(BadCamera, match=r"principal point .* the intrinsics are of another size"):
        sequence(tmp_path)


@pytest.mark.parametrize("first", ["https://video.example/watch?v=x\n", "x\n", "\n", ""])
def test_a_clip_of_realestate10k_has_its_first_frame_with_and_without_the_line_of_its_address(tmp_path, first):
    clip = make_clip("a")
    root = write_tree(tmp_path, "text", [clip], [clip])
    text = root / "test/a.txt"
    text.write_text(first + text.read_text().split("\n", 1)[1])
    read = module(root).source("test").read("a")
    assert read.frames == tuple(range(6))
    expected = torch.from_numpy(clip.rows[:, 6:].reshape(-1, 3, 4)).double()
    torch.testing.assert_close(read.cameras.world_to_camera[:, :3], expected)


def test_points_that_float32_cannot_hold_are_left_out_with_a_word(tmp_path, caplog):
    write_colmap(tmp_path)
    expected = sequence(tmp_path)
    with (tmp_path / "sparse/0/points3D.txt").open("a") as file:
        file.write("98 1e200 0 0 9 9 9 0.5\n99 0 -1e30 0 9 9 9 0.5\n")
    must_agree(sequence(tmp_path), expected, 0.2)  # the median is another
    assert sequence(tmp_path).points.shape == expected.points.shape
    assert "2 of 42 points are more than 100,000 scene radii away and are left out" in caplog.text


def resave(folder: Path, change: Callable[[Image.Image], Image.Image], orientation: int = 1, suffix: str = "") -> None:
    """Change all images, and tag them to be turned."""
    for path in sorted((folder / "images").iterdir()):
        change(Image.open(path)).save(path.with_suffix(suffix or path.suffix), exif=exif_turned(orientation))


def resized(width: int, height: int) -> Callable[[Image.Image], Image.Image]:
    return lambda image: image.resize((width, height), Image.Resampling.NEAREST)


@pytest.mark.parametrize("write", [write_colmap, write_transforms])
@pytest.mark.parametrize("factor", [2, 0.5])
def test_images_of_another_size_have_scaled_cameras(tmp_path, write, factor):
    write(tmp_path)
    expected = sequence(tmp_path)
    images = [expected.read(index).image for index in range(len(expected.frames))]
    resave(tmp_path, resized(int(factor * WIDTH), int(factor * HEIGHT)))
    must_agree(sequence(tmp_path), expected, 1e-12)
    for index, image in enumerate(images):
        assert (sequence(tmp_path).read(index).image - image.float()).abs().mean() < 9


def test_sides_may_be_rounded_and_each_has_its_own_factor(tmp_path):
    write_transforms(tmp_path)
    resave(tmp_path, resized(11, 8))  # 2/3 of 16 x 12 are 10.67 x 8
    lens = read_transforms(tmp_path / "transforms.json").frames[0].lens
    assert lens.focal == pytest.approx((19 * 11 / 16, 19.5 * 8 / 12))
    assert lens.center == pytest.approx((5.5, 4))


TURN_BACK = {3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}


@pytest.mark.parametrize(("write", "orientation"), [(write_colmap, 3), (write_colmap, 6), (write_transforms, 6)])
def test_poses_are_of_the_stored_pixels_where_their_size_is_the_cameras(tmp_path, write, orientation):
    write(tmp_path)
    expected = sequence(tmp_path).read(0).image
    resave(tmp_path, lambda image: image, orientation)
    assert torch.equal(sequence(tmp_path).read(0).image, expected)


@pytest.mark.parametrize("factor", [1, 2])
@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_poses_are_of_the_upright_image_where_its_size_is_the_cameras(tmp_path, write, factor):
    write(tmp_path)
    expected = sequence(tmp_path).read(0).image.float()
    change = resized(factor * WIDTH, factor * HEIGHT)
    resave(tmp_path, lambda image: change(image).transpose(TURN_BACK[6]), 6)
    assert (sequence(tmp_path).read(0).image - expected).abs().mean() < 9


def test_photographs_with_stored_pixels_are_not_turned(tmp_path):
    write_transforms(tmp_path)
    given = [tmp_path / "images/3.png"], tmp_path / "transforms.json", HEIGHT
    expected = read_photographs(*given).images
    resave(tmp_path, lambda image: image, 6)
    torch.testing.assert_close(read_photographs(*given).images, expected)


def test_windows_separators_lead_to_the_images(tmp_path):
    write_transforms(tmp_path)
    expected = sequence(tmp_path)
    file = tmp_path / "transforms.json"
    file.write_text(file.read_text().replace("images/", r"images\\"))
    must_agree(sequence(tmp_path), expected)


def without_size(content: dict) -> None:
    del content["w"], content["h"]


@pytest.mark.parametrize(
    ("orientation", "size", "change", "reason"),
    [
        (3, (WIDTH, HEIGHT), None, "EXIF orientation 3"),
        (6, (WIDTH, HEIGHT), without_size, "EXIF orientation 6"),
        (6, (12, 12), lambda content: content.update(w=12), "EXIF orientation 6"),
        (1, (WIDTH, 9), None, "has 9 x 16 pixels, its camera 12 x 16"),
    ],
)
def test_import_names_photos_whose_pixels_are_not_the_cameras(tmp_path, orientation, size, change, reason):
    write_transforms(tmp_path)
    resave(tmp_path, resized(*size), orientation)
    if change:
        change_json(tmp_path / "transforms.json", change)
    with pytest.raises(BadImage, match=rf"images/0\.png, .*frame 0: .*{reason}"):
        import_capture(str(tmp_path), None, 100, 1000, tmp_path / "out")


def test_import_names_a_turned_tiff_and_a_mask_of_another_shape(tmp_path):
    write_transforms(tmp_path)
    resave(tmp_path, lambda image: image, 6, ".tif")
    text = (tmp_path / "transforms.json").read_text()
    (tmp_path / "transforms.json").write_text(text.replace(".png", ".tif"))
    with pytest.raises(BadImage, match=r"0\.tif, .*EXIF orientation 6"):
        import_capture(str(tmp_path), None, 100, 1000, tmp_path / "out")
    (tmp_path / "transforms.json").write_text(text.replace('"transform', '"mask_path": "m.png", "transform'))
    Image.new("L", (9, 9), 255).save(tmp_path / "m.png")
    with pytest.raises(BadImage, match=r"m\.png, .*has 9 x 9 pixels"):
        import_capture(str(tmp_path), None, 100, 1000, tmp_path / "out")
    Image.new("L", (2 * WIDTH, 2 * HEIGHT), 255).save(tmp_path / "m.png")
    import_capture(str(tmp_path), None, 100, 1000, tmp_path / "out")
    assert sequence(tmp_path).read(0).mask.min() == 255


def move(old: str, new: str) -> Change:
    """Move a file or folder."""

    def edit(folder: Path) -> None:
        (folder / new).parent.mkdir(parents=True, exist_ok=True)
        (folder / old).rename(folder / new)

    return edit


def in_turn(*changes: Change) -> Change:
    return lambda folder: [change(folder) for change in changes]


def add_smaller_model(folder: Path) -> None:
    """COLMAP's first model has half of the images, and the second all."""
    move("sparse/0", "sparse/1")(folder)
    shutil.copytree(folder / "sparse/1", folder / "sparse/0")
    lines_of_images(lambda lines: lines[:9])(folder)


LAYOUTS: dict[str, Change] = {
    "sparse": in_turn(move("sparse/0", "model"), lambda folder: (folder / "sparse").rmdir(), move("model", "sparse")),
    "a larger sparse/1": add_smaller_model,
    "nerfstudio's colmap/sparse/0": move("sparse", "colmap/sparse"),
    "COLMAP's dense/0": in_turn(move("sparse/0", "dense/0/sparse"), move("images", "dense/0/images")),
    "dense": in_turn(move("sparse/0", "dense/sparse"), move("images", "dense/images")),
}


@pytest.mark.parametrize("change", (COLMAP | LAYOUTS).values(), ids=COLMAP | LAYOUTS)
def test_a_model_of_colmap_is_read_whole_in_the_forms_and_folders_that_programs_make(tmp_path, change):
    write_colmap(tmp_path)
    expected = sequence(tmp_path)
    change(tmp_path)
    must_agree(sequence(tmp_path), expected)
    assert sequence(tmp_path).read(0).image.shape == (3, HEIGHT, HEIGHT)


def test_the_larger_of_several_models_is_named(tmp_path, caplog):
    write_colmap(tmp_path)
    add_smaller_model(tmp_path)
    sequence(tmp_path)
    assert f"{tmp_path}/sparse/1: the largest of 2 models, with 8 images" in caplog.text


def test_a_folder_of_nerf_synthetic_is_a_capture_of_its_training_images(tmp_path):
    write_transforms(tmp_path)
    expected = sequence(tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    move("images", "train")(tmp_path)
    for frame in content["frames"]:
        frame["file_path"] = f"./train/{Path(frame['file_path']).stem}"
    for split in ("train", "val", "test"):
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(content))
    (tmp_path / "transforms.json").unlink()
    must_agree(sequence(tmp_path), expected)


@pytest.mark.parametrize("kind", ["", "corrected_"])
def test_keyframes_of_polycam_are_a_capture(tmp_path, kind):
    write_transforms(tmp_path)
    expected = sequence(tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").unlink()
    cameras = tmp_path / f"keyframes/{kind}cameras"
    cameras.mkdir(parents=True)
    move("images", f"keyframes/{kind}images")(tmp_path)
    for number, frame in enumerate(content["frames"]):
        entry = {f"t_{row}{column}": frame["transform_matrix"][row][column] for row in range(3) for column in range(4)}
        entry = {key: int(value) if value == int(value) else value for key, value in entry.items()}
        entry |= {"fx": 19, "fy": 19.5, "cx": 8, "cy": 6, "width": WIDTH, "height": HEIGHT, "blur_score": 80}
        (cameras / f"{number}.json").write_text(json.dumps(entry))
    must_agree(sequence(tmp_path), expected)
    assert len(sequence(tmp_path).read(0).image)


def test_a_model_without_images_is_refused_and_takes_none_from_outside(tmp_path):
    write_colmap(tmp_path / "a")
    move("a/images", "images")(tmp_path)
    with pytest.raises(MissingFile, match=r"a/images, a: no such folder"):
        sequence(tmp_path / "a")
