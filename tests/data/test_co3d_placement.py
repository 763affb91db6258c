from pathlib import Path

import numpy as np
import pytest
import torch
from co3d_trees import OCTAHEDRON, depth_bits, look, orbit, splatter_image, write_cloud
from PIL import Image

from completesplat.data.co3d.annotations import CO3DFrame, DepthMap, camera_from_viewpoint
from completesplat.data.co3d.source import from_depth_maps, object_placement
from completesplat.data.placement import Axes, Placement, from_cameras, from_points, upright_axes
from completesplat.data.validation import read_points
from completesplat.errors import BadImage, BadPlacement, MissingFile

CENTER = np.array([3.0, -2.0, 5.0])
AXES = np.eye(3)


def from_cloud(path: Path, axes: Axes) -> Placement:
    return from_points(read_points(path), axes, "the point cloud")


def tapered(count: int = 4000) -> np.ndarray:
    """A cone that stands on its tip, with a handle: its mean lies neither in the middle nor on the axis."""
    rng = np.random.default_rng(0)
    height, angle = rng.uniform(0, 2, count) ** 0.5, rng.uniform(0, 2 * np.pi, count)
    cone = np.stack([0.5 * height * np.cos(angle), 1.5 * height, 0.5 * height * np.sin(angle)], axis=-1)
    handle = np.array([1.1, 1.9, 0.2]) + rng.uniform(-0.1, 0.1, (count // 10, 3))
    return np.concatenate([cone, handle])


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.2])
def test_scenes_are_centred_and_scaled_as_splatter_image_does(tmp_path, turn):
    """Also where the world of the capture stands neither upright nor at the origin."""
    axis = np.array([0.36, 0.48, 0.8])
    cross = np.cross(np.eye(3), axis)
    tilt = np.eye(3) + np.sin(turn) * cross + (1 - np.cos(turn)) * cross @ cross
    views, points = [look(eye, np.zeros(3)) for eye in orbit(11)], tapered()
    for view in views:  # X_cam = X R + T of points X that are turned and moved
        view["R"] = (tilt.T @ np.array(view["R"])).tolist()
        view["T"] = (np.array(view["T"]) - CENTER @ np.array(view["R"])).tolist()
    points = (points @ tilt + CENTER).astype(np.float32).astype(np.float64)
    distances, placed, scale = splatter_image(points, views)
    frames = [frame(view) for view in views]
    center, half_size = object_placement(write_cloud(tmp_path / "cloud.ply", points), frames, frames)
    factor = 0.57 / half_size
    assert factor == pytest.approx(scale)
    eyes = torch.stack([one.camera.centers for one in frames])
    np.testing.assert_allclose(factor * (eyes - center).norm(dim=-1), distances, rtol=1e-6)
    np.testing.assert_allclose(
        factor * np.linalg.norm(points - center.numpy(), axis=-1), np.linalg.norm(placed, axis=-1), rtol=1e-6
    )
    assert np.abs(placed).max() == pytest.approx(0.57)


def test_placement_of_a_known_cloud_and_of_none(tmp_path):
    corners = np.array([[10 + x, 20 + y, 30 + z] for x in (-1, 1) for y in (-2, 2) for z in (-0.5, 0.5)])
    center, half_size = from_cloud(write_cloud(tmp_path / "cloud.ply", corners), AXES)
    assert center.tolist() == pytest.approx([10, 20, 30])
    assert half_size == pytest.approx(2)
    for points in (np.zeros((0, 3)), np.ones((5, 3)), np.array([[0, 0, 0], [1, np.nan, 0]])):
        frames = [frame(look(eye, np.zeros(3))) for eye in orbit(3)]
        with pytest.raises(BadPlacement) as caught:
            object_placement(write_cloud(tmp_path / "cloud.ply", points), frames, frames)
        assert caught.value.file == str(tmp_path / "cloud.ply")
    with pytest.raises(MissingFile, match=r"none\.ply"):
        from_cloud(tmp_path / "none.ply", AXES)


def frame(viewpoint: dict, size: tuple[int, int] = (24, 32), depth: DepthMap | None = None) -> CO3DFrame:
    camera = camera_from_viewpoint(viewpoint, size)
    return CO3DFrame(7, Path("image.png"), depth.path.with_name("mask.png") if depth else Path("no"), depth, camera)


@pytest.mark.parametrize("size", [(24, 32), (32, 24)])
@pytest.mark.parametrize("layout", ["ndc_norm_image_bounds", "ndc_isotropic"])
def test_cameras_on_a_sphere_see_its_centre_and_half_their_field_of_view(layout, size):
    """At distance r with the focal length f in units of half the square's side, that half is r / f wide."""
    frames = [frame(look(CENTER + eye, CENTER, layout), size) for eye in orbit(5, radius=4.0)]
    center, half_size = from_cameras([frame.camera for frame in frames])
    assert center.tolist() == pytest.approx(CENTER.tolist())
    # Normalised by the bounds, a focal length of 3 along the longer axis is 3 half longer sides.
    focal = 3 * (max(size) / min(size) if layout == "ndc_norm_image_bounds" else 1)
    assert half_size == pytest.approx(4 / focal)


