"""The 3D part of the page: splats, the places of samples, and the viewpoint."""

import math
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import viser
import viser.transforms as vtf
from jaxtyping import Float
from torch import Tensor

from completesplat.export.images import color_depth
from completesplat.export.splat import round_to_uint8
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points
from completesplat.geometry.rotations import matrix_to_quaternion
from completesplat.geometry.trajectories import orbit
from completesplat.viewer.sample import Sample

LARGEST_COVARIANCE = 3e4
GAP = 1.25
NARROWEST_WINDOW = 1.1
SAME = 0.15
FADED = 0.15  # factor of the opacities of an earlier photo's scene
MARGIN = 1.15  # height and width that are shown, as multiples of the photo's
REFERENCE_COLOR = (200, 60, 40)
ORBIT_COLOR = (60, 60, 60)


@dataclass(frozen=True)
class Arrangement:
    """A row of samples and its camera. A single sample is seen as by its reference camera, with a margin around it.

    Attributes:
        pivots: the point that each sample turns about, before it is moved to its place.
        right, spacing: direction of the row, and distance between neighbours (1.25 image widths at the pivot).
        position, look_at: place and target of the page's camera.
        fov: its vertical field of view, in radians, in windows that are not narrower than `aspect`.
        aspect: width / height of the region that must be visible.
    """

    pivots: list[Float[Tensor, "3"]]
    right: Float[np.ndarray, "3"]
    spacing: float
    position: Float[np.ndarray, "3"]
    look_at: Float[np.ndarray, "3"]
    fov: float
    aspect: float

    @property
    def distance(self) -> float:
        """Distance from the camera to its target."""
        return float(np.linalg.norm(self.look_at - self.position))

    def shift(self, index: int) -> Float[np.ndarray, "3"]:
        """Return a sample's offset from its place in the world, which is the middle of the row."""
        return self.right * self.spacing * (index - (len(self.pivots) - 1) / 2)

    def fov_in(self, aspect: float) -> float:
        """Return the vertical field of view, in radians, that shows the row in a window of this width / height."""
        return 2 * math.atan(math.tan(self.fov / 2) * max(1.0, self.aspect / aspect))

    def beside(self, index: int, part: Gaussians) -> Gaussians:
        """Return the Gaussians that reach at most half-way to a neighbour, and all of them for a single sample."""
        if len(self.pivots) == 1:
            return part
        reach = (part.means - self.pivots[index].to(part.means)).norm(dim=-1) + 2 * part.scales.amax(-1)
        return part[reach <= self.spacing / 2]

    def looks_like(self, other: "Arrangement") -> bool:
        """Return whether a camera placed for `other` may stay: equal number of samples, nearly equal camera."""
        apart = np.linalg.norm(self.look_at - other.look_at) + np.linalg.norm(self.position - other.position)
        return len(self.pivots) == len(other.pivots) and float(apart) < SAME * other.distance


def arrangement_of(samples: Sequence[Sample]) -> Arrangement:
    """Return a row of samples, seen by the first one's reference camera, moved back until all are visible."""
    reference = samples[0].reference
    pivots = [sample.pivot() for sample in samples]
    pose = reference.camera_to_world.cpu().numpy()
    pivot = pivots[0].cpu().numpy()
    eye = pose[:3, 3]
    forward = pose[:3, 2]
    distance = float(np.linalg.norm(pivot - eye))
    height, width = reference.image_size
    tangent = height / 2 / reference.intrinsics[1, 1].item()
    aspect = width / 2 / reference.intrinsics[0, 0].item() / tangent
    spacing = GAP * 2 * distance * tangent * aspect
    if len(samples) > 1:
        aspect = NARROWEST_WINDOW
        distance = max(distance, len(samples) * spacing / 2 / (tangent * aspect))
    position = pivot - forward * distance
    return Arrangement(pivots, pose[:3, 0], spacing, position, pivot, 2 * math.atan(MARGIN * tangent), aspect)


