"""Colour changes of several images at once, defined as in torchvision and kornia. They cost most of a loader's time."""

import numpy as np
from jaxtyping import Float32, Integer
from numpy import ndarray

from completesplat.rasterizers.kernels.compilation import helper, kernel

Images = Float32[ndarray, "view 3 height width"]
Plane = Float32[ndarray, " pixel"]
BRIGHTNESS, CONTRAST, SATURATION, HUE = range(4)
RED, GREEN, BLUE = (np.float32(weight) for weight in (0.299, 0.587, 0.114))  # of the grey level (ITU-R BT.601)
ZERO, ONE, TWO, FOUR, SIX = (np.float32(number) for number in (0, 1, 2, 4, 6))


@kernel
def change_colors(images: Images, changes: Integer[ndarray, " change"], factors: Float32[ndarray, "4"]) -> None:
    """Change images (sRGB, 0 to 1) in place, one change after the other; each clamps the colours to 0 to 1.

    Args:
        changes: the changes in their order, such as `HUE`.
        factors: factors of the brightness, of the distance from the mean grey level of all images, and of the distance
            from a pixel's own grey level; and the angle by which the hue is turned, in sixths of a turn, 0 to 6.
    """
    pixels = images.reshape(images.shape[0], 3, images.shape[2] * images.shape[3])
    for change in changes:
        factor = factors[change]
        mean = _mean_grey(pixels) if change == CONTRAST else ZERO
        for view in range(len(pixels)):
            reds, greens, blues = pixels[view, 0], pixels[view, 1], pixels[view, 2]
            if change == HUE:
                _turn_hue(reds, greens, blues, factor)
            elif change == SATURATION:
                _scale_from_grey(reds, greens, blues, factor)
            else:
                for channel in (reds, greens, blues):
                    for i in range(len(channel)):
                        channel[i] = _clamp(channel[i] * factor + mean * (ONE - factor))


@helper
def _clamp(value: np.float32) -> np.float32:
    return min(max(value, ZERO), ONE)


@helper
def _mean_grey(pixels: Float32[ndarray, "view 3 pixel"]) -> np.float32:
    total = 0.0
    for view in range(len(pixels)):
        reds, greens, blues = pixels[view, 0], pixels[view, 1], pixels[view, 2]
        for i in range(len(reds)):
            total += RED * reds[i] + GREEN * greens[i] + BLUE * blues[i]
    return np.float32(total / (len(pixels) * pixels.shape[2]))


@helper
def _scale_from_grey(reds: Plane, greens: Plane, blues: Plane, factor: np.float32) -> None:
    for i in range(len(reds)):
        grey = (RED * reds[i] + GREEN * greens[i] + BLUE * blues[i]) * (ONE - factor)
        reds[i] = _clamp(reds[i] * factor + grey)
        greens[i] = _clamp(greens[i] * factor + grey)
        blues[i] = _clamp(blues[i] * factor + grey)


@helper
def _turn_hue(reds: Plane, greens: Plane, blues: Plane, turn: np.float32) -> None:
    for i in range(len(reds)):
        red, green, blue = reds[i], greens[i], blues[i]
        high, low = max(red, max(green, blue)), min(red, min(green, blue))
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
    return _clamp(min(hue, FOUR - hue))
