"""Random augmentation of training scenes: colours and background of all views, the reference's camera, flips, boxes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float32
from numpy import ndarray
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import mirror, pixel_centers
from completesplat.quantities import Entries, Positive, Range, Share
from completesplat.rasterizers.kernels.compilation import helper, kernel
from completesplat.scene import SceneBatch, Views
from completesplat.settings.schema import check_value, hints_of

T = TypeVar("T")
Images = Float[Tensor, "view 3 height width"]
Plane = Float32[ndarray, " pixel"]
BRIGHTNESS, CONTRAST, SATURATION, HUE = range(4)
GREY_WEIGHTS = torch.tensor([0.299, 0.587, 0.114], dtype=torch.float32)[:, None, None]  # ITU-R BT.601
ZERO = np.float32(0)
ONE = np.float32(1)
TWO = np.float32(2)
FOUR = np.float32(4)
SIX = np.float32(6)


def _check(name: str, settings: object) -> None:
    for key, annotation in hints_of(type(settings)).items():
        check_value(f"{name}.{key}", annotation, getattr(settings, key))


@dataclass(frozen=True)
class ColorJitter:
    """Random colour changes in random order, the same for all views of a scene (strengths as in torchvision).

    Equal colours stay equal in all views, because contrast scales the distance from the mean grey level over all views,
    not over each image. A strength of 0 leaves its change out.

    Args:
        brightness, contrast, saturation: the factor is drawn from [max(0, 1 - strength), 1 + strength]. It multiplies
            the colours, their distance from the mean grey level, or their distance from the pixel's own grey.
        hue: the angle is drawn from [-strength, strength] turns. The strength is at most 0.5.

    Raises:
        CompleteSplatError: a strength is negative or not finite, or the hue is above 0.5.
    """

    brightness: Annotated[float, Range(0)] = 0.0
    contrast: Annotated[float, Range(0)] = 0.0
    saturation: Annotated[float, Range(0)] = 0.0
    hue: Annotated[float, Range(0, 0.5)] = 0.0

    def __post_init__(self) -> None:
        _check("data.color_jitter", self)

    def __call__(self, images: Images, rng: np.random.Generator) -> Images:
        """Change images (sRGB, clamped to 0 to 1) at random. Any strengths use equally many random numbers."""
        strengths = (self.brightness, self.contrast, self.saturation, self.hue)
        factors = [rng.uniform(max(0.0, 1 - strength), 1 + strength) for strength in strengths[:HUE]]
        factors.append(6 * rng.uniform(-self.hue, self.hue) % 6)
        for change in rng.permutation(len(strengths)):
            if strengths[change] > 0:
                images = jittered(images, int(change), factors[change])
        return images


def jittered(images: Images, change: int, factor: float) -> Images:
    """Return images (sRGB, 0 to 1) after one change, clamped to 0 to 1.

    Args:
        change: `BRIGHTNESS` multiplies the colours by the factor, `CONTRAST` their distance from the mean grey level of
            all images, `SATURATION` that from the pixel's own grey. `HUE` turns the hue by sixths of a turn.
    """
    if change == BRIGHTNESS:
        return (images * factor).clamp_(0, 1)
    if change == HUE:
        pixels = images.flatten(2).numpy().copy()
        turn_hue(pixels, np.float32(factor))
        return torch.from_numpy(pixels).view_as(images)
    grey = (images * GREY_WEIGHTS).sum(1, keepdim=True)
    return torch.lerp(grey.mean() if change == CONTRAST else grey, images, factor).clamp_(0, 1)


@kernel
def turn_hue(images: Float32[ndarray, "view 3 pixel"], turn: np.float32) -> None:
    """Turn the hue of all pixels in place. It is compiled because it takes most of a colour jitter's time in kornia."""
    for view in range(len(images)):
        _turn(images[view, 0], images[view, 1], images[view, 2], turn)


@helper
def _turn(reds: Plane, greens: Plane, blues: Plane, turn: np.float32) -> None:
    for i in range(len(reds)):
        red = reds[i]
        green = greens[i]
        blue = blues[i]
        high = max(red, max(green, blue))
        low = min(red, min(green, blue))
        chroma = high - low
        share = ONE / chroma if chroma > ZERO else ZERO
        hue = (red - green) * share + FOUR
        hue = (blue - red) * share + TWO if high == green else hue
        hue = (green - blue) * share + SIX if high == red else hue
        reds[i] = high - chroma * _below_highest(hue + turn + FOUR + ONE)
        greens[i] = high - chroma * _below_highest(hue + turn + TWO + ONE)
        blues[i] = high - chroma * _below_highest(hue + turn + ONE)


