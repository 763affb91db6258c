"""Writer of a capture as a category in CO3D v2's layout, with undistorted images."""

import shutil
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from kornia.geometry.calibration import distort_points
from PIL import Image
from rich.progress import track
from torch import Tensor

from completesplat.data.captures.capture import Capture, CapturedFrame, Lens, PointCloud, read_picture
from completesplat.data.co3d.annotations import sequence_annotation, viewpoint, write_annotations, write_points
from completesplat.data.images.files import decode, save_image
from completesplat.data.validation import BadCamera, at
from completesplat.geometry.cameras import pixel_centers

ROWS_AT_ONCE = 64
SMALLEST_SHARE = 0.5  # If less of an image's area is left, the distortion coefficients must be wrong.

SUBSET = "imported"
# Points whose distance from the median point exceeds this multiple of the median distance are removed as outliers,
# because the farthest point determines the scale of the scene.
FARTHEST = 5.0
FEWEST_HELD_OUT = 2


class Undistortion:
    """Resampling of the images of one lens to a pinhole camera with the same focal lengths.

    Pixels that the source does not show, and those where the distortion model folds the image over, are cropped at the
    borders. This moves the principal point in pixels.

    Attributes:
        pinhole: the lens of the results.

    Raises:
        BadCamera: less than half of the image is left, or the principal point is cropped.
    """

    def __init__(self, lens: Lens) -> None:
        positions = _source_positions(lens)
        left, top, right, bottom = _largest_box(_seen(positions, lens.image_size))
        height, width = lens.image_size
        center = lens.center[0] - left, lens.center[1] - top
        size = bottom - top, right - left
        inside = 0 < center[0] < size[1] and 0 < center[1] < size[0]
        if not inside or size[0] * size[1] < SMALLEST_SHARE * height * width:
            remaining = f"{size[1]} x {size[0]} of {width} x {height} pixels"
            raise BadCamera(f"distortion {lens.distortion} leaves {remaining} usable")
        self.pinhole = replace(lens, center=center, image_size=size, distortion=(0.0,) * 5)
        # For `grid_sample`, the image's borders are at -1 and 1.
        scale = torch.tensor([2 / width, 2 / height], dtype=positions.dtype)
        self._grid = positions[top:bottom, left:right] * scale - 1

    def __call__(self, picture: Image.Image) -> Image.Image:
        """Undistort an image, RGB (bicubic) or grey (a mask; bilinear)."""
        pixels = np.array(picture)
        source = torch.from_numpy(pixels.reshape(*pixels.shape[:2], -1)).permute(2, 0, 1)[None].float()
        mode = "bicubic" if picture.mode == "RGB" else "bilinear"
        result = F.grid_sample(source, self._grid[None], mode=mode, padding_mode="border", align_corners=False)[0]
        array = result.round_().clamp_(0, 255).to(torch.uint8).permute(1, 2, 0).numpy()
        return Image.fromarray(array if picture.mode == "RGB" else array[..., 0])


def _source_positions(lens: Lens) -> Float[Tensor, "height width 2"]:
    """Return the position in the distorted image for each pixel centre of the pinhole camera."""
    (fx, fy), (cx, cy) = lens.focal, lens.center
    matrix = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    distortion = torch.tensor(lens.distortion, dtype=torch.float64)
    rows = torch.split(pixel_centers(*lens.image_size, dtype=torch.float64), ROWS_AT_ONCE)
    return torch.cat([distort_points(part.flatten(0, 1), matrix, distortion).view_as(part).float() for part in rows])