def test_a_square_around_an_off_centre_principal_point_is_smaller_and_axes_must_meet_in_front():
    """The principal point lies 0.25 of half the height above the centre."""
    eyes = orbit(5, radius=4.0)
    frames = [frame(look(CENTER + eye, CENTER, principal_point=[0, 0.25])) for eye in eyes]
    assert from_cameras([frame.camera for frame in frames]).half_size == pytest.approx(0.75 * 4 / 3)
    with pytest.raises(BadPlacement, match="do not meet"):
        from_cameras([frame(look(eye, eye + np.array([0, 0, 1]))).camera for eye in eyes])
    with pytest.raises(BadPlacement, match="behind"):
        from_cameras([frame(look(eye, 2 * eye)).camera for eye in eyes])


def plane(folder: Path, map_size: tuple[int, int], scale: float = 1.0) -> CO3DFrame:
    """A camera at the origin that looks along z at a plane of depth 2 `scale`, seen in a part of its 24 x 32 pixels."""
    mask = np.zeros((24, 32), dtype=np.uint8)
    mask[8:20, 4:28] = 255
    folder.mkdir()
    Image.fromarray(mask).save(folder / "mask.png")
    Image.fromarray(depth_bits(np.full(map_size, 2.0))).save(folder / "depth.png")
    return frame(look(np.zeros(3), np.array([0, 0, 1.0])), depth=DepthMap(folder / "depth.png", scale))


@pytest.mark.parametrize(("map_size", "step"), [((24, 32), 1), ((12, 16), 2), ((6, 8), 4)])
def test_a_plane_is_placed_where_it_is_also_by_smaller_depth_maps(tmp_path, map_size, step):
    """Pixel (u, v) of the image is at ((16 - u) / 36, (12 - v) / 36) 2, with PyTorch3D's axes: 36 = 3 * 24 / 2."""
    center, half_size = from_depth_maps([plane(tmp_path / "a", map_size)], AXES)
    columns, rows = np.arange(4, 28, step) + step / 2, np.arange(8, 20, step) + step / 2
    expected = [2 * (16 - columns.mean()) / 36, 2 * (12 - rows.mean()) / 36, 2]
    assert center.tolist() == pytest.approx(expected, abs=1e-12)
    across = np.quantile(np.abs(2 * (columns - 16) / 36).repeat(len(rows)), 0.99)
    assert half_size == pytest.approx(across)


def test_eight_depth_maps_are_read_of_many_in_units_of_their_scale(tmp_path):
    """The others are not even there; half of 16 is every second."""
    there, nearer = plane(tmp_path / "a", (24, 32)), plane(tmp_path / "b", (24, 32), 0.25)
    alone, near = from_depth_maps([there], AXES), from_depth_maps([nearer], AXES)
    torch.testing.assert_close(near.center, 0.25 * alone.center)
    assert near.half_size == pytest.approx(0.25 * alone.half_size)
    gone = frame(look(np.zeros(3), np.array([0, 0, 1.0])), depth=DepthMap(tmp_path / "a/gone.png", 1.0))
    assert from_depth_maps([there, gone] * 8, AXES).half_size == pytest.approx(alone.half_size)
    with pytest.raises(MissingFile) as caught:
        from_depth_maps([gone, there] * 8, AXES)
    assert (caught.value.file, caught.value.frame) == (str(tmp_path / "a/gone.png"), 7)
    (tmp_path / "a/depth.png").write_text("depth")
    with pytest.raises(BadImage, match=r"frame 7: not an image"):
        from_depth_maps([there], AXES)
    Image.fromarray(np.zeros((24, 32), dtype=np.uint16)).save(tmp_path / "b/depth.png")
    with pytest.raises(BadPlacement, match="foreground"):
        from_depth_maps([nearer], AXES)


def test_the_cloud_comes_before_depth_maps_and_those_before_cameras(tmp_path):
    cloud = write_cloud(tmp_path / "cloud.ply", OCTAHEDRON)
    with_depth = plane(tmp_path / "a", (24, 32))
    without = [frame(look(CENTER + eye, CENTER)) for eye in orbit(4)]
    axes, frames = upright_axes([frame.camera for frame in without]), [with_depth, *without]
    assert object_placement(cloud, frames, without).half_size == from_cloud(cloud, axes).half_size
    assert object_placement(None, frames, without).half_size == from_depth_maps([with_depth], axes).half_size
    assert object_placement(None, without, without).center.tolist() == pytest.approx(CENTER.tolist())
