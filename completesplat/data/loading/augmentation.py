"""Random changes to training scenes: one colour jitter for all views, flips, boxes over the reference picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from kornia import enhance
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import mirror
from completesplat.scene import SceneBatch, Views

FLIP_PROBABILITY = 0.5


@dataclass(frozen=True)
class ColorJitter:
    """Changes of colour, in random order and alike for all views of a scene (strengths as in torchvision).

    A colour becomes the same new colour in whichever view it is seen: the grey level that contrast is counted from is
    the mean over all views, not that of each picture. A strength of 0 leaves its change out.

    Args:
        brightness, contrast, saturation: the factor is drawn from [max(0, 1 - strength), 1 + strength]. It multiplies
            the colours, their distance from the mean grey level, and their distance from the pixel's own grey.
        hue: the angle is drawn from [-strength, strength] turns, of 0.5 at most.

    Raises:
        CompleteSplatError: a strength that is negative or not finite, or a hue above 0.5.
    """

    brightness: float
    contrast: float
    saturation: float
    hue: float

    def __post_init__(self) -> None:
        for name, strength in vars(self).items():
            if not 0 <= strength < math.inf:
                raise CompleteSplatError(f"color_jitter.{name} must be 0 or more, not {strength}")
        if self.hue > 0.5:
            raise CompleteSplatError(f"color_jitter.hue must be at most 0.5, half a turn, not {self.hue}")

    def __call__(
        self, images: Float[Tensor, "view 3 height width"], rng: np.random.Generator
    ) -> Float[Tensor, "view 3 height width"]:
        """Pictures (sRGB, 0 to 1) with one draw of all changes; pixels that leave 0 to 1 are clamped.

        The number of draws is the same for all strengths.
        """
        strengths = (self.brightness, self.contrast, self.saturation)
        factors = [rng.uniform(max(0.0, 1 - strength), 1 + strength) for strength in strengths]
        angle = 2 * math.pi * rng.uniform(-self.hue, self.hue)
        changes = [
            (enhance.adjust_brightness_accumulative, self.brightness, factors[0]),
            (enhance.adjust_contrast_with_mean_subtraction, self.contrast, factors[1]),
            (enhance.adjust_saturation_with_gray_subtraction, self.saturation, factors[2]),
            (enhance.adjust_hue, self.hue, angle),
        ]
        # All views on top of each other as one picture: this is what makes the mean that of the scene.
        column = images.transpose(0, 1).flatten(1, 2)
        for index in rng.permutation(len(changes)):
            change, strength, factor = changes[index]
            if strength > 0:
                column = change(column, factor).clamp(0, 1)
        return column.unflatten(1, (images.shape[0], images.shape[2])).transpose(0, 1).contiguous()


@dataclass(frozen=True)
class BoxMasks:
    """Boxes that hide parts of the reference picture from the conditioning (paper, masked diffusion).

    The paper gives the probability; number and sizes of the boxes are choices of this implementation.

    Args:
        probability: of hiding anything.
        boxes: fewest and most boxes.
        sides: shortest and longest side of a box, as a share of the picture's; height and width are drawn apart.

    Raises:
        CompleteSplatError: probability or sides outside of 0 to 1, or a range that is empty.
    """

    probability: float = 0.5
    boxes: Sequence[int] = (1, 4)
    sides: Sequence[float] = (0.1, 0.5)

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= 1:
            raise CompleteSplatError(f"box_masks.probability must be from 0 to 1, not {self.probability}")
        if len(self.boxes) != 2 or not 1 <= self.boxes[0] <= self.boxes[1]:
            raise CompleteSplatError(f"box_masks.boxes must be the fewest and the most, 1 or more, not {self.boxes}")
        if len(self.sides) != 2 or not 0 < self.sides[0] <= self.sides[1] <= 1:
            raise CompleteSplatError(f"box_masks.sides must be a range within 0 to 1, not {self.sides}")

    def __call__(self, height: int, width: int, rng: np.random.Generator) -> Float[Tensor, "1 {height} {width}"]:
        """1 where the picture may be seen, 0 within the boxes; each lies inside the picture, on whole pixels."""
        visible = torch.ones(1, height, width)
        if rng.random() >= self.probability:
            return visible
        for _ in range(rng.integers(self.boxes[0], self.boxes[1], endpoint=True)):
            (top, bottom), (left, right) = (self._interval(size, rng) for size in (height, width))
            visible[:, top:bottom, left:right] = 0
        return visible

    def _interval(self, size: int, rng: np.random.Generator) -> tuple[int, int]:
        length = max(1, round(rng.uniform(self.sides[0], self.sides[1]) * size))
        start = int(rng.integers(size - length, endpoint=True))
        return start, start + length


def augment(
    scene: SceneBatch,
    rng: np.random.Generator,
    color_jitter: ColorJitter | None,
    box_masks: BoxMasks | None,
    horizontal_flip: bool,
) -> SceneBatch:
    """One scene (without batch axis), changed at random.

    Jitter, flip and boxes draw from three generators spawned from `rng` in this order, so that none of them
    depends on whether the others are switched on, nor on what was drawn from `rng` before. `rng` itself draws nothing.

    Args:
        color_jitter: for the reference and all targets alike; None for none.
        box_masks: sets `visible`; None leaves it as it is.
        horizontal_flip: mirror the scene with probability 0.5.
    """
    jitter_rng, flip_rng, boxes_rng = rng.spawn(3)
    if color_jitter is not None:
        scene = _jittered(scene, color_jitter, jitter_rng)
    if horizontal_flip and flip_rng.random() < FLIP_PROBABILITY:
        scene = mirrored(scene)
    if box_masks is not None:
        height, width = scene.reference.cameras.image_size
        scene = replace(scene, visible=box_masks(height, width, boxes_rng).to(scene.visible))
    return scene


def mirrored(scene: SceneBatch) -> SceneBatch:
    """The scene in a mirror: pictures, masks and cameras swap left and right, the reference's frame stays the world."""
    return replace(
        scene,
        reference=_mirrored_views(scene.reference),
        targets=_mirrored_views(scene.targets),
        visible=scene.visible.flip(-1),
    )


def _mirrored_views(views: Views) -> Views:
    depths = None if views.depths is None else views.depths.flip(-1)
    return Views(views.images.flip(-1), mirror(views.cameras), views.masks.flip(-1), depths)


def _jittered(scene: SceneBatch, color_jitter: ColorJitter, rng: np.random.Generator) -> SceneBatch:
    images = color_jitter(scene.all_views().images, rng)
    reference, targets = replace(scene.reference, images=images[0]), replace(scene.targets, images=images[1:])
    return replace(scene, reference=reference, targets=targets)
