"""Placement of a sequence's object: square images, a common object size, and depth ranges around the object."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from completesplat.data.sequences import MaskedImage, PosedSequence
from completesplat.errors import BadCamera, BadPlacement
from completesplat.geometry.cameras import Cameras, crop_resize, nearest_to_axes, transform_points
from completesplat.photo.crop import Square, cut_square, principal_square
from completesplat.tensors import stack

UP = 1
# The object's half size (see `Placement`) after scaling (Splatter Image: 1.2 * 0.95 / 2).
OBJECT_HALF_SIZE = 0.57
SMALLEST_NEAR = 0.1
# Cameras that move by less than this share of their distance to the object show only one view of it.
SMALLEST_BASELINE = 0.01

Axes = Float[np.ndarray, "3 3"]


class ObjectFraming(NamedTuple):
    """Image size, and depth range in front of and behind the centre of an object whose half size is 0.57."""

    image_size: int
    depth_before: float
    depth_after: float

    def cut(self, camera: Cameras, image: Image.Image, mask: Image.Image) -> MaskedImage:
        """Return the squares of an image and its mask around the principal point of the camera."""
        square = square_of(camera)
        return MaskedImage(cut_square(image, square, self.image_size), cut_square(mask, square, self.image_size))


class Placement(NamedTuple):
    """Centre and half size of the object, which is the largest distance from the centre along an upright axis."""

    center: Float[Tensor, "3"]
    half_size: float


def upright_axes(cameras: Sequence[Cameras]) -> Axes:
    """Return the axes of an upright frame in the sequence's world, as columns. The second points up or down.

    People hold a camera level, so its x axis varies least along the vertical. It varies most along the first of these
    axes (Splatter Image, `co3d_normalisation.py`).
    """
    sideways = torch.stack([camera.world_to_camera[0, :3] for camera in cameras]).numpy()
    sideways = sideways - sideways.mean(axis=0)
    least, middle, most = np.linalg.eigh(sideways.T @ sideways)[1].T
    return np.stack([most, least, middle], axis=-1)


def from_points(points: Float[np.ndarray, "n 3"], axes: Axes, what: str, quantile: float = 1.0) -> Placement:
    """Place the object as Splatter Image does (`co3d_normalisation.py`).

    The centre is the points' mean, but its height is the middle between the lowest and the highest point. The half size
    is the largest absolute coordinate relative to this centre, along the axes. A `quantile` below 1 replaces
    the largest and smallest values.

    Raises:
        BadPlacement: there are no points, they are not finite, or all are in one place.
    """
    if not len(points) or not np.isfinite(points).all():
        raise BadPlacement(f"{what} is empty or not finite")
    mean = points.mean(axis=0)
    upright = (points - mean) @ axes
    middle = np.quantile(upright[:, UP], [1 - quantile, quantile]).mean()
    upright[:, UP] -= middle
    half_size = float(np.quantile(np.abs(upright), quantile, axis=0).max())
    if not half_size > 0:
        raise BadPlacement(f"{what} is without extent")
    return Placement(torch.from_numpy(mean + middle * axes[:, UP]), half_size)


def from_cameras(cameras: Sequence[Cameras]) -> Placement:
    """Place the object at the point nearest to all optical axes, as if it filled the images' largest square.

    Raises:
        BadPlacement: the optical axes are parallel or meet behind the cameras.
    """
    world_to_camera = torch.stack([camera.world_to_camera for camera in cameras])
    center = nearest_to_axes(Cameras(world_to_camera, world_to_camera.new_zeros(len(cameras), 3, 3), (1, 1)))
    if center is None:
        raise BadPlacement("no point cloud, no depth maps, and optical axes that do not meet")
    depths = transform_points(world_to_camera, center[None])[:, 0, 2]
    # Half the side of each camera's square, at depth 1.
    extents = []
    for camera in cameras:
        focal = camera.intrinsics.diagonal()[:2].max().item()
        extents.append(0.5 * square_of(camera).side / focal)
    half_size = (depths * torch.tensor(extents, dtype=depths.dtype)).median().item()
    if not (half_size > 0 and np.isfinite(half_size)):
        advice = "if matrices in transforms.json have OpenCV's axes, negate their second and third columns"
        raise BadPlacement(f"no point cloud, no depth maps, and optical axes that meet behind the cameras: {advice}")
    return Placement(center, half_size)


def square_of(camera: Cameras) -> Square:
    """Return the largest square around the principal point of one camera."""
    x, y = camera.intrinsics[:2, 2].tolist()
    return principal_square((x, y), camera.image_size)


def placed_sequence(
    name: str,
    frames: Sequence[int],
    cameras: Sequence[Cameras],
    placement: Placement,
    framing: ObjectFraming,
    read: Callable[[int], MaskedImage],
) -> PosedSequence:
    """Crop each camera to its square, and scale the world such that the object has the common half size.

    Raises:
        BadCamera: the cameras do not move.
    """
    factor = OBJECT_HALF_SIZE / placement.half_size
    squares = stack([crop_resize(camera, *square_of(camera), framing.image_size) for camera in cameras])
    squares = squares.scale_world(torch.tensor(factor, dtype=torch.float64))
    center = factor * placement.center
    baseline = (squares.centers - squares.centers[0]).norm(dim=-1).max()
    depths = transform_points(squares.world_to_camera, center[None])[..., 0, 2]
    if not baseline > SMALLEST_BASELINE * depths.abs().mean():
        raise BadCamera("the cameras do not move")
    return PosedSequence(name, tuple(frames), squares, depths_around(squares, center, framing), read, scale=factor)


def depths_around(cameras: Cameras, center: Float[Tensor, "3"], framing: ObjectFraming) -> Float[Tensor, "view 2"]:
    """Return near and far for each camera [view], before and behind the centre of the object, in float32.

    If a broken pose puts the object behind the camera, the depth range still has a positive length.
    """
    depths = transform_points(cameras.world_to_camera, center[None])[..., 0, 2]
    near = (depths - framing.depth_before).clamp(min=SMALLEST_NEAR)
    far = torch.maximum(depths, near) + framing.depth_after
    return torch.stack([near, far], dim=-1).to(torch.float32)
