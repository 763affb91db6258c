"""Which pixels of one frame another frame shows."""

import numpy as np
import torch

from completesplat.data.toy.modes import frame_camera, unseen
from completesplat.data.toy.object_scene import draw_scene, render_frame
from completesplat.geometry.cameras import pixel_centers, project, unproject

SIZE, FRAMES = 48, 8
SCENE = draw_scene(np.random.default_rng([5, 1]), FRAMES)


def test_a_frame_shows_all_of_itself():
    assert not unseen(SCENE, 3, 3, SIZE).any()


def test_what_is_seen_looks_the_same_in_both_frames_and_what_is_not_does_not():
    """Shading does not depend on the direction, so a point that both show has one colour."""
    reference, frame = 0, 1
    colors, _, depth = (torch.from_numpy(part) for part in render_frame(SCENE, frame, SIZE))
    points = unproject(
        frame_camera(SCENE, frame, SIZE), pixel_centers(SIZE, SIZE, dtype=torch.float64).flatten(0, 1), depth.flatten()
    )
    pixels, _ = project(frame_camera(SCENE, reference, SIZE), points)
    columns, rows = pixels.clamp(0, SIZE - 1e-6).floor().long().unbind(-1)
    other = torch.from_numpy(render_frame(SCENE, reference, SIZE)[0])[rows, columns]
    differences = (other - colors.flatten(0, 1)).abs().amax(-1)
    hidden = unseen(SCENE, reference, frame, SIZE).flatten()
    assert 0.1 < hidden.float().mean() < 0.9
    assert differences[~hidden].median() < 0.02
    assert differences[hidden].median() > 0.05


def test_where_depth_maps_disagree_it_agrees_with_them():
    """Against the usual test, the reference's depth map at the nearest pixel, save for the pixels at edges."""
    reference, frame = 0, 2
    camera, other = (frame_camera(SCENE, index, SIZE) for index in (frame, reference))
    depth = torch.from_numpy(render_frame(SCENE, frame, SIZE)[2]).flatten()
    points = unproject(camera, pixel_centers(SIZE, SIZE, dtype=torch.float64).flatten(0, 1), depth)
    pixels, ahead = project(other, points)
    within = (ahead > 0) & (pixels >= 0).all(-1) & (pixels < SIZE).all(-1)
    columns, rows = pixels.clamp(0, SIZE - 1e-6).floor().long().unbind(-1)
    nearest = torch.from_numpy(render_frame(SCENE, reference, SIZE)[2])[rows, columns]
    by_depth = ~(within & (ahead < 1.05 * nearest))
    agreeing = (by_depth == unseen(SCENE, reference, frame, SIZE).flatten()).float().mean()
    assert agreeing > 0.95
