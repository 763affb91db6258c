import imageio.v2 as imageio
import numpy as np
import pytest
import torch

from completesplat.export.video import write_video


def read(path):
    with imageio.get_reader(path) as reader:
        return np.stack(list(reader.iter_data())), reader.get_meta_data()


def test_frames_come_back_in_order_and_upright(tmp_path):
    frames = torch.zeros(3, 3, 64, 64)
    frames[0, 0] = 1  # red
    frames[1, 2] = 1  # blue
    frames[2, :, :32] = 1  # white above black
    frames[2, 1, 32:, :32] = 1  # green at the lower left
    write_video(tmp_path / "a.mp4", frames, fps=10)
    images, meta = read(tmp_path / "a.mp4")
    assert images.shape == (3, 256, 256, 3)
    assert meta["fps"] == 10
    assert meta["codec"] == "h264"
    assert "yuv420p" in meta["pix_fmt"]
    expected = frames.repeat_interleave(4, -1).repeat_interleave(4, -2).permute(0, 2, 3, 1).numpy() * 255
    inner = np.s_[:, 8:120, 8:120], np.s_[:, 8:120, 136:248], np.s_[:, 136:248, 8:120], np.s_[:, 136:248, 136:248]
    for quadrant in inner:
        assert np.abs(images[quadrant] - expected[quadrant]).max() < 12


@pytest.mark.parametrize(
    ("height", "width", "stored"), [(300, 301, (300, 302)), (33, 57, (264, 456)), (257, 259, (258, 260))]
)
def test_odd_sizes_are_padded_and_small_ones_enlarged(tmp_path, caplog, height, width, stored):
    write_video(tmp_path / "a.mp4", torch.rand(5, 3, height, width))
    assert read(tmp_path / "a.mp4")[0].shape == (5, *stored, 3)
    assert "resizing" not in caplog.text  # what imageio says when it scales the frames instead


@pytest.mark.parametrize(("name", "frames"), [("a.mp4", 0), ("a.txt", 1)])
def test_nothing_to_show_or_another_format_is_refused(tmp_path, name, frames):
    with pytest.raises(ValueError, match="video needs"):
        write_video(tmp_path / name, torch.zeros(frames, 3, 64, 64))


def test_frames_that_are_not_finite_leave_no_file(tmp_path):
    with pytest.raises(ValueError, match="not finite"):
        write_video(tmp_path / "a.mp4", torch.full((2, 3, 64, 64), float("nan")))
    assert list(tmp_path.iterdir()) == []
