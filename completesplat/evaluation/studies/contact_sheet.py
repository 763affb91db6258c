"""Contact sheet of several sequences with one marked point each, on which a wrong convention is obvious."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from completesplat.data.loading.training_statistics import world_up
from completesplat.data.sequences import MaskedImage, PosedSequence
from completesplat.errors import DataError
from completesplat.export.images import INK, MARGIN, PAPER, SheetCell, image_sheet, write_png
from completesplat.geometry.cameras import Cameras, nearest_to_axes, project, transform_points
from completesplat.photo.saving import label_font

CELL = 216
FEWEST_CELLS = 3  # pixels of an image; the title needs the width of three
GREY = (190, 190, 190)
MASK = (255, 220, 0)
CROSS_COLORS = ((220, 30, 30), (20, 150, 20), (40, 80, 255))
LEGEND = """A cross marks one point of each scene and must stay at it in all frames;
red: to the first camera's right, green: up, blue: ahead; yellow: mask."""

# Length of an arm as the first camera sees it, in units of half its image's width.
ARM = 0.3
# Root mean squares. Cameras look at one point if their optical axes spread by at least LEAST_SPREAD and miss it by at
# most LARGEST_MISS of its depth.
LEAST_SPREAD = 0.2
LARGEST_MISS = 0.2
# Parts of lines that are nearer to a camera's plane are not drawn (as a share of an arm's length).
NEAREST = 0.05


@dataclass(frozen=True)
class Cross:
    """Cross of three arms that start at `center`. The rows of `arms` are right, up and ahead."""

    center: Float[Tensor, "3"]
    arms: Float[Tensor, "3 3"]

    def ends(self) -> Float[Tensor, "3 2 3"]:
        """Return the two ends of each arm in the world. The first is the centre."""
        return torch.stack([self.center.expand(3, 3), self.center + self.arms], dim=1)


def place_cross(cameras: Cameras, depth_range: Float[Tensor, "2"]) -> Cross:
    """Place a cross where the optical axes of cameras [view] meet, if they meet in front of all cameras.

    Otherwise place it on the axis of the middle camera, in the middle of the depth range in terms of 1 / depth.
    """
    center = _common_point(cameras)
    if center is None:
        middle = (len(cameras.centers) - 1) // 2
        center = cameras.centers[middle] + 2 / (1 / depth_range).sum() * cameras.world_to_camera[middle, 2, :3]
    depth = transform_points(cameras.world_to_camera[0], center[None])[0, 2].abs()
    length = ARM * depth * cameras.image_size[1] / 2 / cameras.intrinsics[0, 0, 0]
    return Cross(center, length * level_axes(cameras))


def level_axes(cameras: Cameras) -> Float[Tensor, "3 3"]:
    """Return the first camera's right, up and ahead as unit rows in the world, levelled to `world_up`."""
    _, down, forward = cameras.world_to_camera[:, :3, :3].unbind(dim=1)
    up = world_up(cameras)
    # Ahead is at the upper edge of an image taken straight down, and at the lower edge of one taken straight up.
    ahead = forward[0] if (forward[0] @ up).abs() < 0.99 else down[0] * (forward[0] @ up).sign()
    ahead = torch.nn.functional.normalize(ahead - (ahead @ up) * up, dim=0)
    return torch.stack([torch.linalg.cross(ahead, up), up, ahead])


def visible_segments(
    camera: Cameras, segments: Float[Tensor, "segment 2 3"], nearest: float
) -> list[tuple[int, Float[Tensor, "2 2"]]]:
    """Return index and ends (pixels) of each segment in front of a camera [], cut off at the depth `nearest`."""
    _, depths = project(camera, segments.flatten(0, 1))
    result = []
    for index, (ends, depth) in enumerate(zip(segments, depths.reshape(-1, 2), strict=True)):
        if depth.max() <= nearest:
            continue
        shares = ((nearest - depth) / (depth.flip(0) - depth)).where(depth < nearest, 0)
        pixels, _ = project(camera, ends + shares[:, None] * (ends.flip(0) - ends))
        result.append((index, pixels))
    return result