@helper
def _below_highest(hue: np.float32) -> np.float32:
    """Return how far a channel lies below the highest, as a share of the chroma, for its hue in sixths of a turn."""
    hue -= SIX * np.floor(hue / SIX)
    return min(max(min(hue, FOUR - hue), ZERO), ONE)


@dataclass(frozen=True)
class BoxMasks:
    """Boxes that hide parts of the reference image from the conditioning (paper, masked diffusion).

    The paper gives the probability that an image gets boxes. The smallest and largest number of boxes, and the range of
    their sides (as fractions of the image's; height and width are drawn separately), are our choices.

    Raises:
        CompleteSplatError: the probability or the sides lie outside of 0 to 1, or a range is empty.
    """

    probability: Share = 0.5
    boxes: Annotated[Sequence[Positive], Entries(2, 2)] = (1, 4)
    sides: Annotated[Sequence[Share], Entries(2, 2)] = (0.1, 0.5)

    def __post_init__(self) -> None:
        _check("data.box_masks", self)
        for name, (least, most) in {"boxes": self.boxes, "sides": self.sides}.items():
            if least > most:
                raise CompleteSplatError(f"data.box_masks.{name}=[{least}, {most}]: the first number is the smallest")

    def __call__(self, height: int, width: int, rng: np.random.Generator) -> Float[Tensor, "1 {height} {width}"]:
        """Return 1 where the image is visible and 0 in the boxes, which lie inside the image on whole pixels."""
        visible = torch.ones(1, height, width)
        if rng.random() >= self.probability:
            return visible
        for _ in range(rng.integers(self.boxes[0], self.boxes[1], endpoint=True)):
            top, bottom = self._interval(height, rng)
            left, right = self._interval(width, rng)
            visible[:, top:bottom, left:right] = 0
        return visible

    def _interval(self, size: int, rng: np.random.Generator) -> tuple[int, int]:
        length = max(1, round(rng.uniform(self.sides[0], self.sides[1]) * size))
        start = int(rng.integers(size - length, endpoint=True))
        return start, start + length


@dataclass(frozen=True)
class CameraJitter:
    """Random roll, focal length and principal point of the reference camera, for photos that are not level.

    The image that such a camera would see is resampled from the reference image. Outside of it, the border
    is repeated. The target images do not change.

    Args:
        roll: the angle about the optical axis is drawn from [-roll, roll] degrees.
        zoom: the factor of the focal length is drawn from this range, uniformly in its logarithm.
        shift: the principal point moves by at most this share of the image's side, along each axis.

    Raises:
        CompleteSplatError: a value is out of its range, or the zoom's range is empty.
    """

    roll: Annotated[float, Range(0, 180)] = 15.0
    zoom: Annotated[Sequence[Annotated[float, Range(0.1, 10)]], Entries(2, 2)] = (0.85, 1.05)
    shift: Annotated[float, Range(0, 0.5)] = 0.05

    def __post_init__(self) -> None:
        _check("data.camera_jitter", self)
        if self.zoom[0] > self.zoom[1]:
            raise CompleteSplatError(f"data.camera_jitter.zoom={list(self.zoom)}: give the smaller number first")

    def __call__(self, scene: SceneBatch, rng: np.random.Generator) -> SceneBatch:
        """Return the scene with the jittered reference view, whose camera's frame becomes the world frame."""
        angle = np.deg2rad(rng.uniform(-self.roll, self.roll))
        zoom = np.exp(rng.uniform(*np.log(self.zoom)))
        height, width = scene.reference.cameras.image_size
        shift = rng.uniform(-self.shift, self.shift, 2) * (width, height)
        turn = torch.eye(4)
        turn[:2, :2] = torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        before = scene.reference.cameras.intrinsics
        after = before * torch.tensor([[zoom, zoom, 1], [zoom, zoom, 1], [1, 1, 1]], dtype=torch.float32)
        after[:2, 2] += torch.from_numpy(shift).float()
        to_old = before @ turn[:3, :3].mT @ torch.linalg.inv(after)
        pixels = pixel_centers(height, width, before.device)
        old = (torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1) @ to_old.mT)[..., :2]
        grid = old / torch.tensor([width, height]) * 2 - 1
        layers = torch.cat([scene.reference.images, scene.reference.masks, scene.visible])[None]
        resampled = torch.nn.functional.grid_sample(layers, grid[None], padding_mode="border", align_corners=False)[0]
        cameras = replace(scene.reference.cameras, intrinsics=after)
        binary = scene.reference.masks.eq(scene.reference.masks.round()).all()
        masks = resampled[3:4].round() if binary else resampled[3:4]
        reference = Views(resampled[:3], cameras, masks)
        turned = scene.targets.cameras.world_to_camera @ turn.mT
        targets = replace(scene.targets, cameras=replace(scene.targets.cameras, world_to_camera=turned))
        return replace(scene, reference=reference, targets=targets, visible=resampled[4:])


