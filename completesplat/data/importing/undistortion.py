"""Pictures of a lens with distortion, as a pinhole with the same focal lengths would have taken them."""

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from kornia.geometry.calibration import distort_points
from PIL import Image
from torch import Tensor

from completesplat.data.checks import BadCamera
from completesplat.data.importing.capture import Lens
from completesplat.geometry.cameras import pixel_centers

ROWS_AT_ONCE = 64
# A lens whose picture keeps less than this share of its area is not what its coefficients say.
SMALLEST_SHARE = 0.5

Box = tuple[int, int, int, int]


class Undistortion:
    """Resamples the pictures of one lens.

    Focal lengths stay as they are. Pixels that the source does not show, and those where the model folds the picture
    over, are cut off at the borders, so that every pixel that is left is one that was seen. The principal point is the
    same on the scene, and moves in pixels by what is cut off on the left and at the top.

    Attributes:
        pinhole: the lens of the results.

    Raises:
        BadCamera: less than half of the picture is left, or nothing around the principal point.
    """

    def __init__(self, lens: Lens) -> None:
        positions = _source_positions(lens)
        left, top, right, bottom = _largest_box(_seen(positions, lens.image_size))
        height, width = lens.image_size
        center = lens.center[0] - left, lens.center[1] - top
        size = bottom - top, right - left
        inside = 0 < center[0] < size[1] and 0 < center[1] < size[0]
        if not inside or size[0] * size[1] < SMALLEST_SHARE * height * width:
            raise BadCamera(
                f"distortion {lens.distortion} leaves {size[1]} x {size[0]} of {width} x {height} pixels usable"
            )
        self.pinhole = replace(lens, center=center, image_size=size, distortion=(0.0,) * 5)
        # Where `grid_sample` finds the picture's borders: at -1 and 1.
        scale = torch.tensor([2 / width, 2 / height], dtype=positions.dtype)
        self._grid = positions[top:bottom, left:right] * scale - 1

    def __call__(self, picture: Image.Image) -> Image.Image:
        """The undistorted picture, RGB (bicubic) or grey (a mask; bilinear)."""
        pixels = np.array(picture)
        source = torch.from_numpy(pixels.reshape(*pixels.shape[:2], -1)).permute(2, 0, 1)[None].float()
        mode = "bicubic" if picture.mode == "RGB" else "bilinear"
        result = F.grid_sample(source, self._grid[None], mode=mode, padding_mode="border", align_corners=False)[0]
        array = result.round_().clamp_(0, 255).to(torch.uint8).permute(1, 2, 0).numpy()
        return Image.fromarray(array if picture.mode == "RGB" else array[..., 0])


def _source_positions(lens: Lens) -> Float[Tensor, "height width 2"]:
    """Where the distorted picture shows what the pinhole sees in each of its pixel centres."""
    matrix = torch.from_numpy(lens.matrix)
    distortion = torch.tensor(lens.distortion, dtype=torch.float64)
    rows = pixel_centers(*lens.image_size, dtype=torch.float64).split(ROWS_AT_ONCE)
    return torch.cat([distort_points(part.flatten(0, 1), matrix, distortion).view_as(part).float() for part in rows])


def _seen(positions: Float[Tensor, "height width 2"], image_size: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Which positions lie on the picture, where neighbours also are neighbours in it, on the same sides."""
    size = torch.tensor(image_size[::-1], dtype=positions.dtype)
    seen = ((positions >= 0) & (positions <= size)).all(dim=-1)
    right, down = positions[:-1].diff(dim=1), positions[:, :-1].diff(dim=0)
    upright = right[..., 0] * down[..., 1] > right[..., 1] * down[..., 0]
    for rows in (slice(None, -1), slice(1, None)):
        for columns in (slice(None, -1), slice(1, None)):
            seen[rows, columns] &= upright
    return seen.numpy()


def _largest_box(seen: Bool[np.ndarray, "height width"]) -> Box:
    """A large (left, top, right, bottom) of seen pixels only: sides are cut, worst first, until there are no others."""
    height, width = seen.shape
    sums = np.zeros((height + 1, width + 1), dtype=np.int64)
    sums[1:, 1:] = (~seen).cumsum(axis=0).cumsum(axis=1)

    def unseen(box: Box) -> int:
        left, top, right, bottom = box
        return int(sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left])

    def share(box: Box) -> float:
        left, top, right, bottom = box
        return unseen(box) / ((right - left) * (bottom - top))

    left, top, right, bottom = 0, 0, width, height
    while unseen((left, top, right, bottom)) and right - left > 1 and bottom - top > 1:
        strips = [
            (left, top, left + 1, bottom),
            (left, top, right, top + 1),
            (right - 1, top, right, bottom),
            (left, bottom - 1, right, bottom),
        ]
        worst = max(range(4), key=lambda side: share(strips[side]))
        left, top = left + (worst == 0), top + (worst == 1)
        right, bottom = right - (worst == 2), bottom - (worst == 3)
    return left, top, right, bottom
