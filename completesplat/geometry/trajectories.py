"""Camera paths for videos, contact sheets and the viewer."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.geometry.cameras import Cameras, look_at

Vector = Float[Tensor, "3"]


def orbit(reference: Cameras, pivot: Vector, up: Vector, frames: int, degrees: float = 360.0) -> Cameras:
    """Return cameras that circle the axis through `pivot` along `up`, starting at the reference camera.

    The reference camera (unbatched) keeps its distance and height. Every camera looks at `pivot`. The last frame
    stops one step short of `degrees`, so that a full turn loops smoothly.

    Returns:
        Cameras with a leading axis of `frames`, each to the right of the one before: for a positive angle the path
        runs counter-clockwise as seen from above.
    """
    return turned(reference, pivot, up, _full_turn(frames, up) * (degrees / 360))


def turned(reference: Cameras, pivot: Vector, up: Vector, angles: Float[Tensor, " frame"]) -> Cameras:
    """Return the cameras of an `orbit` at angles in radians."""
    axis = torch.nn.functional.normalize(up, dim=-1)
    arm = reference.centers - pivot
    cos = angles.cos()[:, None]
    sin = angles.sin()[:, None]
    # Rodrigues' formula for the rotation of the arm about the axis.
    eyes = arm * cos + torch.linalg.cross(axis, arm) * sin + axis * (axis @ arm) * (1 - cos) + pivot
    return _looking_at(reference, eyes, pivot, axis)


def swipe(reference: Cameras, pivot: Vector, up: Vector, frames: int, reach: float = 0.3) -> Cameras:
    """Return cameras that go left, right and back on a level straight line, looking at `pivot`.

    They start at the reference camera (unbatched), slow down towards both ends, and stop one step before the start.

    Args:
        up: the line is orthogonal to it and to the direction of `pivot`.
        reach: greatest distance to either side, as a share of the distance of `pivot`.
    """
    angles = _full_turn(frames, up)
    right, _ = _sideways(reference, pivot, up)
    return _looking_at(reference, reference.centers - reach * angles.sin()[:, None] * right, pivot, up)


def wobble(reference: Cameras, pivot: Vector, up: Vector, frames: int, radius: float = 0.1) -> Cameras:
    """Return cameras on a small circle around the reference camera (unbatched), looking at `pivot`.

    The circle is orthogonal to the direction of `pivot`, begins right, goes up and ends one step before its start.

    Args:
        radius: radius of the circle, as a share of the distance of `pivot`.
    """
    angles = _full_turn(frames, up)
    right, above = _sideways(reference, pivot, up)
    eyes = reference.centers + radius * (angles.cos()[:, None] * right + angles.sin()[:, None] * above)
    return _looking_at(reference, eyes, pivot, up)


PATHS = {"orbit": orbit, "swipe": swipe, "wobble": wobble}


def _full_turn(frames: int, like: Tensor) -> Float[Tensor, " frame"]:
    return torch.arange(frames, dtype=like.dtype, device=like.device) / frames * (2 * math.pi)


def _sideways(reference: Cameras, pivot: Vector, up: Vector) -> tuple[Vector, Vector]:
    """Return vectors to the right and up, orthogonal to the pivot's direction and as long as its distance."""
    forward = pivot - reference.centers
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    return right * forward.norm(), torch.linalg.cross(right, forward)


def _looking_at(reference: Cameras, eyes: Float[Tensor, "frame 3"], pivot: Vector, up: Vector) -> Cameras:
    intrinsics = reference.intrinsics.expand(len(eyes), 3, 3)
    return replace(reference, world_to_camera=look_at(eyes, pivot, up), intrinsics=intrinsics)
