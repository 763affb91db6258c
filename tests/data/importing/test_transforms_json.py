"""transforms.json: what is written shows the scene where its cameras say."""

import json
import logging

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

from completesplat.data.importing import import_capture
from completesplat.data.validation import MissingFile

LENSES = {
    "a pinhole off the centre": {},
    "a barrel": {"k1": -0.18, "k2": 0.04, "p1": 0.002, "p2": -0.003},
    "a pincushion": {"k1": 0.12, "k2": 0.02, "k3": 0.01, "p1": -0.002, "p2": 0.001},
}


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_known_points_are_where_the_written_cameras_see_them(captures, tmp_path, lens, suffix):
    shot = captures.Shot(**lens)
    category = import_capture(
        tmp_path / "out", "desk", captures.write_transforms(tmp_path / "in", shot, suffix), progress=False
    )
    errors = captures.reprojection_errors(category, captures.POINTS)
    assert len(errors) > 20
    assert errors.max() < 0.1


def test_the_field_of_view_gives_the_same_cameras_as_the_focal_length(captures, tmp_path):
    shot = captures.Shot(focal=(190.0, 190.0), center=(105.0, 75.0))
    given = captures.write_transforms(tmp_path / "a", shot)
    angle = captures.write_transforms(tmp_path / "b", shot)

    def only_the_angle(content):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del content[key]
        content["camera_angle_x"] = 2 * float(np.arctan(105 / 190))
        for frame in content["frames"]:
            frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")

    captures.edit(angle, only_the_angle)
    folders = [import_capture(tmp_path / "out", n, p, progress=False) for n, p in (("a", given), ("b", angle))]
    for one, other in zip(*map(captures.annotations, folders), strict=True):
        for key in ("R", "T", "focal_length", "principal_point"):
            np.testing.assert_allclose(one["viewpoint"][key], other["viewpoint"][key], atol=1e-12)


def test_intrinsics_of_a_frame_go_before_those_of_the_file(captures, tmp_path):
    path = captures.write_transforms(tmp_path / "in", captures.Shot())
    captures.edit(path, lambda content: content["frames"][3].update(fl_x=250.0))
    entries = captures.annotations(import_capture(tmp_path / "out", "desk", path, progress=False))
    assert [entry["viewpoint"]["focal_length"][0] * 105 for entry in entries] == pytest.approx(
        [190] * 3 + [250] + [190] * 4
    )


