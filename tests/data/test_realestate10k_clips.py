"""What a clip's files may not hold, in either form."""

import numpy as np
import pytest
import torch
from realestate10k_trees import (
    FORMS,
    assert_refusal,
    chunk_entry,
    encode,
    make_clip,
    write_chunk_form,
    write_text_form,
)

from completesplat.data.pictures.crop import Square
from completesplat.data.realestate10k.chunks import ChunkedClips
from completesplat.data.realestate10k.clips import TextClips
from completesplat.data.realestate10k.module import ClipFraming, RE10KSource, open_clips
from completesplat.data.validation import BadAnnotation, BadCamera, BadPicture, MissingFile, TooFewFrames
from completesplat.errors import DataError

WHOLE = Square(0, 0, 18)
FILE = {"text": "clip7.txt", "chunks": "000000.torch"}


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
    with pytest.raises(DataError) as caught:
        open_clips(tmp_path).clip("clip7")
    kind = BadAnnotation if fault in (nan_pose, infinite_focal) else BadCamera
    assert_refusal(caught.value, kind, tmp_path / FILE[form], "clip7", 3)


@pytest.mark.parametrize("form", FORMS)
def test_a_pose_within_the_tolerance_is_accepted(tmp_path, form):
    FORMS[form](tmp_path, broken(lambda clip: clip.rows[:, 6:9].__imul__(1 + 3e-4)))
    assert open_clips(tmp_path).clip("clip7").cameras.image_size == (18, 32)


@pytest.mark.parametrize("form", FORMS)
def test_too_few_frames_are_refused(tmp_path, form):
    FORMS[form](tmp_path, [make_clip("a", frames=1), make_clip("b", frames=0)])
    for key, count in (("a", 1), ("b", 0)):
        with pytest.raises(DataError, match=f"{count} frames") as caught:
            open_clips(tmp_path).clip(key)
        file = f"{key}.txt" if form == "text" else FILE[form]
        assert_refusal(caught.value, TooFewFrames, tmp_path / file, key, None)


def test_repeated_timestamps_are_refused(tmp_path):
    write_chunk_form(tmp_path / "c", broken(lambda clip: clip.timestamps.__setitem__(3, clip.timestamps[1])))
    with pytest.raises(DataError, match="another frame has its timestamp") as caught:
        ChunkedClips(tmp_path / "c").clip("clip7")
    assert_refusal(caught.value, BadAnnotation, tmp_path / "c/000000.torch", "clip7", 1)
    write_text_form(tmp_path / "t", [make_clip("clip7")])
    path = tmp_path / "t/clip7.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, lines[3]]))
    with pytest.raises(DataError, match="another frame has its timestamp") as caught:
        TextClips(tmp_path / "t").clip("clip7")
    assert_refusal(caught.value, BadAnnotation, path, "clip7", 2)


@pytest.mark.parametrize(
    ("line", "reason"),
    [("1 2 3", "3 columns"), (" ".join(["x"] * 19), "invalid literal"), (" ".join(["7"] * 20), "20 columns")],
)
def test_a_malformed_line_is_refused(tmp_path, line, reason):
    write_text_form(tmp_path, [make_clip("clip7")])
    with (tmp_path / "clip7.txt").open("a") as file:
        file.write(line)
    with pytest.raises(DataError, match=reason) as caught:
        TextClips(tmp_path).clip("clip7")
    assert_refusal(caught.value, BadAnnotation, tmp_path / "clip7.txt", "clip7", 6)


def test_a_missing_frame_is_refused_and_png_will_do(tmp_path):
    clip = make_clip("clip7")
    write_text_form(tmp_path, [clip])
    path = tmp_path / f"clip7/{clip.timestamps[3]}.jpg"
    path.unlink()
    with pytest.raises(DataError, match="no picture") as caught:
        TextClips(tmp_path).clip("clip7")
    assert_refusal(caught.value, MissingFile, path, "clip7", 3)
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
    name = f"clip7/{clip.timestamps[3]}.jpg" if form == "text" else FILE[form]
    framing = ClipFraming(8, "center", 1.0, 0.7, 10.0)
    sequence = RE10KSource(open_clips(tmp_path), ["clip7"], framing).read("clip7")
    assert sequence.read(2).image.shape == (3, 8, 8)
    with pytest.raises(DataError) as caught:
        sequence.read(3)
    assert_refusal(caught.value, BadPicture, tmp_path / name, "clip7", 3)


@pytest.mark.parametrize("form", FORMS)
def test_a_clip_whose_first_picture_is_none_is_refused(tmp_path, form):
    clip = make_clip("clip7")
    clip.pictures[0] = b"<html>"
    FORMS[form](tmp_path, [clip])
    with pytest.raises(DataError, match="not an image") as caught:
        open_clips(tmp_path).clip("clip7")
    file = f"clip7/{clip.timestamps[0]}.jpg" if form == "text" else FILE[form]
    assert_refusal(caught.value, BadPicture, tmp_path / file, "clip7", 0)


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
    with pytest.raises(DataError, match=reason) as caught:
        ChunkedClips(tmp_path).clip("clip7")
    assert_refusal(caught.value, BadAnnotation, tmp_path / "0.torch", "clip7", None)