def _built(kind: Callable[..., T], settings: Mapping[str, Any] | None) -> T | None:
    """Build a part of an augmentation from its settings, or nothing without any."""
    if settings is None:
        return None
    try:
        return kind(**settings)
    except TypeError as error:  # a name is misspelt
        raise CompleteSplatError(f"data: {dict(settings)}: {error}") from None


@dataclass(frozen=True)
class Augmentation:
    """Random changes of a training scene: jitter of colours and camera, mirroring with probability 0.5, and boxes.

    With probability `random_background`, one random colour takes the background's place in all views. Each change is
    off if it is None, false or 0. The order of the fields is not that of the changes.
    """

    color_jitter: ColorJitter | None = None
    box_masks: BoxMasks | None = None
    horizontal_flip: bool = False
    camera_jitter: CameraJitter | None = None
    random_background: float = 0.0

    @staticmethod
    def of_settings(
        color_jitter: Mapping[str, float] | None,
        box_masks: Mapping[str, Any] | None,
        camera_jitter: Mapping[str, Any] | None,
        horizontal_flip: bool,
        random_background: float,
    ) -> "Augmentation":
        """Build the parts of an augmentation from their settings. None: the part is off.

        Raises:
            CompleteSplatError: a setting is unknown or out of its range.
        """
        return Augmentation(
            color_jitter=_built(ColorJitter, color_jitter),
            box_masks=_built(BoxMasks, box_masks),
            horizontal_flip=horizontal_flip,
            camera_jitter=_built(CameraJitter, camera_jitter),
            random_background=random_background,
        )

    def active(self) -> list[str]:
        """Return the names of the changes that are on."""
        return [field.name for field in fields(self) if getattr(self, field.name)]

    def changes_images(self) -> bool:
        """Return whether a change other than boxes over the reference is on."""
        return any(name != "box_masks" for name in self.active())

    def __call__(self, scene: SceneBatch, rng: np.random.Generator) -> SceneBatch:
        """Augment one scene (without batch axis).

        Colours, flip, boxes, camera and background draw from five generators, spawned from `rng` in this order. So each
        is independent of whether the others are on, and of what was drawn from `rng` before. Nothing is drawn from it.
        """
        jitter_rng, flip_rng, boxes_rng, camera_rng, background_rng = rng.spawn(5)
        if background_rng.random() < self.random_background:
            scene = on_color(scene, torch.from_numpy(background_rng.uniform(size=3)).float())
        if self.color_jitter is not None:
            images = self.color_jitter(scene.all_views().images, jitter_rng)
            reference = replace(scene.reference, images=images[0])
            targets = replace(scene.targets, images=images[1:])
            scene = replace(scene, reference=reference, targets=targets)
        if self.horizontal_flip and flip_rng.random() < 0.5:
            scene = mirrored(scene)
        if self.camera_jitter is not None:
            scene = self.camera_jitter(scene, camera_rng)
        if self.box_masks is not None:
            height, width = scene.reference.cameras.image_size
            scene = replace(scene, visible=self.box_masks(height, width, boxes_rng).to(scene.visible))
        return scene


def on_color(scene: SceneBatch, color: Float[Tensor, "3"]) -> SceneBatch:
    """Replace the background of all views (what their masks leave out) by one colour; without masks nothing changes."""

    def composited(views: Views) -> Views:
        return replace(views, images=torch.lerp(color[:, None, None], views.images, views.masks))

    return replace(scene, reference=composited(scene.reference), targets=composited(scene.targets))


def mirrored(scene: SceneBatch) -> SceneBatch:
    """Mirror images, masks, depths and cameras left to right. The reference camera's frame remains the world frame."""

    def flipped(views: Views) -> Views:
        depths = None if views.depths is None else views.depths.flip(-1)
        return Views(views.images.flip(-1), mirror(views.cameras), views.masks.flip(-1), depths)

    reference = flipped(scene.reference)
    targets = flipped(scene.targets)
    return replace(scene, reference=reference, targets=targets, visible=scene.visible.flip(-1))
