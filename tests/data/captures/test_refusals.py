import pytest
from PIL import Image

from completesplat.data.captures import import_capture
from completesplat.data.captures.capture import make_cloud
from completesplat.data.validation import (
    BadAnnotation,
    BadCamera,
    BadImage,
    MissingFile,
    OutsidePath,
    TooFewFrames,
    UnreadableFile,
)
from completesplat.errors import CompleteSplatError, DataError


def of_frame(number, **values):
    return lambda content: content["frames"][number].update(values)


def entry_of_pose(row, column, value):
    def change(content):
        content["frames"][3]["transform_matrix"][row][column] = value

    return change


def without(*keys):
    return lambda content: [content.pop(key) for key in keys]


TRANSFORMS = {
    "no frames": (without("frames"), BadAnnotation, r"transforms\.json: no frames"),
    "five frames": (lambda c: c["frames"].__delitem__(slice(5, None)), TooFewFrames, "5 frames; .* at least 6"),
    "NaN in a pose": (entry_of_pose(0, 3, float("nan")), BadAnnotation, r"transforms\.json, frame 3: .* not finite"),
    "a sheared pose": (entry_of_pose(0, 0, 0.3), BadCamera, r"transforms\.json, frame 3: .* not orthonormal"),
    "a projective pose": (entry_of_pose(3, 0, 0.1), BadCamera, "frame 3: transform_matrix ends in the row"),
    "a picture twice": (of_frame(2, file_path="./images/r_1"), BadAnnotation, "frame 2: the same picture as frame 1"),
    "a picture outside": (
        of_frame(2, file_path="../r_2.png"),
        OutsidePath,
        r"transforms\.json, frame 2: leads outside",
    ),
    "a missing mask": (of_frame(4, mask_path="m.png"), MissingFile, r"m\.png, frame 4: no such file"),
    "no focal length": (without("fl_x"), BadAnnotation, "frame 0: neither fl_x nor camera_angle_x"),
    "a negative focal length": (of_frame(1, fl_y=-2.0), BadCamera, "frame 1: .* must be positive"),
    "half a circle": (lambda c: (c.pop("fl_x"), c.update(camera_angle_x=3.2)), BadCamera, "field of view of 3.2"),
    "a centre outside": (of_frame(1, cx=210.0), BadCamera, r"frame 1: principal point \(210, 66\) lies outside"),
    "another size": (lambda c: c.update(h=151), BadImage, r"r_0\.png, in, frame 0: has 150 x 210 .* says 151 x 210"),
    "a fisheye": (lambda c: c.update(camera_model="OPENCV_FISHEYE"), BadCamera, "OPENCV_FISHEYE is not supported"),
    "no name of a lens": (lambda c: c.update(camera_model=["OPENCV"]), BadCamera, "camera model .* is not supported"),
    "instant-ngp's fisheye": (lambda c: c.update(is_fisheye=True), BadCamera, "is_fisheye is not supported"),
    "a fourth coefficient": (lambda c: c.update(k4=0.1), BadCamera, "k4 = 0.1 has no meaning for camera model OPENCV"),
    "a folded picture": (lambda c: c.update(k1=-4.0), BadCamera, r"r_0\.png, in, frame 0: distortion .* usable"),
    "a point cloud that is none": (
        lambda c: c.update(ply_file_path="transforms.json"),
        UnreadableFile,
        r"transforms\.json: not a point cloud",
    ),
}


@pytest.mark.parametrize(("change", "kind", "message"), TRANSFORMS.values(), ids=TRANSFORMS)
def test_a_bad_transforms_file_is_refused(captures, tmp_path, change, kind, message):
    path = captures.edit(captures.write_transforms(tmp_path / "in", captures.Shot()), change)
    with pytest.raises(kind, match=message):
        import_capture(tmp_path / "out", "desk", path, progress=False)
    assert not list(tmp_path.glob("out/*"))


def test_points_that_are_not_finite_are_refused(tmp_path):
    with pytest.raises(BadAnnotation, match=r"x\.ply: points that are not finite"):
        make_cloud([[0, 0, 0], [0, float("nan"), 1]], [[0, 0, 0]] * 2, tmp_path / "x.ply")


def turn(path):
    exif = Image.Exif()
    exif[274] = 3  # Upside down: the size is the same.
    Image.open(path).save(path, exif=exif)


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 16
    path.write_bytes(content)


PICTURES = {
    "upside down by EXIF": (turn, r"EXIF orientation 3"),
    "damaged": (flip_a_bit, "cannot be decoded"),
    "of another size, with alpha": (lambda p: Image.new("RGBA", (150, 210)).save(p), "has 210 x 150 pixels"),
}


@pytest.mark.parametrize(("damage", "message"), PICTURES.values(), ids=PICTURES)
def test_a_bad_picture_is_refused(captures, tmp_path, damage, message):
    path = captures.write_transforms(tmp_path / "in", captures.Shot())
    damage(tmp_path / "in/images/r_5.png")
    with pytest.raises(BadImage, match=rf"images/r_5\.png, in, frame 5: .*{message}"):
        import_capture(tmp_path / "out", "desk", path, progress=False)
    assert not list(tmp_path.glob("out/*"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "either transforms=FILE or colmap=FOLDER"),
        ({"transforms": "a", "images": "c"}, "colmap=FOLDER goes with images=FOLDER"),
        ({"transforms": "a", "category": None}, "category is needed: give category=NAME"),
        ({"transforms": "a", "category": "a/b"}, "category must be a name"),
        ({"transforms": "nowhere.json"}, r"nowhere\.json: no such file"),
        ({"colmap": "nowhere", "images": "c"}, "nowhere: no such folder"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(tmp_path, settings, message):
    if "colmap" in settings:
        pytest.importorskip("pycolmap")
    with pytest.raises(CompleteSplatError, match=message):
        import_capture(tmp_path, **{"category": "desk", **settings}, progress=False)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_there_is_left_alone_but_remains_of_an_interrupted_import_are_no_obstacle(captures, tmp_path):
    path = captures.write_transforms(tmp_path / "in", captures.Shot())
    (tmp_path / "out/desk").mkdir(parents=True)
    (tmp_path / "out/desk/notes.txt").write_text("mine")
    with pytest.raises(DataError, match=r"out/desk: is there already"):
        import_capture(tmp_path / "out", "desk", path, progress=False)
    assert [p.name for p in (tmp_path / "out/desk").iterdir()] == ["notes.txt"]
    (tmp_path / "new/.desk.unfinished/in/images").mkdir(parents=True)
    assert len(captures.annotations(import_capture(tmp_path / "new", "desk", path, progress=False))) == 8
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["desk"]
