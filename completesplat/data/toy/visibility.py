"""What one frame of a toy scene shows and another does not, exactly: by a ray to every point."""

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from completesplat.data.toy.raytracing import trace
from completesplat.data.toy.scene import ToyScene, render_frame
from completesplat.geometry.cameras import Cameras, invert_rigid, pinhole, pixel_centers, project, unproject

# Of the distance: what is seen at this much less is something else, in front.
CLOSER = 1e-3


def unseen(scene: ToyScene, reference: int, frame: int, size: int) -> Bool[Tensor, "size size"]:
    """The pixels of `frame` whose middle shows a point that is hidden in the picture of `reference`, or outside it."""
    camera, other = (frame_camera(scene, index, size) for index in (frame, reference))
    depth = torch.from_numpy(render_frame(scene, frame, size)[2]).flatten()
    points = unproject(camera, pixel_centers(size, size, dtype=torch.float64).flatten(0, 1), depth)
    pixels, distance_ahead = project(other, points)
    within = (distance_ahead > 0) & (pixels > 0).all(-1) & (pixels < size).all(-1)
    offsets = points - other.centers
    distances = offsets.norm(dim=-1)
    rays = (offsets / distances[:, None]) @ other.world_to_camera[:3, :3].mT
    pose = scene.camera_to_world[reference]
    met = trace(scene.geometry, scene.surroundings, scene.patch, pose, np.ascontiguousarray(rays.numpy()[:, None]))[2]
    return ~(within & (torch.from_numpy(met) > (1 - CLOSER) * distances)).unflatten(0, (size, size))


def frame_camera(scene: ToyScene, frame: int, size: int) -> Cameras:
    """The camera of a frame, float64, in the scene's own lengths."""
    pose = torch.from_numpy(scene.camera_to_world[frame])
    return Cameras(invert_rigid(pose), pinhole(scene.fov_degrees, size).double(), (size, size))
