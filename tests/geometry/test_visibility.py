import torch

from completesplat.geometry.cameras import Cameras, look_at, pinhole
from completesplat.geometry.surfaces import hidden_from

SIZE = 32


def wall_and_square():
    """A square of side 1 at z = 0 before a wall at z = 2, seen from the front and from the side."""
    eyes = torch.tensor([[0.0, 0.0, -3.0], [2.0, 0.0, -3.0]])
    poses = look_at(eyes, torch.tensor([[0.0, 0, 0], [2.0, 0, 0]]), torch.tensor([0.0, -1.0, 0.0]))
    cameras = Cameras(poses, pinhole(90.0, SIZE).expand(2, 3, 3), (SIZE, SIZE))
    axis = (torch.arange(SIZE) + 0.5) / SIZE * 2 - 1  # of the ray at z = 1
    depths = torch.full((2, 1, SIZE, SIZE), 5.0)
    for view, offset in enumerate((0.0, 2.0)):
        x = 3 * axis + offset
        y = 3 * axis
        depths[view, 0][(y.abs()[:, None] < 0.5) & (x.abs()[None] < 0.5)] = 3.0
    return cameras, depths


def test_surfaces_behind_or_outside_are_hidden():
    cameras, depths = wall_and_square()
    hidden, known = hidden_from(cameras[0], depths[0], cameras, depths)
    assert not hidden[0].any()  # a camera sees all that it sees
    assert known.all()
    x = 5 * ((torch.arange(SIZE) + 0.5) / SIZE * 2 - 1) + 2  # of the wall, in the second camera's pixels
    middle = hidden[1, SIZE // 2]
    square = depths[1, 0, SIZE // 2] == 3
    assert not middle[square].any()  # the square itself is seen
    behind = ~square & (x.abs() < 0.6)
    outside = x > 5.2
    assert behind.any()
    assert middle[behind].all()
    assert middle[outside].all()
    assert not middle[~square & (x > 1.2) & (x < 4.8)].any()


def test_pixels_without_depth_are_unknown():
    cameras, depths = wall_and_square()
    depths[1, 0, :4] = 0
    hidden, known = hidden_from(cameras[0], depths[0], cameras[1:], depths[1:])
    assert not known[0, :4].any()
    assert not hidden[0, :4].any()
    hidden, known = hidden_from(cameras[0], torch.zeros_like(depths[0]), cameras[1:], depths[1:])
    assert not known[0, SIZE // 2, : SIZE // 2].any()
