"""Conventions of the matrices in `transforms.json`: which of them would put the scene in front of the cameras."""

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from completesplat.errors import BadPlacement
from completesplat.geometry.cameras import Cameras, nearest_to_axes

AXES = ("opengl", "opencv")
MATRICES = ("camera_to_world", "world_to_camera")
MOST_POINTS = 2000
FAR_BETTER = 3.0  # factor by which another convention must show more of the scene
Matrix = Float[np.ndarray, "4 4"]


def to_camera_to_world(matrix: Matrix, axes: str, matrices: str) -> Matrix:
    """Return a matrix of another convention as camera-to-world with OpenGL's axes (+x right, +y up, +z backward)."""
    pose = np.linalg.inv(matrix) if matrices == "world_to_camera" else matrix.copy()
    if axes == "opencv":
        pose[:3, 1:3] *= -1
    return pose


def require_sight(cameras: Sequence[Cameras], points: Float[np.ndarray, "n 3"] | None) -> None:
    """Refuse cameras that look away from the scene, if other conventions of their matrices would not.

    The scene is its points or, without points, the place that the optical axes are nearest to.

    Raises:
        BadPlacement: the message names the settings of `data import` with which the cameras would see the scene.
    """
    poses = np.stack([np.linalg.inv(camera.world_to_camera.numpy()) for camera in cameras])
    poses[:, :3, 1:3] *= -1  # OpenGL's axes, as in the file
    if points is not None:
        points = points[:: max(1, len(points) // MOST_POINTS)]
    shares = {}
    for axes, matrices in itertools.product(AXES, MATRICES):
        meant = np.stack([to_camera_to_world(pose, axes, matrices) for pose in poses])
        shares[axes, matrices] = _seen_share(meant, cameras, points)
    given = shares[AXES[0], MATRICES[0]]
    best = max(shares, key=shares.__getitem__)
    if shares[best] > FAR_BETTER * given:
        settings = f"axes={best[0]} matrices={best[1]}"
        sight = f"the cameras look away from the scene (they see {given:.0%} of it, with {settings} {shares[best]:.0%})"
        raise BadPlacement(f"{sight}: completesplat data import FOLDER {settings} writes a capture of that convention")


def _seen_share(
    poses: Float[np.ndarray, "camera 4 4"], cameras: Sequence[Cameras], points: Float[np.ndarray, "n 3"] | None
) -> float:
    """Return the mean share of the scene that lies in front of a camera and within its image."""
    world_to_cameras = np.linalg.inv(poses * [1, -1, -1, 1])
    if points is None:
        tensors = torch.from_numpy(world_to_cameras)
        center = nearest_to_axes(Cameras(tensors, tensors.new_zeros(len(cameras), 3, 3), (1, 1)))
        if center is None:
            return 0.0
        points = center.numpy()[None]
    shares = []
    for camera, world_to_camera in zip(cameras, world_to_cameras, strict=True):
        height, width = camera.image_size
        x, y, depth = (points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]).T
        fx, fy = camera.intrinsics.diagonal()[:2].tolist()
        cx, cy = camera.intrinsics[:2, 2].tolist()
        across = (x * fx + cx * depth > 0) & (x * fx + cx * depth < width * depth)
        down = (y * fy + cy * depth > 0) & (y * fy + cy * depth < height * depth)
        shares.append(np.mean((depth > 0) & across & down))
    return float(np.mean(shares))
