"""What photos of a turntable say about their turn: does it close, where does it go, and do the masks fit together."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from completesplat.data.images.files import save_image, to_bytes
from completesplat.errors import DataError
from completesplat.files import printable
from completesplat.geometry.cameras import Cameras, crop_resize, pixel_rays, project

Photos = Float[Tensor, "photo 3 size size"]
Masks = Float[Tensor, "photo 1 size size"]

HALF_WIDTH = 55  # degrees to each side of the middle in which the surface is compared
LEAST_STEP = 8.0  # degrees between photos that are compared
CERTAIN = 3.0  # standard errors from which on the flow has a direction
HULL = 48  # voxels, pixels and samples of a ray, along each side
MOST_VIEWS = 36  # from which the hull is made
TILES, TILE, LABEL = 8, 48, 12  # photos of a ring on the sheet; pixels
HOLE = 0.7  # grey of what no mask covers


class Closing(NamedTuple):
    """Mean absolute differences (0 to 255) of photos made equally bright: first and last, neighbours, half a turn."""

    ends: float
    neighbours: float
    half_turn: float


class Findings(NamedTuple):
    """Findings about one turn.

    Attributes:
        flow: 1 if the surface in the middle of the photos moves left, -1 if it moves right, 0 if that cannot be told.
        overlap: of the masks with their visual hull; see `hull_overlap`.
        tiles: some of the photos, grey outside of their masks.
    """

    closing: Closing
    flow: int
    overlap: float
    tiles: Photos


def examine(photos: Photos, masks: Masks, angles: Float[np.ndarray, " photo"], cameras: Cameras) -> Findings:
    """Return the findings about one turn of square photos.

    Raises:
        DataError: the last photo is less like the first than any two neighbours, and nearer to half a turn apart. Photos
            that leave a gap are not compared.
    """
    brightness = (photos * masks).mean((1, 2, 3)) / masks.mean((1, 2, 3))
    even = photos * (brightness.mean() / brightness).view(-1, 1, 1, 1) * masks + (1 - masks)
    steps, gap = np.diff(angles), 2 * math.pi - angles[-1] + angles[0]
    differences, largest = closing(even)
    if gap <= 2 * np.median(steps) and differences.ends > max(largest, sum(differences[1:]) / 2):
        compared = "; ".join(f"{name.replace('_', ' ')}: {x:.1f}" for name, x in differences._asdict().items())
        raise DataError(f"the turn does not close; differences of photos: {compared}")
    mean, error = flow(even, masks, angles)
    direction = int(np.sign(mean)) if abs(mean) >= CERTAIN * error else 0
    chosen = torch.arange(TILES) * len(photos) // TILES
    tiles = interpolate((photos * masks + HOLE * (1 - masks))[chosen], size=(TILE, TILE), mode="area")
    return Findings(differences, direction, hull_overlap(masks, cameras), tiles)


def closing(photos: Photos) -> tuple[Closing, float]:
    """Compare the last photo of an evenly spaced turn with the first; return also the largest difference of neighbours.
    """

    def apart(step: int) -> Float[Tensor, " photo"]:
        return 255 * (photos - photos.roll(-step, 0)).abs().mean((1, 2, 3))

    *neighbours, ends = apart(1).tolist()
    return Closing(ends, float(np.mean(neighbours)), float(apart(len(photos) // 2).mean())), max(neighbours)


def flow(photos: Photos, masks: Masks, angles: Float[np.ndarray, " photo"]) -> tuple[float, float]:
    """Return how much better the surface in the middle matches that of the next photo if it goes left than right.

    The surface is unrolled like that of a cylinder, as wide in each row as the mean mask, so that a turn is a shift by
    a known number of degrees. Light that stands still is the mean over all photos, which is subtracted.

    Returns:
        The mean over the pairs, from -1 (right) to 1 (left), and its standard error.
    """
    unrolled = _unrolled(photos, masks)
    degrees, scores = np.degrees(angles), []
    stride = max(1, round(LEAST_STEP / float(np.median(np.diff(degrees)))))
    for index in range(len(photos)):
        step = round((degrees[(index + stride) % len(photos)] - degrees[index]) % 360)
        if 0 < step <= HALF_WIDTH:
            first, second = unrolled[index], unrolled[(index + stride) % len(photos)]
            left = (first[..., step:] - second[..., :-step]).square().mean()
            right = (first[..., :-step] - second[..., step:]).square().mean()
            scores.append(float((right - left) / (right + left + 1e-12)))
    if len(scores) < 2:
        return 0.0, math.inf
    return float(np.mean(scores)), float(np.std(scores, ddof=1) / math.sqrt(len(scores)))


def _unrolled(photos: Photos, masks: Masks) -> Float[Tensor, "photo 3 row degree"]:
    """Return the surface in the middle half of the rows, from -55 to 55 degrees, without its mean over the photos."""
    mean, size = masks.mean((0, 1)), masks.shape[-1]
    filled = torch.nonzero((mean > 0.5).any(1))[:, 0]
    top, bottom = float(filled[0]), float(filled[-1]) + 1
    rows = torch.arange(size)[(torch.arange(size) >= 0.75 * top + 0.25 * bottom).nonzero()[:, 0]]
    rows = rows[rows < 0.25 * top + 0.75 * bottom]
    radius = (mean[rows] > 0.5).sum(1) / size  # half the width, in halves of the image's side
    sines = torch.arange(-HALF_WIDTH, HALF_WIDTH + 1).deg2rad().sin()
    x = radius[:, None] * sines
    y = ((2 * rows + 1) / size - 1)[:, None].expand_as(x)
    grid = torch.stack([x, y], dim=-1).expand(len(photos), *x.shape, 2)
    unrolled = grid_sample(photos, grid, align_corners=False)
    return unrolled - unrolled.mean(0)


def hull_overlap(masks: Masks, cameras: Cameras) -> float:
    """Return the mean overlap (intersection over union) of the masks with the silhouettes of their visual hull.

    The hull is carved from a cube of 48^3 voxels around the origin, which is as large as the images see there.
    """
    chosen = torch.arange(min(len(masks), MOST_VIEWS)) * len(masks) // min(len(masks), MOST_VIEWS)
    small = interpolate(masks[chosen], size=(HULL, HULL), mode="area")
    cameras = crop_resize(cameras[chosen], 0, 0, cameras.image_size[0], HULL).to(torch.float32)
    distance = float(cameras.centers[0].norm())
    half = distance * HULL / 2 / float(cameras.intrinsics[0, 0, 0])
    places = (torch.arange(HULL) + 0.5) / HULL * 2 - 1
    z, y, x = torch.meshgrid(places, places, places, indexing="ij")
    voxels = half * torch.stack([x, y, z], dim=-1).reshape(-1, 3)
    hull = torch.ones(len(voxels))
    for view in range(len(small)):
        pixels, _ = project(cameras[view], voxels)
        inside = grid_sample(small[view : view + 1], (pixels * 2 / HULL - 1)[None, None], align_corners=False)
        hull = torch.minimum(hull, inside.flatten())
    overlaps = []
    for view in range(len(small)):
        depths = distance + math.sqrt(2) * half * places
        rays = pixel_rays(cameras[view]) @ cameras[view].world_to_camera[:3, :3] / half  # rows are right, down, ahead
        points = cameras[view].centers / half + depths[:, None, None, None] * rays
        values = grid_sample(hull.view(1, 1, HULL, HULL, HULL), points[None], align_corners=False)
        silhouette, mask = values[0, 0].amax(0) > 0.5, small[view, 0] > 0.5
        overlaps.append(float((silhouette & mask).sum() / (silhouette | mask).sum()))
    return float(np.mean(overlaps))


def write_sheet(findings: Mapping[str, Findings], path: Path) -> None:
    """Write some photos of each turn, evenly spread over it, with the turn's name, in columns."""
    height, width = TILE + LABEL, TILES * TILE + LABEL
    columns = math.ceil(math.sqrt(len(findings) * height / width))
    rows = math.ceil(len(findings) / columns)
    sheet = Image.new("RGB", (columns * width, rows * height), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(LABEL - 2)
    for index, (name, found) in enumerate(findings.items()):
        left, top = index // rows * width, index % rows * height
        draw.text((left, top), printable(f"{name}  {found.overlap:.2f}"), "black", font)
        strip = np.concatenate(list(found.tiles.numpy()), axis=-1).transpose(1, 2, 0)
        sheet.paste(Image.fromarray(to_bytes(strip)), (left, top + LABEL))
    save_image(sheet, path)