class SplatView:
    """Splats and cameras on the page: one sample or all side by side, all layers or some, in colour or by depth.

    `arrangement` is the row that the cameras were last placed for, None before that and for another direction up.
    `refresh` draws everything anew from the attributes, under a lock because callbacks come from several threads.

    Side by side, only the middle part of each sample is shown, because scenes are wider than an image and would hide
    each other.
    """

    def __init__(self, server: viser.ViserServer, up: Sequence[float]) -> None:
        self.server = server
        self.samples: list[Sample] = []
        self.chosen: int | None = 0
        self.hidden_layers: set[int] = set()
        self.depth = False
        self.cameras: set[str] = set()
        self._splats: dict[str, viser.GaussianSplatHandle] = {}
        self._frusta: list[viser.CameraFrustumHandle] = []
        self._lock = threading.RLock()
        self.arrangement: Arrangement | None = None
        self.faded = False
        self.set_up(up)
        server.on_client_connect(self._welcome)

    @property
    def visible(self) -> list[Sample]:
        """The samples on the page: the chosen one (or the first, if its number does not exist), or all."""
        if self.chosen is None or not self.samples:
            return self.samples
        index = self.chosen if self.chosen < len(self.samples) else 0
        return [self.samples[index]]

    def set_up(self, up: Sequence[float]) -> None:
        """Set the direction up, and make the next drawing be seen from the front, because it shows another scene."""
        with self._lock:
            self.up = np.asarray(up, float)
            self.arrangement = None
            self.server.scene.set_up_direction(self.up)

    def show(self, samples: Sequence[Sample]) -> None:
        """Replace the samples, and draw the new ones."""
        with self._lock:
            self.faded = False
            self.samples = list(samples)
            self.refresh()

    def fade(self) -> None:
        """Draw the samples faintly until others are shown, because those of another photo are being drawn."""
        with self._lock:
            self.faded = True
            self.refresh()

    def refresh(self) -> None:
        """Draw the state of the attributes, and move the cameras of browsers only if the arrangement has changed."""
        with self._lock, self.server.atomic():
            samples = self.visible
            if not samples:
                return
            arrangement = arrangement_of(samples)
            self._draw_splats(samples, arrangement)
            self._draw_cameras(samples, arrangement)
            if self.arrangement is None or not arrangement.looks_like(self.arrangement):
                self.arrangement = arrangement
                self.look_from_the_front()

    def look_from_the_front(self, client: viser.ClientHandle | None = None) -> None:
        """Move a browser's camera (None: those of all present and future browsers) to where the photo was taken."""
        with self._lock:
            if self.arrangement is None:
                return
            view = self.arrangement
            start = self.server.initial_camera
            start.position = view.position
            start.look_at = view.look_at
            start.fov = view.fov
            browsers = list(self.server.get_clients().values()) if client is None else [client]
            for browser in browsers:
                camera = browser.camera
                with browser.atomic():
                    camera.up_direction = self.up
                    camera.position = view.position
                    camera.look_at = view.look_at
                    if camera.image_width * camera.image_height:  # else hidden: `_welcome` fits its view when it shows
                        camera.fov = view.fov_in(camera.image_width / camera.image_height)

    def look_from_aside(self, client: viser.ClientHandle, angle: float) -> None:
        """Move a browser's camera to the front's place, turned about the scene by an angle in radians."""
        with self._lock:
            if self.arrangement is None:
                return
            axis = self.up / np.linalg.norm(self.up)
            rotation = vtf.SO3.exp(axis * angle)
            offset = self.arrangement.position - self.arrangement.look_at
            with client.atomic():
                client.camera.up_direction = self.up
                client.camera.position = self.arrangement.look_at + rotation @ offset
                client.camera.look_at = self.arrangement.look_at

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Fit the view to a new browser's window, even a phone's, and show a notice until it has drawn a scene."""
        last_aspect: float | None = None

        def fit(camera: viser.CameraHandle) -> None:
            nonlocal last_aspect
            aspect = camera.image_width / max(camera.image_height, 1)
            view = self.arrangement
            if view is not None and aspect > 0 and aspect != last_aspect:
                last_aspect = aspect
                camera.fov = view.fov_in(aspect)

        client.camera.on_update(fit)
        fit(client.camera)
        if not self.samples:
            return
        with suppress(RuntimeError):  # it has left
            drawing = client.add_notification("Drawing the first image", "", loading=True, with_close_button=False)
            client.get_render(height=1, width=1)  # returns when the browser has drawn it
            drawing.remove()

    def _draw_splats(self, samples: Sequence[Sample], arrangement: Arrangement) -> None:
        # viser draws one colour for all directions.
        scenes = [sample.for_viewers().seen_from(sample.reference.centers) for sample in samples]
        if self.depth:
            scenes = depth_colored(scenes, [sample.reference for sample in samples])
        if self.faded:
            scenes = [replace(scene, opacities=scene.opacities * FADED) for scene in scenes]
        earlier = self._splats
        self._splats = {}
        names = {f"/sample_{i}/layer_{layer}" for i, sample in enumerate(samples) for layer in range(sample.layers)}
        for name in earlier.keys() - names:
            earlier[name].remove()
        for i, (sample, scene) in enumerate(zip(samples, scenes, strict=True)):
            size = scene.count // sample.layers  # Gaussians are ordered by layer, row, column
            for layer in range(sample.layers):
                name = f"/sample_{i}/layer_{layer}"
                arrays, scale = to_splats(arrangement.beside(i, scene[layer * size : (layer + 1) * size]))
                handle = earlier.get(name)
                if handle is None:
                    handle = self.server.scene.add_gaussian_splats(name, **arrays)
                else:
                    handle.set_gaussians(**arrays)
                handle.scale = scale
                handle.position = arrangement.shift(i)
                handle.visible = layer not in self.hidden_layers
                self._splats[name] = handle

    def _draw_cameras(self, samples: Sequence[Sample], arrangement: Arrangement) -> None:
        for frustum in self._frusta:
            frustum.remove()
        self._frusta = []
        for i, sample in enumerate(samples):
            reference = sample.reference
            if "reference" in self.cameras:
                self._add_frusta(f"/cameras/{i}/reference", reference[None], REFERENCE_COLOR, i, arrangement)
            if "orbit" in self.cameras:
                up = reference.intrinsics.new_tensor(self.up.tolist())
                around = orbit(reference, arrangement.pivots[i], up, 12)
                self._add_frusta(f"/cameras/{i}/orbit", around, ORBIT_COLOR, i, arrangement)

    def _add_frusta(
        self, name: str, cameras: Cameras, color: tuple[int, int, int], sample: int, arrangement: Arrangement
    ) -> None:
        """Draw the frusta of a sample's cameras at the sample's place."""
        height, width = cameras.image_size
        for j, (pose, intrinsics) in enumerate(zip(cameras.camera_to_world, cameras.intrinsics, strict=True)):
            frustum = self.server.scene.add_camera_frustum(
                f"{name}/{j}",
                fov=2 * math.atan(height / 2 / intrinsics[1, 1].item()),
                aspect=width / height,
                scale=0.08 * arrangement.distance,
                thickness=1.5,
                thickness_units="screen",
                color=color,
            )
            frustum.wxyz = matrix_to_quaternion(pose[:3, :3]).cpu().numpy()
            frustum.position = pose[:3, 3].cpu().numpy() + arrangement.shift(sample)
            self._frusta.append(frustum)


def to_splats(gaussians: Gaussians) -> tuple[dict[str, Any], float]:
    """Return arguments of `add_gaussian_splats` for the finite Gaussians of an unbatched set, and their unit's length.

    viser stores covariances as float16, which ends at 65504 and has few digits below 6e-5. In this unit, the largest
    covariance is just below that end, and thin Gaussians keep their shape.
    """
    finite = gaussians[gaussians.finite()].detach().to("cpu")
    largest = finite.scales.max().item() if finite.count else 1.0
    scale = max(largest, 1e-12) / math.sqrt(LARGEST_COVARIANCE)
    unit = replace(finite, means=finite.means / scale, scales=finite.scales / scale)
    colors = round_to_uint8(finite.colors * 255)
    opacities = round_to_uint8(finite.opacities[:, None] * 255)
    arrays = {
        "centers": unit.means.float().numpy(),
        "covariances": unit.covariances().float().numpy(),
        "rgbs": colors,
        "opacities": opacities,
    }
    return arrays, scale


def depth_colored(scenes: Sequence[Gaussians], cameras: Sequence[Cameras]) -> list[Gaussians]:
    """Colour scenes by depth in their cameras, near bright and far dark, on one scale for all of them."""
    pairs = zip(scenes, cameras, strict=True)
    depths = torch.cat([transform_points(camera.world_to_camera, scene.means)[:, 2] for scene, camera in pairs])
    colors, _ = color_depth(depths[None, None, :])
    parts = torch.split(colors[:, 0].T, [scene.count for scene in scenes])
    return [replace(scene, colors=part) for scene, part in zip(scenes, parts, strict=True)]
