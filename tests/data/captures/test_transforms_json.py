import json
import logging

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData

from completesplat.data.captures import import_capture
from completesplat.data.captures.transforms_json import read_photographs
from completesplat.data.validation import BadImage, MissingFile
from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import project

LENSES = {
    "a pinhole off the centre": {},
    "a barrel": {"k1": -0.18, "k2": 0.04, "p1": 0.002, "p2": -0.003},
    "a pincushion": {"k1": 0.12, "k2": 0.02, "k3": 0.01, "p1": -0.002, "p2": 0.001},
}


@pytest.mark.parametrize(("lens", "suffix"), [*zip(LENSES.values(), (".jpg", ".png", ".png"), strict=True)], ids=LENSES)
def test_known_points_are_where_the_written_cameras_see_them(captures, tmp_path, lens, suffix):
    path = captures.write_transforms(tmp_path / "in", captures.Shot(**lens), suffix)
    category = import_capture(tmp_path / "out", "desk", path, progress=False)
    errors = captures.reprojection_errors(category, captures.POINTS)
    assert len(errors) > 20
    assert errors.max() < 0.1
    if not lens:  # Pictures without distortion are copied, and without masks everything is foreground.
        for number, entry in enumerate(captures.annotations(category)):
            source = tmp_path / f"in/images/r_{number}.jpg"
            assert (tmp_path / "out" / entry["image"]["path"]).read_bytes() == source.read_bytes()
            assert (captures.pixels_of(category, entry, "mask") == 255).all()


def test_the_field_of_view_gives_the_same_cameras_as_the_focal_length(captures, tmp_path, caplog):
    shot = captures.Shot(focal=(190.0, 190.0), center=(105.0, 75.0))
    given, angle = (captures.write_transforms(tmp_path / name, shot) for name in "ab")

    def only_the_angle(content):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del content[key]
        content["camera_angle_x"] = 2 * float(np.arctan(105 / 190))
        for frame in content["frames"]:
            frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")

    captures.edit(angle, only_the_angle)
    with caplog.at_level(logging.WARNING):
        folders = [import_capture(tmp_path / "out", n, p, progress=False) for n, p in (("a", given), ("b", angle))]
    assert caplog.text == ""
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


@pytest.mark.parametrize("k1", [-0.1, 0.0, 0.15])
def test_masks_go_the_way_of_their_pictures_and_nothing_is_mirrored(captures, tmp_path, k1):
    path = captures.write_transforms(tmp_path / "in", captures.Shot(k1=k1))
    (tmp_path / "in/masks").mkdir()
    for number in range(8):
        Image.open(tmp_path / f"in/images/r_{number}.png").convert("L").save(tmp_path / f"in/masks/m_{number}.png")
    captures.edit(path, lambda c: [f.update(mask_path=f"masks/m_{number}.png") for number, f in enumerate(c["frames"])])
    picture = np.zeros((150, 210, 3), dtype=np.uint8)
    picture[:75, :105], picture[:75, 105:], picture[75:, :105] = (200, 0, 0), (0, 200, 0), (0, 0, 200)
    Image.fromarray(picture).save(tmp_path / "in/images/r_0.png")
    category = import_capture(tmp_path / "out", "desk", path, progress=False)
    assert captures.reprojection_errors(category, captures.POINTS, "mask").max() < 0.1
    written = captures.pixels_of(category, captures.annotations(category)[0])
    quarters = written[[len(written) // 4, len(written) * 3 // 4]][
        :, [written.shape[1] // 4, written.shape[1] * 3 // 4]
    ]
    assert quarters.tolist() == [[[200, 0, 0], [0, 200, 0]], [[0, 0, 200], [0, 0, 0]]]


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


def test_frames_without_a_picture_are_counted_named_and_left_out_unless_too_many(captures, tmp_path, caplog):
    missing, poses = range(0, 24, 4), captures.opengl_poses(24)
    names = [f"images/r_{number}.jpg" for number in range(24)]
    frames = [{"file_path": name, "transform_matrix": pose.tolist()} for name, pose in zip(names, poses, strict=True)]
    path = captures.write_transforms(tmp_path / "fox", captures.Shot(), frames=frames)
    kept = [number for number in range(24) if number not in missing]
    for number in kept:
        Image.new("RGB", (210, 150), (number, 0, 0)).save(tmp_path / "fox" / names[number])
    with pytest.raises(MissingFile, match=r"transforms\.json: 6 of 24 frames .* most_missing=0\.24"):
        import_capture(tmp_path / "out", "desk", path, most_missing=0.24, progress=False)
    assert not list(tmp_path.glob("out/*"))
    category = import_capture(tmp_path / "out", "desk", path, most_missing=0.25, progress=False)
    named = ", ".join(names[number] for number in (0, 4, 8, 12, 16))
    assert f"{path}: 6 of 24 frames have no picture and are left out: {named}, ..." in caplog.text
    entries = captures.annotations(category)
    rotations, translations = (np.array([entry["viewpoint"][key] for entry in entries]) for key in "RT")
    # Each kept picture keeps its own pose. PyTorch3D: x R + T = 0 in the camera's centre.
    centers = -np.einsum("nij,nj->ni", rotations, translations)
    np.testing.assert_allclose(centers, poses[kept, :3, 3], atol=1e-6)


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


def test_photographs_have_the_cameras_of_their_squares(captures, tmp_path):
    shot = captures.Shot()
    path = captures.write_transforms(tmp_path / "in", shot)
    names = [2, 0, 5]
    views = read_photographs([tmp_path / f"in/images/r_{n}.png" for n in names], path, 75)
    poses = captures.opengl_poses()[names]
    assert views.cameras.world_to_camera[0].allclose(torch.eye(4), atol=1e-5)
    # In the first camera's frame, with OpenCV's axes.
    local = (shot.points - poses[0][:3, 3]) @ poses[0][:3, :3] * [1, -1, -1]
    found = project(views.cameras, torch.from_numpy(local).float())[0].numpy()
    for pixels, pose in zip(found, poses, strict=True):
        expected = (shot.pixels(pose) - [(210 - 150) / 2, 0]) * 75 / 150
        np.testing.assert_allclose(pixels, expected, atol=1e-3)
    # And the pictures show the blobs there.
    for image, pixels in zip(views.images, found, strict=True):
        inside = pixels[((pixels > 3) & (pixels < 72)).all(1)].astype(int)
        assert (image[0, inside[:, 1], inside[:, 0]] > 0.5).all()


def test_photographs_without_a_plain_camera_are_refused(captures, tmp_path):
    path = captures.write_transforms(tmp_path / "in", captures.Shot(k1=0.1))
    first = tmp_path / "in/images/r_0.png"
    with pytest.raises(CompleteSplatError, match=r"r_0.png: its lens distorts; import the capture"):
        read_photographs([first], path, 32)
    captures.edit(path, lambda content: content.update(k1=0, w=200))
    with pytest.raises(BadImage, match="200"):
        read_photographs([first], path, 32)
    captures.edit(path, lambda content: content["frames"].pop(0))
    with pytest.raises(CompleteSplatError, match=r"r_0.png: .*transforms.json has no frame with this picture"):
        read_photographs([first], path, 32)
