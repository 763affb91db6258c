"""A scene in the world with the camera of its photo, and the coordinates of its files."""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras

FARTHEST = 1000.0  # scene radii from the origin, about, where float32 is still finer than a hundredth of a pixel


@dataclass(frozen=True)
class FileCoordinates:
    """Units and origin of the coordinates in files.

    Attributes:
        scale: units of the world in one unit of the files.
        origin: the world's origin in the user's coordinates, which the files have too, unless they are too far away.
    """

    scale: float = 1.0
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def offset(self) -> tuple[float, ...]:
        """The files' origin in the user's coordinates: 0 unless float32 would be too coarse for these."""
        return self.origin if math.hypot(*self.origin) * self.scale > FARTHEST else (0.0, 0.0, 0.0)

    def points(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Return points of the world in the files' coordinates."""
        return points / self.scale + torch.tensor(self.origin).sub(torch.tensor(self.offset)).to(points)

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians of the world in the files' coordinates."""
        return replace(gaussians, means=self.points(gaussians.means), scales=gaussians.scales / self.scale)

    def camera(self, camera: Cameras) -> Cameras:
        """Return a camera of the world in the files' coordinates."""
        moved = torch.eye(4).to(camera.intrinsics)
        moved[:3, 3] = -self.points(torch.zeros(3))
        camera = camera.scale_world(torch.tensor(1 / self.scale).to(moved))
        return replace(camera, world_to_camera=camera.world_to_camera @ moved)


@dataclass(frozen=True)
class PlacedScene:
    """Gaussians in the world, with the camera of the photo that shows them, or of the first photo.

    Attributes:
        up: direction up in the world, the axis of orbits.
        pivot: point in the world around which orbits turn, if it is known.
        mask: where the object is in the camera's image (`subject_of`), if that is known.
        own: where the camera's image is the photo's own, if its border is continued.
        depth: depth of the object's middle, if it is known.
        coordinates: those of the scene's files.
    """

    gaussians: Gaussians
    camera: Cameras
    up: Float[Tensor, "3"] = field(default_factory=lambda: torch.tensor([0.0, -1.0, 0.0]))
    pivot: Float[Tensor, "3"] | None = None
    mask: Float[Tensor, "1 _ _"] | None = None
    own: Float[Tensor, "1 _ _"] | None = None
    depth: float | None = None
    coordinates: FileCoordinates = FileCoordinates()
