"""The object that a photo is of: its place and size in a scene, and the camera that sees it from all around."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from completesplat.export.placed_scene import PlacedScene
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, crop_resize, pixel_centers, rays_through, transform_points
from completesplat.rasterizers import Rasterizer
from completesplat.tensors import TensorDataclass

SIDE = 48  # pixels of the image in which an object is sought
WIDTH = 0.25  # standard deviation of the kernel, in halves of the image's width at its place
REACH = 4.0  # standard deviations of the kernel within which what is seen may be the object's
NEARNESS = 2  # exponent of 1 / depth in the weights
STANDING_OUT = 6  # exponent of the median depth of a pixel's row over its own: a floor's is 1, an object's is larger
ROUNDS = 10  # of the mean shift
ALMOST_ALL = 0.98  # share of an object's pixels that its radius holds
HIDDEN_DEPTH = 0.5  # of the half size of an object's front: how far its middle lies behind the front
MARGIN = 1.05  # of the distance at which an object just fits into the frame


@dataclass(frozen=True)
class Subject(TensorDataclass):
    """Middle of an object in the world, and the radius of a ball around it that holds the object."""

    center: Float[Tensor, "3"]
    radius: float = 0.0


@dataclass(frozen=True)
class _Front(TensorDataclass):
    """What a camera sees of a scene at some pixels, in the frame of the camera."""

    rays: Float[Tensor, "pixel 3"]
    weights: Float[Tensor, " pixel"]
    points: Float[Tensor, "pixel 3"]


def subject_of(scene: PlacedScene, rasterizer: Rasterizer) -> Subject:
    """Return what orbits of a scene turn around: the known pivot, or the object in its camera's image.

    The object is where the scene's mask is. Without one, it is what lies around the mode of the points that the camera
    sees, weighted by opacity, by nearness and by how much nearer they are than others in their row of pixels. It ends
    at the gap between near and far.
    """
    if scene.pivot is not None:
        return Subject(scene.pivot)
    height, width = scene.camera.image_size
    side = max(height, width)
    camera = crop_resize(scene.camera, (width - side) / 2, (height - side) / 2, side, SIDE)
    front = _front(scene.gaussians, camera, rasterizer)
    if scene.own is not None:
        own = _within(scene.own, front, camera)
        front = front.map(lambda values: values[own])
    if len(front.points) == 0:
        return Subject(_on_axis(scene))
    half_width = SIDE / (2 * camera.intrinsics[0, 0].item())  # at a depth of 1
    inside = None if scene.mask is None else _within(scene.mask, front, camera)
    if inside is None or not inside.any():
        inside = _around_mode(front, half_width)
    rays = front.rays[inside]
    ray = (rays.amin(0) + rays.amax(0)) / 2
    depths = front.points[inside, 2]
    depth = depths.median().item()
    half_size = (rays.amax(0) - rays.amin(0)).max().item() / 2 * depth
    # At the outline of the object, depths are partly of what lies behind it.
    points = rays * depths.clamp(depth - half_size, depth + half_size)[:, None]
    center = ray * (depth + HIDDEN_DEPTH * half_size if scene.depth is None else scene.depth)
    radius = max(half_size, _radius(points, center))
    return Subject(transform_points(scene.camera.camera_to_world, center[None])[0], radius)


def all_around(camera: Cameras, subject: Subject) -> Cameras:
    """Return a camera in the direction of an unbatched one, from which an object stays in the frame all around.

    It is no nearer to the object, and its optical axis meets the middle of the image.
    """
    height, width = camera.image_size
    intrinsics = camera.intrinsics.clone()
    intrinsics[:2, 2] = intrinsics.new_tensor([width / 2, height / 2])
    half_angles = (math.atan(size / (2 * intrinsics[axis, axis].item())) for axis, size in enumerate((width, height)))
    needed = MARGIN * subject.radius / math.sin(min(half_angles))
    arm = camera.centers - subject.center
    eye = subject.center + arm * max(1.0, needed / max(arm.norm().item(), 1e-9))
    moved = camera.world_to_camera.clone()
    moved[:3, 3] = -moved[:3, :3] @ eye
    return Cameras(moved, intrinsics, camera.image_size)


@torch.no_grad()
def _front(gaussians: Gaussians, camera: Cameras, rasterizer: Rasterizer) -> _Front:
    """Return what a camera sees at all pixels that are more than half opaque."""
    rendering = rasterizer(gaussians[None], camera[None][None])[0, 0]
    rows = rendering.surface_depth()[0]
    typical = torch.where(rows > 0, rows, torch.nan).nanmedian(dim=1, keepdim=True).values
    weights = rendering.alpha[0] * (typical / rows) ** STANDING_OUT * rows**-NEARNESS
    depth = rows.flatten()
    rays = rays_through(camera.intrinsics, pixel_centers(SIDE, SIDE).to(depth).flatten(0, 1))
    seen = depth > 0
    return _Front(rays[seen], weights.flatten()[seen], rays[seen] * depth[seen, None])


def _within(mask: Float[Tensor, "1 _ _"], front: _Front, camera: Cameras) -> Bool[Tensor, " pixel"]:
    """Return which pixels lie where a mask of the camera's image is not 0."""
    small = functional.interpolate(mask[None], (SIDE, SIDE), mode="area")[0, 0]
    columns, rows = (front.rays @ camera.intrinsics.T)[:, :2].floor().long().clamp(0, SIDE - 1).unbind(-1)
    return small[rows, columns] > 0.5


def _around_mode(front: _Front, half_width: float) -> Bool[Tensor, " pixel"]:
    """Return which pixels show what lies around the mode, which is found by mean shift from the densest pixel."""
    depths = front.points[:, 2]
    widths = WIDTH * half_width * depths
    kernel = torch.exp(-(torch.cdist(front.points, front.points) / widths[:, None]).square() / 2)
    best = (kernel @ front.weights).argmax()
    mode = front.points[best]
    for _ in range(ROUNDS):
        near = front.weights * torch.exp(-((front.points - mode).norm(dim=-1) / widths[best]).square() / 2)
        mode = (near[:, None] * front.points).sum(0) / near.sum()
    gap = _gap(depths)
    close = (front.points - mode).norm(dim=-1) < REACH * widths[best]
    alike = close & ((depths < gap) == (mode[2] < gap))
    return alike if alike.any() else close


def _gap(depths: Float[Tensor, " pixel"]) -> Float[Tensor, ""]:
    """Return the depth that parts near from far: the one with the largest variance of 1 / depth between both (Otsu)."""
    ordered = (1 / depths).sort().values
    count = len(ordered)
    if count < 2:
        return depths.new_tensor(math.inf)
    below = torch.arange(1, count, device=depths.device)
    sums = ordered.cumsum(0)[:-1]
    apart = sums / below - (ordered.sum() - sums) / (count - below)
    place = (below * (count - below) * apart.square()).argmax()
    return 2 / (ordered[place] + ordered[place + 1])


def _radius(points: Float[Tensor, "n 3"], center: Float[Tensor, "3"]) -> float:
    """Return the radius of the ball around a centre that holds almost all points."""
    return torch.quantile((points - center).norm(dim=-1), ALMOST_ALL).item()


def _on_axis(scene: PlacedScene) -> Float[Tensor, "3"]:
    """Return the point on the optical axis at the known depth, or at the median depth of all Gaussians."""
    depths = transform_points(scene.camera.world_to_camera, scene.gaussians.means)[:, 2]
    axis = scene.camera.camera_to_world[:3, 2]
    return scene.camera.centers + axis * (depths.median().item() if scene.depth is None else scene.depth)
