"""Findings about photos of a turntable: whether the turn closes, where it goes, and how well the masks fit together."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras, crop_resize, project
from completesplat.photo.saving import label_font, save_image, to_uint8
from completesplat.wording import printable

Photos = Float[Tensor, "photo 3 size size"]
Masks = Float[Tensor, "photo 1 size size"]

WIDEST = 55  # degrees to each side of the middle in which the surface is compared
LEAST_STEP = 8.0  # degrees between photos that are compared
CERTAIN = 3.0  # standard errors from which on the flow has a direction
HULL = 48  # voxels along each side of the hull, and pixels of the masks that carve it
MOST_VIEWS = 24  # that carve it
TILES = 8
TILE = 48
LABEL = 12  # photos of a turn on the sheet; pixels


class Turn(NamedTuple):
    """Cameras of one turn and findings about its photos.

    Attributes:
        cameras: [photo], for a surface that moves left; if it moves right, `mirror` gives them.
        differences: mean absolute differences (0 to 255) of photos with the same mean brightness: the last and the
            first, neighbours, and half a turn apart.
        flow: 1 if the surface moves left, -1 if it moves right, 0 if that cannot be told.
        overlap: of the masks with their visual hull; see `hull_overlap`.
        tiles: some of the photos, grey outside of their masks.
    """

    cameras: Cameras
    differences: tuple[float, float, float]
    flow: int
    overlap: float
    tiles: Photos


def examine(photos: Photos, masks: Masks, angles: Float[np.ndarray, " photo"], cameras: Cameras) -> Turn:
    """Return the findings about one turn of square photos with the axis in the middle.

    Raises:
        DataError: the last photo is less like the first one than any two neighbours are, and nearer to photos half a
            turn apart. This is not checked if the photos leave a gap of two steps.
    """
    brightness = (photos * masks).mean((1, 2, 3)) / masks.mean((1, 2, 3))
    even = photos * (brightness.mean() / brightness).view(-1, 1, 1, 1) * masks + 1 - masks
    neighbours, opposite = (255 * (even - even.roll(-n, 0)).abs().mean((1, 2, 3)) for n in (1, len(even) // 2))
    ends = float(neighbours[-1])
    mean = float(neighbours[:-1].mean())
    half = float(opposite.mean())
    whole = 2 * math.pi - angles[-1] + angles[0] < 2 * np.median(np.diff(angles))
    if whole and ends > max(float(neighbours[:-1].max()), (mean + half) / 2):
        message = f"last and first photo differ by {ends:.1f} of 255, neighbours by {mean:.1f}, opposite ones by"
        raise DataError(f"the turn does not close: {message} {half:.1f}")
    tiles = (photos * masks + 0.7 * (1 - masks))[torch.arange(TILES) * len(photos) // TILES]
    tiles = interpolate(tiles, size=(TILE, TILE), mode="area")
    flow = direction_of_flow(even, masks, angles)
    overlap = hull_overlap(masks, cameras)
    return Turn(cameras, (ends, mean, half), flow, overlap, tiles)


def direction_of_flow(photos: Photos, masks: Masks, angles: Float[np.ndarray, " photo"]) -> int:
    """Return 1 if the surface in the middle moves left from photo to photo, -1 if right, 0 if that cannot be told.

    The surface is unrolled like a cylinder's, so that a turn shifts it by a known number of degrees. Light that stands
    still, the mean of all photos, is subtracted. Each photo is compared with a later one, shifted in both directions.
    """
    radius = (masks.mean((0, 1))[masks.shape[-1] // 2] > 0.5).float().mean()
    x = radius * torch.arange(-WIDEST, WIDEST + 1).deg2rad().sin()
    y, x = torch.meshgrid(torch.linspace(-0.4, 0.4, 40), x, indexing="ij")
    unrolled = grid_sample(photos, torch.stack([x, y], dim=-1).expand(len(photos), -1, -1, -1), align_corners=False)
    unrolled = unrolled - unrolled.mean(0)
    degrees = np.degrees(angles)
    stride = math.ceil(LEAST_STEP / float(np.median(np.diff(degrees))))
    scores = []
    for index, first in enumerate(unrolled):
        later = (index + stride) % len(unrolled)
        second = unrolled[later]
        step = round((degrees[later] - degrees[index]) % 360)
        if 0 < step <= WIDEST:
            left = (first[..., step:] - second[..., :-step]).square().mean()
            right = (first[..., :-step] - second[..., step:]).square().mean()
            scores.append(float((right - left) / (right + left + 1e-9)))
    certain = scores and abs(np.mean(scores)) * math.sqrt(len(scores)) > CERTAIN * np.std(scores)
    return int(np.sign(np.mean(scores))) if certain else 0


def hull_overlap(masks: Masks, cameras: Cameras) -> float:
    """Return the mean overlap (intersection over union) of the masks with the silhouettes of their visual hull.

    The hull is carved from a cube of voxels around the origin. The cube is as wide as the field of view there.
    """
    views = torch.arange(min(len(masks), MOST_VIEWS)) * len(masks) // min(len(masks), MOST_VIEWS)
    small = interpolate(masks[views], size=(HULL, HULL), mode="area")
    cameras = crop_resize(cameras[views].to(torch.float32), 0, 0, masks.shape[-1], HULL)
    half = float(cameras.centers[0].norm() / cameras.intrinsics[0, 0, 0]) * HULL / 2
    places = half * ((torch.arange(HULL) + 0.5) / HULL * 2 - 1)
    pixels, _ = project(cameras, torch.cartesian_prod(places, places, places))
    inside = grid_sample(small, (pixels * 2 / HULL - 1)[:, None], align_corners=False)[:, 0, 0]
    column, row = pixels.long().clamp(0, HULL - 1).unbind(-1)
    hull = inside.amin(0).expand_as(inside)
    silhouettes = inside.new_zeros(len(views), HULL**2).scatter_reduce(1, row * HULL + column, hull, "amax") > 0.5
    filled = small.flatten(1) > 0.5
    return float(((silhouettes & filled).sum(1) / (silhouettes | filled).sum(1)).mean())


def write_sheet(turns: Mapping[str, Turn], path: Path) -> None:
    """Write some photos of each turn, evenly spread over it, with the turn's name and overlap, in columns."""
    height = TILE + LABEL
    width = TILES * TILE + LABEL
    columns = math.ceil(math.sqrt(len(turns) * height / width))
    rows = math.ceil(len(turns) / columns)
    sheet = Image.new("RGB", (columns * width, rows * height), "white")
    draw = ImageDraw.Draw(sheet)
    font = label_font(LABEL - 3)
    for index, (name, turn) in enumerate(turns.items()):
        left = index // rows * width
        top = index % rows * height
        draw.text((left, top), printable(f"{name}  {turn.overlap:.2f}"), "black", font)
        strip = np.concatenate(list(turn.tiles.numpy()), axis=-1).transpose(1, 2, 0)
        sheet.paste(Image.fromarray(to_uint8(strip)), (left, top + LABEL))
    save_image(sheet, path)
