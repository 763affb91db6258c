"""A cross at one place of the scene, which must stick to that place in all pictures where the cameras are right."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.typical_camera import world_up
from completesplat.geometry.cameras import Cameras, project, transform_points

# In units of half the first picture's width, seen from the first camera.
ARM = 0.3
# Root mean squares: image axes must turn by so much (radians) for the horizon to be known from them; optical axes must
# spread by so much, and pass by their common point within so much of its depth, to look at one thing.
LEAST_TURN, LEAST_SPREAD, LARGEST_MISS = 0.1, 0.2, 0.2
# Candidates for the place of the cross along an axis; in a picture, it counts as seen so far from the borders (shares).
DEPTHS, BORDER = 16, 0.1
# Of the length of an arm: what is nearer to a camera's plane is not drawn.
NEAREST = 0.05


@dataclass(frozen=True)
class Cross:
    """Three arms from one place and a level square around it; rows of `arms`: right, up and ahead."""

    center: Float[Tensor, "3"]
    arms: Float[Tensor, "3 3"]

    def ends(self) -> Float[Tensor, "3 2 3"]:
        """The two ends of each arm in the world; it begins at the centre."""
        return torch.stack([self.center.expand(3, 3), self.center + self.arms], dim=1)

    def square(self) -> Float[Tensor, "4 2 3"]:
        """The two ends of each side in the world."""
        right, _, ahead = self.arms
        corners = self.center + torch.stack([right + ahead, right - ahead, -right - ahead, -right + ahead])
        return torch.stack([corners, corners.roll(-1, 0)], dim=1)


def place_cross(cameras: Cameras, depth_range: Float[Tensor, "2"]) -> Cross:
    """A cross for cameras [view]: where their optical axes meet, if they do in front of all of them.

    Otherwise on the axis of the first, the middle or the last camera, where most cameras see it; of the best places
    the nearest, but none nearer than the middle of the depth range in terms of 1 / depth.

    Args:
        depth_range: near and far of the first camera.
    """
    center = _common_point(cameras)
    if center is None:
        center = _most_seen_point(cameras, depth_range)
    depth = transform_points(cameras.world_to_camera[0], center[None])[0, 2].abs()
    length = ARM * depth * cameras.image_size[1] / 2 / cameras.intrinsics[0, 0, 0]
    return Cross(center, length * level_axes(cameras))


def level_axes(cameras: Cameras) -> Float[Tensor, "3 3"]:
    """Unit vectors in the world as rows: the first camera's right, up and forward, turned so that up is the world's.

    Where the cameras [view] hardly turn, no horizon follows from them, and the mean of their own up directions is
    taken.
    """
    right, down, forward = cameras.world_to_camera[:, :3, :3].unbind(dim=1)
    turn = torch.linalg.svdvals(right)[1:2] / len(right) ** 0.5
    up = world_up(cameras) if (turn > LEAST_TURN).any() else torch.nn.functional.normalize(-down.mean(dim=0), dim=0)
    # In a picture taken straight down, ahead is at its upper edge; in one taken straight up, at its lower.
    ahead = forward[0] if (forward[0] @ up).abs() < 0.99 else down[0] * (forward[0] @ up).sign()
    ahead = torch.nn.functional.normalize(ahead - (ahead @ up) * up, dim=0)
    return torch.stack([torch.linalg.cross(ahead, up), up, ahead])


def visible_segments(
    camera: Cameras, segments: Float[Tensor, "segment 2 3"], nearest: float
) -> list[tuple[int, Float[Tensor, "2 2"]]]:
    """Number and ends in pixels of the segments, cut off where they are less deep than `nearest` before a camera []."""
    _, depths = project(camera, segments.flatten(0, 1))
    result = []
    for index, (ends, depth) in enumerate(zip(segments, depths.unflatten(0, (-1, 2)), strict=True)):
        if depth.max() <= nearest:
            continue
        shares = ((nearest - depth) / (depth.flip(0) - depth)).where(depth < nearest, 0)
        pixels, _ = project(camera, ends + shares[:, None] * (ends.flip(0) - ends))
        result.append((index, pixels))
    return result


def _common_point(cameras: Cameras) -> Float[Tensor, "3"] | None:
    """The point nearest to all optical axes, if they pass it closely, from several sides, and it lies before them."""
    forward, centers = cameras.world_to_camera[:, 2, :3], cameras.centers
    across = torch.eye(3).to(forward) - forward[:, :, None] * forward[:, None, :]
    mean = across.mean(dim=0)
    if torch.linalg.eigvalsh(mean)[0] < LEAST_SPREAD**2:
        return None
    point = torch.linalg.solve(mean, (across @ centers[:, :, None]).mean(dim=0)[:, 0])
    offsets = point - centers
    depths = (offsets * forward).sum(dim=-1)
    misses = (across @ offsets[:, :, None]).square().sum(dim=(1, 2))
    met = (depths > 0).all() and misses.mean().sqrt() < LARGEST_MISS * depths.mean()
    return point if met else None


def _most_seen_point(cameras: Cameras, depth_range: Float[Tensor, "2"]) -> Float[Tensor, "3"]:
    near, far = depth_range.double().tolist()
    depths = torch.logspace(math.log10(2 / (1 / near + 1 / far)), math.log10(far), DEPTHS).to(cameras.intrinsics)
    count = len(cameras.centers)
    chosen = [0, count // 2, count - 1]
    origins, forward = cameras.centers[chosen], cameras.world_to_camera[chosen, 2, :3]
    # All three candidates at one depth stand before those at the next: the first of the best is the nearest.
    points = (origins + depths[:, None, None] * forward).flatten(0, 1)
    pixels, depth = project(cameras, points)
    height, width = cameras.image_size
    shares = pixels / torch.tensor([width, height]).to(pixels)
    seen = ((shares - 0.5).abs() < 0.5 - BORDER).all(dim=-1) & (depth > near)
    return points[seen.sum(dim=0).argmax()]
