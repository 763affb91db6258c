"""What a clip's files may not hold, in either form."""

import numpy as np
import pytest
import torch
from realestate10k_trees import FORMS, chunk_entry, encode, make_clip, write_chunk_form, write_text_form

from completesplat.data.realestate10k_chunks import ChunkedClips
from completesplat.data.realestate10k_scenes import open_clips
from completesplat.data.realestate10k_text import TextClips
from completesplat.data.transforms import Square
from completesplat.errors import DataError

WHOLE = Square(0, 0, 18)


def broken(change) -> list:
    clip = make_clip("clip7")
    change(clip)
    return [clip]


def nan_pose(clip):
    clip.rows[3, 9] = np.nan


def infinite_focal(clip):
    clip.rows[3, 0] = np.inf


def sheared(clip):
    clip.rows[3, 6] += 0.01


def mirrored(clip):
    clip.rows[3, 6:10] *= -1


def scaled(clip):
    clip.rows[3, 6:] *= 2


def no_focal(clip):
    clip.rows[3, 1] = 0


def negative_focal(clip):
    clip.rows[3, 0] *= -1


def distorted(clip):
    clip.rows[3, 4] = 0.1


CAMERA_FAULTS = [nan_pose, infinite_focal, sheared, mirrored, scaled, no_focal, negative_focal, distorted]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("fault", CAMERA_FAULTS)
def test_a_bad_camera_is_refused_with_file_clip_and_frame(tmp_path, form, fault):
    FORMS[form](tmp_path, broken(fault))
    file = "clip7.txt" if form == "text" else "000000.torch"
    with pytest.raises(DataError, match=rf"{file}, clip clip7, frame 3: .*"):
        open_clips(tmp_path).clip("clip7")


@pytest.mark.parametrize("form", FORMS)
def test_a_pose_within_the_tolerance_is_accepted(tmp_path, form):
    FORMS[form](tmp_path, broken(lambda clip: clip.rows[:, 6:9].__imul__(1 + 3e-4)))
    assert open_clips(tmp_path).clip("clip7").cameras.image_size == (18, 32)


@pytest.mark.parametrize("form", FORMS)
def test_too_few_frames_are_refused(tmp_path, form):
    FORMS[form](tmp_path, [make_clip("a", frames=1), make_clip("b", frames=0)])
    for key in "ab":
        with pytest.raises(DataError, match=f"clip {key}: . frames"):
            open_clips(tmp_path).clip(key)


def test_repeated_timestamps_are_refused(tmp_path):
    write_chunk_form(tmp_path / "c", broken(lambda clip: clip.timestamps.__setitem__(3, clip.timestamps[1])))
    with pytest.raises(DataError, match="clip7, frame 1: another frame has its timestamp"):
        ChunkedClips(tmp_path / "c").clip("clip7")
    write_text_form(tmp_path / "t", [make_clip("clip7")])
    path = tmp_path / "t/clip7.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, lines[3]]))
    with pytest.raises(DataError, match="clip7, frame 2: another frame has its timestamp"):
        TextClips(tmp_path / "t").clip("clip7")


@pytest.mark.parametrize(
    ("line", "reason"),
    [("1 2 3", "3 columns"), (" ".join(["x"] * 19), "invalid literal"), (" ".join(["7"] * 20), "20 columns")],
)
def test_a_malformed_line_is_refused(tmp_path, line, reason):
    write_text_form(tmp_path, [make_clip("clip7")])
    with (tmp_path / "clip7.txt").open("a") as file:
        file.write(line)
    with pytest.raises(DataError, match=f"clip7.txt, clip clip7, frame 6: {reason}"):
        TextClips(tmp_path).clip("clip7")


def test_a_missing_frame_is_refused_and_png_will_do(tmp_path):
    clip = make_clip("clip7")
    write_text_form(tmp_path, [clip])
    path = tmp_path / f"clip7/{clip.timestamps[3]}.jpg"
    path.unlink()
    with pytest.raises(DataError, match=rf"clip clip7, frame 3: no picture .*{path.name}"):
        TextClips(tmp_path).clip("clip7")
    pixels = np.arange(18 * 32 * 3, dtype=np.uint8).reshape(18, 32, 3)
    path.with_suffix(".png").write_bytes(encode(pixels, "PNG"))
    image = TextClips(tmp_path).clip("clip7").read(3, WHOLE, 18)
    assert torch.equal(image, torch.from_numpy(pixels[:, :18].transpose(2, 0, 1).copy()))


def other_size(data: bytes) -> bytes:
    return encode(np.zeros((32, 18, 3), dtype=np.uint8))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("fault", [lambda data: data[: len(data) // 2], lambda data: b"<html>", other_size])
def test_pictures_that_are_broken_or_of_another_size_are_refused(tmp_path, form, fault):
    clip = make_clip("clip7")
    clip.pictures[3] = fault(clip.pictures[3])
    FORMS[form](tmp_path, [clip])
    name = f"{clip.timestamps[3]}.jpg" if form == "text" else "000000.torch, clip clip7, frame 3"
    read = open_clips(tmp_path).clip("clip7").read
    assert read(2, WHOLE, 8).shape == (3, 8, 8)
    with pytest.raises(DataError, match=name):
        read(3, WHOLE, 8)


@pytest.mark.parametrize("form", FORMS)
def test_a_clip_whose_first_picture_is_none_is_refused(tmp_path, form):
    clip = make_clip("clip7")
    clip.pictures[0] = b"<html>"
    FORMS[form](tmp_path, [clip])
    with pytest.raises(DataError, match=r"clip7, frame 0.*not a readable image"):
        open_clips(tmp_path).clip("clip7")


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("cameras", torch.zeros(6, 17), "18 columns"),
        ("cameras", torch.zeros(6, 18, dtype=torch.int64), "18 columns"),
        ("cameras", torch.zeros(5, 18), "6 images, 5 cameras"),
        ("timestamps", torch.arange(5), "5 timestamps"),
        ("timestamps", torch.arange(6.0), "not int64"),
        ("timestamps", torch.zeros(1, dtype=torch.int64).expand(10**12), "timestamps"),
        ("images", [torch.zeros(9)] * 6, "uint8"),
        ("images", [torch.zeros(1, dtype=torch.uint8).expand(10**12)] * 6, "uint8"),
        ("images", None, "uint8"),
    ],
)
def test_fields_of_another_type_or_shape_are_refused(tmp_path, field, value, reason):
    torch.save([chunk_entry(make_clip("clip7")) | {field: value}], tmp_path / "0.torch")
    (tmp_path / "index.json").write_text('{"clip7": "0.torch"}')
    with pytest.raises(DataError, match=rf"0\.torch, clip clip7: .*{reason}"):
        ChunkedClips(tmp_path).clip("clip7")
