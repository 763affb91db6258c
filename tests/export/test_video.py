import dataclasses

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from support import round_gaussians

from completesplat.export.video import render_views, write_video
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.geometry.trajectories import orbit
from completesplat.rasterizers.reference import ReferenceRasterizer

PIVOT = torch.tensor([0.0, 0.0, 3.0])
UP = torch.tensor([0.0, -1.0, 0.0])
CAMERA = Cameras(torch.eye(4), pinhole(50.0, 33), (33, 33))


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
    assert (meta["fps"], meta["codec"], meta["pix_fmt"][:7]) == (10, "h264", "yuv420p")
    expected = frames.repeat_interleave(4, -1).repeat_interleave(4, -2).permute(0, 2, 3, 1).numpy() * 255
    inner = np.s_[:, 8:120, 8:120], np.s_[:, 8:120, 136:248], np.s_[:, 136:248, 8:120], np.s_[:, 136:248, 136:248]
    for quadrant in inner:
        assert np.abs(images[quadrant] - expected[quadrant]).max() < 12


def test_odd_sizes_are_padded_and_small_ones_enlarged(tmp_path, caplog):
    write_video(tmp_path / "a.mp4", torch.rand(2, 3, 171, 57))
    assert read(tmp_path / "a.mp4")[0].shape == (2, 856, 286, 3)
    assert "resizing" not in caplog.text  # imageio would log this if it scaled the frames


def test_no_frames_another_format_and_nan_are_refused(tmp_path):
    black = torch.zeros(1, 3, 64, 64)
    broken = torch.full((2, 3, 64, 64), torch.nan)
    refused = ("a.mp4", black[:0], "needs"), ("a.txt", black, "needs"), ("a.mp4", broken, "finite")
    for name, frames, message in refused:
        with pytest.raises(ValueError, match=message):
            write_video(tmp_path / name, frames)
    assert list(tmp_path.iterdir()) == []


def test_the_pivot_stays_in_the_centre_at_the_same_distance_in_front_of_the_background():
    orange = round_gaussians(torch.tensor([[0.0, 0.0, 3.0]]), 0.2, 1.0, [1.0, 0.5, 0.0])
    images, depth = render_views(ReferenceRasterizer(), orange, orbit(CAMERA, PIVOT, UP, 10), 0.75)
    assert images.shape == (10, 3, 33, 33)  # more views than are rendered at a time
    torch.testing.assert_close(depth[:, 0, 16, 16], torch.full((10,), 3.0), rtol=0, atol=1e-4)
    torch.testing.assert_close(images[:, :, 16, 16], torch.tensor([1.0, 0.5, 0.0]).expand(10, 3), rtol=0, atol=3e-3)
    assert (images[:, :, 0, 0] == 0.75).all()
    assert (depth[:, :, 0, 0] == 0).all()


def test_the_first_view_is_the_reference_view_and_the_axis_points_up():
    gaussians = round_gaussians(torch.tensor([[0.3, -0.5, 3.0]]), 0.2, 1.0, [1.0, 0.0, 0.0])
    world_to_camera = torch.eye(4)
    world_to_camera[:3, :3] = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    turned = dataclasses.replace(CAMERA, world_to_camera=world_to_camera)
    rasterizer = ReferenceRasterizer()
    for camera in (CAMERA, turned):
        pivot = camera.camera_to_world[:3, :3] @ PIVOT
        here = gaussians.transform(camera.camera_to_world)
        around = orbit(camera, pivot, -camera.world_to_camera[1, :3], 4)
        images, _ = render_views(rasterizer, here, around, 0.0)
        direct = rasterizer(here[None], camera[None, None])
        torch.testing.assert_close(images[0], direct.over(0.0)[0, 0], rtol=0, atol=1e-5)
        # Half a turn about the camera's vertical axis swaps left and right, but not top and bottom.
        rows, columns = (images[:, 0].sum(axis).argmax(-1) for axis in (-1, -2))
        assert (rows < 14).all()
        assert columns[0] > 17
        assert columns[2] < 15