def _seen(positions: Float[Tensor, "height width 2"], image_size: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Return which positions lie in the source image and are not folded over relative to their neighbours."""
    size = torch.tensor(image_size[::-1], dtype=positions.dtype)
    seen = ((positions >= 0) & (positions <= size)).all(dim=-1)
    right, down = positions[:-1].diff(dim=1), positions[:, :-1].diff(dim=0)
    upright = right[..., 0] * down[..., 1] > right[..., 1] * down[..., 0]
    for rows in (slice(None, -1), slice(1, None)):
        for columns in (slice(None, -1), slice(1, None)):
            seen[rows, columns] &= upright
    return seen.numpy()


def _largest_box(seen: Bool[np.ndarray, "height width"]) -> tuple[int, int, int, int]:
    """Find a large (left, top, right, bottom) of seen pixels, by cutting the worst side until no others are left."""
    sums = np.pad((~seen).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))

    def unseen(left: int, top: int, right: int, bottom: int) -> float:
        """Return the share of unseen pixels in a box."""
        count = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        return float(count / ((right - left) * (bottom - top)))

    left, top, (bottom, right) = 0, 0, seen.shape
    while unseen(left, top, right, bottom) and right - left > 1 and bottom - top > 1:
        strips = [
            unseen(left, top, left + 1, bottom),
            unseen(left, top, right, top + 1),
            unseen(right - 1, top, right, bottom),
            unseen(left, bottom - 1, right, bottom),
        ]
        worst = strips.index(max(strips))
        left, top = left + (worst == 0), top + (worst == 1)
        right, bottom = right - (worst == 2), bottom - (worst == 3)
    return left, top, right, bottom


class Written(NamedTuple):
    """Numbers of written frames, of files copied as they are, of held-out frames and of points."""

    frames: int
    copied: int
    held_out: int
    points: int


class CaptureWriter:
    """Writer of the files of one capture.

    Args:
        folder: empty temporary folder of the category.
        category: final name of the category, with which the paths in annotations start.
        quality: JPEG quality of images that are encoded again.
    """

    def __init__(self, folder: Path, category: str, sequence: str, quality: int) -> None:
        self.folder, self.category, self.sequence, self.quality = folder, category, sequence, quality
        # A capture has one lens, or one for each frame. Caching more than the last one would fill the memory.
        self._undistortion = lru_cache(maxsize=1)(Undistortion)
        self._copied = 0

    def write(self, capture: Capture, hold_out: int, progress: bool) -> Written:
        """Write pictures, masks, point cloud, annotations and the set list `imported`.

        Plain 8-bit RGB JPEG or PNG files of a lens without distortion are copied byte for byte. Other images are
        encoded again: as JPEG without chroma subsampling if they were JPEG, else as PNG. For a frame without a mask
        file, the mask is its alpha channel, or white.

        Raises:
            DataError: an image or mask is missing, unusable or differs in size from the lens.
        """
        for kind in ("images", "masks"):
            (self.folder / self.sequence / kind).mkdir(parents=True)
        held_out = held_out_frames(len(capture.frames), hold_out)

        def write_frame(number: int) -> dict[str, Any]:
            frame = capture.frames[number]
            with at(frame.image, self.sequence, frame.number):
                return self._write_frame(number, frame, number in held_out)

        # An exception passes through the progress bar, which ends before the error is printed.
        count = len(capture.frames)
        frames = list(track(map(write_frame, range(count)), "Importing pictures", count, disable=not progress))
        points = 0 if capture.cloud is None else self._write_cloud(capture.cloud)
        self._write_lists(frames, held_out, points)
        return Written(len(frames), self._copied, len(held_out), points)

    def _write_frame(self, number: int, frame: CapturedFrame, held_out: bool) -> dict[str, Any]:
        picture, size = read_picture(frame.image, frame.lens.image_size), frame.lens.image_size
        image, mask, lens = picture.image, picture.alpha, frame.lens
        if frame.mask is not None:
            mask = decode(frame.mask, str(frame.mask), "L", size)
        mask = mask or Image.new("L", image.size, 255)
        if any(lens.distortion):
            undistort = self._undistortion(lens)
            image, mask, lens = undistort(image), undistort(mask), undistort.pinhole
        stem = f"frame{number + 1:06d}"
        path = f"{self.sequence}/images/{stem}{'.jpg' if picture.lossy else '.png'}"
        if picture.plain and lens is frame.lens:
            shutil.copyfile(frame.image, self.folder / path)
            self._copied += 1
        else:
            options: dict[str, Any] = {"quality": self.quality, "subsampling": 0} if picture.lossy else {}
            save_image(image, self.folder / path, **options)
        mask_path = f"{self.sequence}/masks/{stem}.png"
        save_image(mask, self.folder / mask_path)
        return {
            "sequence_name": self.sequence,
            "frame_number": number,
            "frame_timestamp": float(number),
            "image": {"path": f"{self.category}/{path}", "size": list(lens.image_size)},
            "mask": {"path": f"{self.category}/{mask_path}", "mass": float(np.asarray(mask, dtype=float).sum() / 255)},
            "depth": None,
            "viewpoint": _viewpoint(lens, frame.world_to_camera),
            "meta": {"frame_type": "test_unseen" if held_out else "train_known", "imported_from": frame.image.name},
        }

    def _write_cloud(self, cloud: PointCloud) -> int:
        distance = np.linalg.norm(cloud.points - np.median(cloud.points, axis=0), axis=-1)
        mask = distance <= FARTHEST * np.median(distance)
        write_points(self.folder / self.sequence / "pointcloud.ply", cloud.points[mask], cloud.colors[mask])
        return int(mask.sum())

    def _write_lists(self, frames: list[dict[str, Any]], held_out: set[int], points: int) -> None:
        sequence = sequence_annotation(self.category, self.sequence, points)
        keys = [[self.sequence, number, frame["image"]["path"]] for number, frame in enumerate(frames)]
        unseen = [keys[number] for number in sorted(held_out)]
        lists = {"train": [key for key in keys if key not in unseen], "val": unseen, "test": unseen}
        write_annotations(self.folder, frames, [sequence], SUBSET, lists)


def held_out_frames(frames: int, hold_out: int) -> set[int]:
    """Return every `hold_out`-th frame from the first on (as LLFF and NeRF), or more for at least two frames."""
    return set(range(0, frames, min(hold_out, frames // FEWEST_HELD_OUT)))


def _viewpoint(lens: Lens, world_to_camera: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    half = np.array(lens.image_size[::-1]) / 2
    focal, center = np.array(lens.focal) / half, (half - lens.center) / half
    return viewpoint(world_to_camera[:3, :3], world_to_camera[:3, 3], focal.tolist(), center.tolist())