@pytest.mark.parametrize("k1", [0.0, -0.1, 0.1])
def test_nothing_is_mirrored(captures, tmp_path, k1):
    path = captures.write_transforms(tmp_path / "in", captures.Shot(k1=k1))
    picture = np.zeros((150, 210, 3), dtype=np.uint8)
    picture[:75, :105], picture[:75, 105:], picture[75:, :105] = (200, 0, 0), (0, 200, 0), (0, 0, 200)
    Image.fromarray(picture).save(tmp_path / "in/images/r_0.png")
    category = import_capture(tmp_path / "out", "desk", path, progress=False)
    written = captures.pixels_of(category, captures.annotations(category)[0])
    height, width = written.shape[:2]
    quarters = [written[y, x].tolist() for y in (height // 4, height * 3 // 4) for x in (width // 4, width * 3 // 4)]
    assert quarters == [[200, 0, 0], [0, 200, 0], [0, 0, 200], [0, 0, 0]]


def test_pictures_without_distortion_are_copied_byte_for_byte(captures, tmp_path):
    path = captures.write_transforms(tmp_path / "in", captures.Shot(), ".jpg")
    category = import_capture(tmp_path / "out", "desk", path, progress=False)
    for number, entry in enumerate(captures.annotations(category)):
        source = tmp_path / f"in/images/r_{number}.jpg"
        assert (tmp_path / "out" / entry["image"]["path"]).read_bytes() == source.read_bytes()


def test_a_pincushion_shows_only_what_was_seen(captures, tmp_path):
    path = captures.write_transforms(tmp_path / "in", captures.Shot(k1=0.15))
    framed = np.full((150, 210, 3), 255, dtype=np.uint8)
    framed[:2], framed[-2:], framed[:, :2], framed[:, -2:] = 60, 60, 60, 60
    Image.fromarray(framed).save(tmp_path / "in/images/r_0.png")
    category = import_capture(tmp_path / "out", "desk", path, progress=False)
    written = captures.pixels_of(category, captures.annotations(category)[0])
    # The frame of two pixels is neither repeated nor cut off on any side.
    middle = written.shape[0] // 2, written.shape[1] // 2
    for line in (written[:, middle[1], 0], written[middle[0], :, 0]):
        assert min(line[:4].min(), line[-4:].min()) >= 55
        assert (line < 200).sum() <= 6
    assert written.shape[0] < 150
    assert written.shape[1] < 210


def test_alpha_becomes_the_mask_over_white(captures, tmp_path):
    path = captures.write_transforms(tmp_path / "in", captures.Shot())
    pixels = np.zeros((150, 210, 4), dtype=np.uint8)
    pixels[..., 0] = 100
    pixels[:, :70, 3], pixels[:, 70:140, 3] = 255, 102
    for number in range(8):
        Image.fromarray(pixels).save(tmp_path / f"in/images/r_{number}.png")
    category = import_capture(tmp_path / "out", "desk", path, progress=False)
    entry = captures.annotations(category)[2]
    np.testing.assert_array_equal(captures.pixels_of(category, entry, "mask"), pixels[..., 3])
    image = captures.pixels_of(category, entry)
    assert image.shape == (150, 210, 3)
    # 0.4 of (100, 0, 0) and 0.6 of white.
    assert [image[9, x].tolist() for x in (10, 100, 200)] == [[100, 0, 0], [193, 153, 153], [255, 255, 255]]
    assert entry["mask"]["mass"] == pytest.approx(150 * 70 * 1.4)


@pytest.mark.parametrize("k1", [0.0, 0.15])
def test_masks_go_the_way_of_their_pictures(captures, tmp_path, k1):
    path = captures.write_transforms(tmp_path / "in", captures.Shot(k1=k1))
    (tmp_path / "in/masks").mkdir()
    for number in range(8):
        source = Image.open(tmp_path / f"in/images/r_{number}.png")
        source.convert("L").save(tmp_path / f"in/masks/m_{number}.png")
    captures.edit(path, lambda c: [f.update(mask_path=f"masks/m_{number}.png") for number, f in enumerate(c["frames"])])
    category = import_capture(tmp_path / "out", "desk", path, progress=False)
    assert captures.reprojection_errors(category, captures.POINTS, "mask").max() < 0.1


def test_without_masks_everything_is_foreground(captures, tmp_path):
    path = captures.write_transforms(tmp_path / "in", captures.Shot())
    category = import_capture(tmp_path / "out", "desk", path, progress=False)
    assert all((captures.pixels_of(category, e, "mask") == 255).all() for e in captures.annotations(category))


def test_a_point_cloud_is_taken_over_without_stray_points(captures, tmp_path):
    path = captures.write_transforms(tmp_path / "in", captures.Shot())
    rows = [(*point, 10, 20, 30) for point in captures.POINTS] + [(900.0, 0.0, 0.0, 1, 2, 3)]
    header = "ply\nformat ascii 1.0\nelement vertex 15\n" + "".join(f"property float {a}\n" for a in "xyz")
    header += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    (tmp_path / "in/sparse.ply").write_text(header + "\n".join(" ".join(map(str, row)) for row in rows) + "\n")
    captures.edit(path, lambda content: content.update(ply_file_path="sparse.ply"))
    category = import_capture(tmp_path / "out", "desk", path, progress=False)
    vertices = PlyData.read(str(category / "in/pointcloud.ply"))["vertex"]
    np.testing.assert_allclose(np.stack([vertices[a] for a in "xyz"], axis=1), captures.POINTS, atol=1e-6)
    assert set(vertices["blue"]) == {30}


def write_with_missing(captures, folder, frames, missing):
    """A capture of so many frames, of which those numbers have no picture; the path of its transforms.json."""
    poses = captures.opengl_poses(frames).tolist()
    names = [f"images/r_{number}.jpg" for number in range(frames)]
    listed = [{"file_path": name, "transform_matrix": pose} for name, pose in zip(names, poses, strict=True)]
    path = captures.write_transforms(folder, captures.Shot(), frames=listed)
    for number in set(range(frames)) - set(missing):
        Image.new("RGB", (210, 150), (number, 0, 0)).save(folder / names[number])
    return path


def test_frames_without_a_picture_are_counted_named_and_left_out(captures, tmp_path, command, caplog):
    # As instant-ngp's fox: 17 of 67 listed frames have no picture.
    missing = range(0, 67, 4)
    path = write_with_missing(captures, tmp_path / "fox", 67, missing)
    with caplog.at_level(logging.INFO):
        finished = command("data", "import", f"transforms={path}", f"out={tmp_path / 'out'}", "category=fox")
    assert finished.status == 0, finished.err
    named = ", ".join(f"images/r_{number}.jpg" for number in (0, 4, 8, 12, 16))
    text = caplog.text + finished.out + finished.err
    assert f"{path}: 17 of 67 frames have no picture and are left out: {named}, ..." in text
    entries = captures.annotations(tmp_path / "out/fox")
    kept = [number for number in range(67) if number not in missing]
    reference = captures.opengl_poses(67)[kept, :3, 3]
    rotations, translations = (np.array([entry["viewpoint"][key] for entry in entries]) for key in "RT")
    # Each kept picture keeps its own pose. PyTorch3D: x R + T = 0 in the camera's centre.
    np.testing.assert_allclose(-np.einsum("nij,nj->ni", rotations, translations), reference, atol=1e-6)


@pytest.mark.parametrize("change", [str, lambda name: f"./{name}", lambda name: name.removesuffix(".jpg")])
def test_nothing_is_said_of_pictures_that_are_there(captures, tmp_path, caplog, change):
    path = captures.write_transforms(tmp_path / "in", captures.Shot(), ".jpg")
    captures.edit(path, lambda content: [f.update(file_path=change(f["file_path"])) for f in content["frames"]])
    with caplog.at_level(logging.WARNING):
        category = import_capture(tmp_path / "out", "desk", path, progress=False)
    assert len(captures.annotations(category)) == 8
    assert caplog.text == ""


@pytest.mark.parametrize(("share", "refused"), [(0.5, False), (0.49, True), (0.0, True)])
def test_too_many_frames_without_a_picture_are_refused(captures, tmp_path, share, refused):
    path = write_with_missing(captures, tmp_path / "in", 20, range(10))
    if refused:
        with pytest.raises(MissingFile, match=rf"transforms\.json: 10 of 20 frames .* most_missing={share:g}"):
            import_capture(tmp_path / "out", "desk", path, most_missing=share, progress=False)
        assert not list(tmp_path.glob("out/*"))
    else:
        category = import_capture(tmp_path / "out", "desk", path, most_missing=share, progress=False)
        assert len(captures.annotations(category)) == 10


def test_the_command_writes_it_and_says_what_comes_next(captures, tmp_path, command, caplog):
    path = captures.write_transforms(tmp_path / "kitchen table", captures.Shot())
    arguments = [f"transforms={path}", f"out={tmp_path / 'out'}", "category=desk"]
    with caplog.at_level(logging.INFO):
        finished = command("data", "import", *arguments)
    assert finished.status == 0, finished.err
    assert (tmp_path / "out/desk/kitchen_table/images/frame000001.png").is_file()
    text = caplog.text + finished.out + finished.err
    assert (
        f"data.root={tmp_path / 'out'} data.category=desk data.subset=imported data.allow_shared_sequences=true" in text
    )
    assert "8 copied as they are" in text
    lists = json.loads((tmp_path / "out/desk/set_lists/set_lists_imported.json").read_text())
    assert [entry[1] for entry in lists["test"]] == [0, 4]