def _common_point(cameras: Cameras) -> Float[Tensor, "3"] | None:
    """Return the point nearest to all optical axes, or None if they miss it, face away or are almost parallel."""
    point = nearest_to_axes(cameras, LEAST_SPREAD**2)
    if point is None:
        return None
    forward = cameras.world_to_camera[:, 2, :3]
    point = point.to(cameras.centers)
    depths = ((point - cameras.centers) * forward).sum(dim=-1)
    misses = (point - cameras.centers - depths[:, None] * forward).square().sum(dim=-1)
    met = (depths > 0).all() and misses.mean().sqrt() < LARGEST_MISS * depths.mean()
    return point if met else None


def write_contact_sheet(sequences: Sequence[PosedSequence], path: Path, images: int, title: str) -> None:
    """Write a PNG with a row of images for each sequence.

    The images are evenly spaced from first to last frame. An unreadable image is a grey cell with the error's kind.
    """
    rows = [_row(sequence, images) for sequence in sequences]
    header = Image.new("RGB", (rows[0].width, MARGIN + 60), PAPER)
    ImageDraw.Draw(header).text((MARGIN, MARGIN), f"{title}\n{LEGEND}", INK, label_font(12))
    write_png(path, Image.fromarray(np.concatenate([np.asarray(part) for part in (header, *rows)])))


def _row(sequence: PosedSequence, images: int) -> Image.Image:
    cross = place_cross(sequence.cameras, sequence.depth_ranges[0])
    chosen = np.unique(np.linspace(0, len(sequence.frames) - 1, images).round().astype(int)).tolist()
    cells: list[SheetCell | None] = [_image_cell(sequence, index, cross) for index in chosen]
    width = max(images, FEWEST_CELLS)
    cells += [None] * (width - len(chosen))
    near, far = sequence.depth_ranges[0].tolist()
    focal, *_ = sequence.cameras.intrinsics[0, 0].tolist()
    fov = math.degrees(2 * math.atan(sequence.cameras.image_size[1] / 2 / focal))
    numbers = f"{len(sequence.frames)} cameras, field of view {fov:.1f}°, near {near:.3g}, far {far:.3g}"
    return image_sheet([f"{sequence.name}: {numbers}", *[""] * (width - 1)], [cells])


def _image_cell(sequence: PosedSequence, index: int, cross: Cross) -> SheetCell:
    """Return an image with the cross drawn into it. The label says so if the cross lies outside."""
    label = f"frame {sequence.frames[index]}"
    try:
        frame = sequence.read(index)
    except DataError as error:
        cell = Image.new("RGB", (CELL, CELL), GREY)
        ImageDraw.Draw(cell).text((MARGIN, CELL // 2), error.kind, INK, label_font(12))
        return SheetCell(_tensor(cell), label)
    cell = _with_outline(frame)
    camera = sequence.cameras[index]
    draw = ImageDraw.Draw(cell)
    nearest = NEAREST * cross.arms.norm(dim=-1)[0].item()
    arms = visible_segments(camera, cross.ends(), nearest)
    for arm, ends in arms:
        points = [(x, y) for x, y in (CELL / camera.image_size[1] * ends).tolist()]
        draw.line(points, INK, 5)  # a dark edge keeps it visible on any image
        draw.line(points, CROSS_COLORS[arm], 3)
    inside = any(((ends > 0) & (ends < camera.image_size[1])).all(dim=-1).any() for _, ends in arms)
    return SheetCell(_tensor(cell), label + ("" if inside else ": cross outside" if arms else ": cross behind"))


def _with_outline(frame: MaskedImage) -> Image.Image:
    """Resize an image to a cell, and outline the region where the mask is at least one half."""
    pixels = _resized(frame.image.permute(1, 2, 0).numpy()).copy()
    if frame.mask is not None:
        inside = _resized(frame.mask[0].numpy()) >= 128
        padded = np.pad(inside, 1, mode="edge")
        neighbors = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
        pixels[inside & ~neighbors] = MASK
    return Image.fromarray(pixels)


def _resized(pixels: UInt8[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """Repeat pixels to enlarge an image to a cell, and average them to reduce it."""
    return np.asarray(Image.fromarray(np.ascontiguousarray(pixels)).resize((CELL, CELL), Image.Resampling.BOX))


def _tensor(image: Image.Image | UInt8[np.ndarray, "height width 3"]) -> Float[Tensor, "3 height width"]:
    return torch.from_numpy(np.array(image)).movedim(-1, 0) / 255
