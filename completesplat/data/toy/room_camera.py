"""How a camera moves through a toy room, and how its poses are told: in a world that is not the room's."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from completesplat.data.toy.ingredients import Array
from completesplat.data.toy.room_furniture import Solid
from completesplat.data.toy.shapes import rotation_about
from completesplat.geometry.cameras import invert_rigid, look_at

MARGIN = 0.3
LOWEST, HIGHEST = 1.0, 1.7
# A video of 30 frames a second, taken at a slow walk.
STEPS = (0.012, 0.032)
LARGEST_TURN = np.radians(3.0)
WAYPOINTS = 4
FIELD_OF_VIEW = (55, 75)
DENSE = 400
ASPECT = 16 / 9
UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


@dataclass(frozen=True)
class CameraMove:
    """Poses in the room ([frame 4 4], OpenCV axes), the lens, and the world that the files speak of.

    `focal`: in widths of the picture. `principal_point`: (x, y) in widths and heights. A point of the room lies in the
    world at `unit` * `rotation` @ point + `origin`; as in RealEstate10K, the world's +y points down.
    """

    camera_to_room: Array
    focal: float
    principal_point: Array
    unit: float
    rotation: Array
    origin: Array

    def intrinsics(self, height: int, width: int) -> Array:
        """fx, fy, cx, cy in shares of width, height, width, height, for square pixels."""
        return np.array([self.focal, self.focal * width / height, *self.principal_point])

    def world_to_camera(self) -> Array:
        """[frame 3 4], in the world and its unit."""
        rotation = np.swapaxes(self.camera_to_room[:, :3, :3], 1, 2) @ self.rotation.T
        centers = self.unit * self.camera_to_room[:, :3, 3] @ self.rotation.T + self.origin
        return np.concatenate([rotation, -rotation @ centers[:, :, None]], axis=2)


def image_width(height: int) -> int:
    """The even number next to 16 / 9 of the height."""
    return 2 * round(height * ASPECT / 2)


def draw_move(rng: np.random.Generator, frames: int, size: Array, furniture: Sequence[Solid]) -> CameraMove:
    """A walk through the free space of a room, MARGIN away from everything."""
    centers, tangents = _path(rng, frames, size, furniture)
    yaw = np.unwrap(np.arctan2(tangents[:, 0], tangents[:, 2])) + rng.normal(0, 0.2)
    swing = 2 * np.pi * (np.linspace(0, rng.uniform(0.2, 1.0), frames) + rng.uniform())
    pitch = np.radians(rng.uniform(-16, -2) + 2 * np.sin(swing))
    forward = np.stack([np.cos(pitch) * np.sin(yaw), np.sin(pitch), np.cos(pitch) * np.cos(yaw)], axis=1)
    room_to_camera = look_at(torch.from_numpy(centers), torch.from_numpy(centers + forward), UP)
    return CameraMove(
        camera_to_room=invert_rigid(room_to_camera).numpy(),
        focal=float(0.5 / np.tan(np.radians(rng.uniform(*FIELD_OF_VIEW)) / 2)),
        principal_point=0.5 + (rng.uniform(-0.03, 0.03, 2) if rng.uniform() < 0.25 else np.zeros(2)),
        unit=float(rng.uniform(0.5, 2.0)),
        rotation=rotation_about("y", rng.uniform(0, 2 * np.pi)) @ rotation_about("x", np.pi),
        origin=rng.normal(size=3),
    )


def _path(rng: np.random.Generator, frames: int, size: Array, furniture: Sequence[Solid]) -> tuple[Array, Array]:
    """Places [frame 3] at equal steps along a cubic through random waypoints, and tangents [frame 3].

    Paths that come too near to something or turn too fast are drawn anew, shorter and shorter, so that one is found.
    """
    stride, step = 1.2, rng.uniform(*STEPS)
    while True:
        waypoints = _waypoints(rng, size, stride)
        parameters = np.linspace(0, 1, WAYPOINTS)
        cubic = np.polynomial.polynomial.polyfit(parameters, waypoints, WAYPOINTS - 1)
        dense = np.linspace(0, 1, DENSE)
        points = np.polynomial.polynomial.polyval(dense, cubic).T
        lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        reached = np.linspace(0, min(step * (frames - 1), lengths[-1]), frames)
        times = np.interp(reached, lengths, dense)
        centers = np.polynomial.polynomial.polyval(times, cubic).T
        slopes = np.polynomial.polynomial.polyval(times, np.polynomial.polynomial.polyder(cubic)).T
        if _is_free(centers, size, furniture) and _largest_turn(slopes) < LARGEST_TURN:
            return np.ascontiguousarray(centers), slopes
        stride *= 0.99


def _waypoints(rng: np.random.Generator, size: Array, stride: float) -> Array:
    """[waypoint 3]: about `stride` apart, first towards the middle, then bending by at most 60 degrees each time."""
    start = rng.uniform(-0.5, 0.5, 2) * (size[[0, 2]] - 2 * MARGIN)
    first = np.arctan2(-start[0], -start[1]) + rng.uniform(-np.pi / 4, np.pi / 4)
    heading = np.cumsum(np.append(first, rng.uniform(-np.pi / 3, np.pi / 3, WAYPOINTS - 2)))
    steps = stride * rng.uniform(0.7, 1.3, WAYPOINTS - 1)
    x, z = np.cumsum(
        np.stack([start, *np.stack([np.sin(heading), np.cos(heading)], axis=1) * steps[:, None]]), axis=0
    ).T
    heights = rng.uniform(1.1, 1.6) + rng.normal(0, 0.05, WAYPOINTS)
    return np.stack([x, heights, z], axis=1)


def _is_free(centers: Array, size: Array, furniture: Sequence[Solid]) -> bool:
    inside = np.abs(centers[:, [0, 2]]) <= size[[0, 2]] / 2 - MARGIN
    high = (centers[:, 1] >= LOWEST) & (centers[:, 1] <= HIGHEST)
    return bool(inside.all() and high.all() and all((s.distances(centers) >= MARGIN).all() for s in furniture))


def _largest_turn(tangents: Array) -> float:
    yaw = np.unwrap(np.arctan2(tangents[:, 0], tangents[:, 2]))
    return float(np.abs(np.diff(yaw)).max())
