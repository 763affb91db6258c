"""Archives in the layout of pixelNeRF's `srn_cars.zip`: a disc with a dark spot on white, seen from around."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from completesplat.geometry.cameras import invert_rigid, look_at

SIZE = 64
FOCAL = SIZE * 131.25 / 128  # the archives' 131.25 at 128 px
DISTANCE = 1.3
SPOT = (0.2, -0.1, 0.25)
OBJECT = (150, 90, 255)  # one channel is 255, so that pixelNeRF's own mask would leave it out
LOWEST = 0.3


def write_archive(root: Path, category: str, splits: Mapping[str, Sequence[str]], views: int, size: int = SIZE) -> None:
    """Write objects of each split: a ball around the origin with a dark spot, rendered on white as RGBA."""
    for split, names in splits.items():
        for number, name in enumerate(names):
            write_object(root / f"{category}_{split}" / name, views, size, number)


def write_object(folder: Path, views: int, size: int, number: int) -> None:
    """Write one object, whose views spiral from below to above, as in the archives' test sets."""
    for kind in ("rgb", "pose"):
        (folder / kind).mkdir(parents=True)
    focal = size * 131.25 / 128
    lines = [f"{focal:f} {size / 2:f} {size / 2:f} 0.", "0. 0. 0.", "1.", f"{size} {size}"]
    (folder / "intrinsics.txt").write_text("\n".join(lines) + "\n")
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    for view in range(views):
        azimuth = 0.5 + 2 * math.pi * view / views
        elevation = LOWEST + 0.5 * view / views
        level = math.cos(elevation)
        direction = [level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)]
        eye = DISTANCE * torch.tensor([direction], dtype=torch.float64)
        pose = invert_rigid(look_at(eye, torch.zeros_like(eye), up)[0])
        (folder / f"pose/{view:06d}.txt").write_text(" ".join(f"{value:.9f}" for value in pose.flatten().tolist()))
        pixels = drawn(np.linalg.inv(pose.numpy()), focal, size, number)
        Image.fromarray(pixels).save(folder / f"rgb/{view:06d}.png")


def drawn(world_to_camera: np.ndarray, focal: float, size: int, number: int) -> np.ndarray:
    """Return RGBA pixels: a disc in the middle, whose colour depends on the number, and the spot, both opaque.

    A pose has OpenCV's axes (Splatter Image, `scene/srn.py`): x right, y down, z away from the camera.
    """
    y, x = np.mgrid[:size, :size] + 0.5
    pixels = np.full((size, size, 4), 255, np.uint8)
    disc = np.hypot(x - size / 2, y - size / 2) < 0.35 * size
    pixels[disc, :3] = np.roll(OBJECT, number)
    right, down, away = world_to_camera[:3, :3] @ SPOT + world_to_camera[:3, 3]
    column = int(focal * right / away + size / 2)
    row = int(focal * down / away + size / 2)
    pixels[row, column, :3] = 0
    return pixels
