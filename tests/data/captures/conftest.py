"""Captures whose truth is known: bright blobs where a lens model of their own puts some points."""

import gzip
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image

from completesplat.data.co3d.annotations import camera_from_viewpoint
from completesplat.geometry.cameras import project

RNG = np.random.default_rng(7)
POINTS = RNG.uniform(-1, 1, (14, 3)) * [1.4, 0.9, 1.2]
FRAMES = 8
BLOB = 1.8  # standard deviation in pixels
WINDOW = 7


def opengl_poses(frames: int = FRAMES) -> np.ndarray:
    """Camera-to-world, +x right, +y up, +z backward, on a rising arc around the origin."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for pose, angle in zip(poses, np.linspace(0.3, 4.0, frames), strict=True):
        eye = np.array([4.2 * np.sin(angle), 0.6 + 0.2 * angle, 4.2 * np.cos(angle)])
        back = eye / np.linalg.norm(eye)
        right = np.cross([0.1, 1, 0], back)
        right /= np.linalg.norm(right)
        pose[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    return poses


@dataclass
class Shot:
    """A lens for tests: OpenCV's model, written down anew."""

    focal: tuple[float, float] = (190.0, 205.0)
    center: tuple[float, float] = (112.5, 66.0)
    width: int = 210
    height: int = 150
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    points: np.ndarray = field(default_factory=lambda: POINTS)

    def pixels(self, pose: np.ndarray) -> np.ndarray:
        """Where an OpenGL camera sees the points."""
        local = (self.points - pose[:3, 3]) @ pose[:3, :3]
        x, y = local[:, 0] / -local[:, 2], -local[:, 1] / -local[:, 2]
        square = x**2 + y**2
        radial = 1 + self.k1 * square + self.k2 * square**2 + self.k3 * square**3
        u = x * radial + 2 * self.p1 * x * y + self.p2 * (square + 2 * x**2)
        v = y * radial + self.p1 * (square + 2 * y**2) + 2 * self.p2 * x * y
        return np.stack([self.focal[0] * u + self.center[0], self.focal[1] * v + self.center[1]], axis=1)

    def draw(self, pixels: np.ndarray) -> np.ndarray:
        """Blobs on black; the centre of the first pixel is (0.5, 0.5)."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        blobs = [np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * BLOB**2)) for u, v in pixels]
        grey = np.round(230 * np.clip(np.sum(blobs, axis=0), 0, 1)).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=2)

    def intrinsics(self) -> dict[str, float]:
        (fl_x, fl_y), (cx, cy) = self.focal, self.center
        keys = {"fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy, "w": self.width, "h": self.height}
        return keys | {k: getattr(self, k) for k in ("k1", "k2", "k3", "p1", "p2")}


def write_transforms(folder: Path, shot: Shot, suffix: str = ".png", **content: object) -> Path:
    """A capture in `folder`, and the path of its transforms.json. `content` overrides the file's keys."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for number, pose in enumerate(opengl_poses()):
        name = f"images/r_{number}{suffix}"
        Image.fromarray(shot.draw(shot.pixels(pose))).save(folder / name, quality=97, subsampling=0)
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    path = folder / "transforms.json"
    path.write_text(json.dumps({**shot.intrinsics(), "frames": frames, **content}))
    return path


def edit(path: Path, change) -> Path:
    """Change the content of a JSON file in place."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return path


def annotations(category: Path) -> list[dict]:
    return json.loads(gzip.decompress((category / "frame_annotations.jgz").read_bytes()))


def pixels_of(category: Path, entry: dict, kind: str = "image") -> np.ndarray:
    return np.asarray(Image.open(category.parent / entry[kind]["path"]))


def reprojection_errors(category: Path, points: np.ndarray, kind: str = "image") -> np.ndarray:
    """Distances in pixels between projections by the written cameras and the blobs in the written pictures or masks."""
    errors = []
    for entry in annotations(category):
        cameras = camera_from_viewpoint(entry["viewpoint"], entry["image"]["size"])
        projected = project(cameras, torch.from_numpy(points))[0].numpy()
        pixels = pixels_of(category, entry, kind).astype(float)
        picture = pixels[..., 0] if kind == "image" else pixels
        assert list(picture.shape) == entry["image"]["size"]
        for index, (u, v) in enumerate(projected):
            others = np.delete(projected, index, axis=0)
            near_border = not (10 < u < picture.shape[1] - 10 and 10 < v < picture.shape[0] - 10)
            if near_border or np.abs(others - [u, v]).max(axis=1).min() < 2 * WINDOW:
                continue
            left, top = int(u) - WINDOW, int(v) - WINDOW
            window = picture[top : top + 2 * WINDOW + 1, left : left + 2 * WINDOW + 1]
            assert window.sum() > 1000  # there is a blob
            rows, columns = np.mgrid[: window.shape[0], : window.shape[1]] + 0.5
            found = np.array([(window * columns).sum(), (window * rows).sum()]) / window.sum() + [left, top]
            errors.append(np.linalg.norm(found - [u, v]))
    return np.array(errors)


@pytest.fixture
def captures() -> ModuleType:
    """The functions of this file."""
    return sys.modules[__name__]
