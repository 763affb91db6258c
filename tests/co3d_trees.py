"""Tiny trees in CO3D v2's layout whose cameras and images are known, written by PyTorch3D's conventions alone."""

import gzip
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

CATEGORY = "things"
SUBSET = "fewview_dev"
FRAMES, SEQUENCES, SET_LIST = "frame_annotations.jgz", "sequence_annotations.jgz", f"set_lists/set_lists_{SUBSET}.json"
# Landscape, so that height and width cannot be mixed up.
SIZE = (24, 32)
RADIUS = 4.0
Entry = Mapping[str, Any]  # of a frame, of its viewpoint or of a sequence
OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)])


def orbit(frames: int, start: float = 0.2, radius: float = RADIUS) -> np.ndarray:
    """Places of cameras around the origin, at several heights."""
    angles = start + np.arange(frames) * 0.5
    directions = np.stack([np.cos(angles), 0.3 * np.sin(2 * angles), np.sin(angles)], axis=-1)
    return radius * directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def look(eye: np.ndarray, target: np.ndarray, layout: str = "ndc_isotropic", **intrinsics: Any) -> dict[str, Any]:
    """PyTorch3D's camera at `eye` that sees `target` on its axis: X_cam = X R + T, +x left, +y up, +z forward."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    left = np.cross([0.0, 1.0, 0.0], forward)
    left /= np.linalg.norm(left)
    rotation = np.stack([left, np.cross(forward, left), forward], axis=-1)
    viewpoint = {"focal_length": [3.0, 3.0], "principal_point": [0.0, 0.0], "intrinsics_format": layout, **intrinsics}
    return {"R": rotation.tolist(), "T": (-eye @ rotation).tolist(), **viewpoint}


def pytorch3d_pixels(viewpoint: Entry, size: tuple[int, int], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """PyTorch3D's documentation, cameras.md: NDC has +x left and +y up, pixels start at the top left corner.

    Normalised by image bounds, the left border is x = 1; isotropically, the shorter side's borders are at +-1.
    """
    height, width = size
    camera = points @ np.array(viewpoint["R"]) + np.array(viewpoint["T"])
    focal, principal = np.array(viewpoint["focal_length"]), np.array(viewpoint["principal_point"])
    ndc = focal * camera[:, :2] / camera[:, 2:] + principal
    if viewpoint["intrinsics_format"] == "ndc_norm_image_bounds":
        left_border, top_border = 1.0, 1.0
    else:
        left_border, top_border = width / min(height, width), height / min(height, width)
    x = (left_border - ndc[:, 0]) / (2 * left_border) * width
    y = (top_border - ndc[:, 1]) / (2 * top_border) * height
    return np.stack([x, y], axis=-1), camera[:, 2]


def splatter_image(points: np.ndarray, viewpoints: Sequence[Entry]) -> tuple[np.ndarray, np.ndarray, float]:
    """Splatter Image's `data_preprocessing/co3d_normalisation.py`, step by step on PyTorch3D's row vectors.

    Returns:
        Its camera centres' distances to the world's origin, its points, and its scale.
    """
    rotations, translations = (np.array([view[key] for view in viewpoints]) for key in "RT")
    mean = points.mean(axis=0)
    points, translations = points - mean, translations + np.einsum("i,nij->nj", mean, rotations)
    sideways = rotations.transpose(0, 2, 1)[:, 0] - rotations.transpose(0, 2, 1)[:, 0].mean(axis=0)
    first, up = np.linalg.svd(sideways)[2][[0, 2]]
    basis = np.stack([first, up, np.cross(first, up)], axis=1)
    rotations, points = basis.T @ rotations, points @ basis
    middle = np.array([0, points[:, 1].max() - np.ptp(points[:, 1]) / 2, 0])
    points, translations = points - middle, translations + np.einsum("i,nij->nj", middle, rotations)
    factor = 1.2 * 0.95 / (2 * np.abs(points).max())
    return np.linalg.norm(factor * translations, axis=-1), factor * points, factor


def noise(sequence: str, frame: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """An image that no other frame has."""
    return np.random.default_rng([frame, *sequence.encode()]).integers(0, 256, (*size, 3), dtype=np.uint8)


def disc(size: tuple[int, int] = SIZE) -> np.ndarray:
    """A soft mask of values between 0 and 255."""
    y, x = np.mgrid[: size[0], : size[1]] + 0.5
    distance = np.hypot(x - size[1] / 2, y - size[0] / 2)
    return np.round(255 * np.clip(0.4 * min(size) + 0.5 - distance, 0, 4) / 4).astype(np.uint8)


def depth_bits(depth: np.ndarray) -> np.ndarray:
    """How CO3D keeps depth: 16-bit integers whose bits are float16."""
    return depth.astype(np.float16).view(np.uint16)


def write_cloud(path: Path, points: np.ndarray) -> Path:
    vertices = np.array([tuple(p) for p in points], dtype=[(axis, "f4") for axis in "xyz"])
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path))
    return path


def frame_entry(sequence: str, number: int, viewpoint: Entry, size: tuple[int, int] = SIZE) -> dict[str, Any]:
    """A frame's annotation, with a number in the file's name that is not the frame's, as CO3D has it."""
    folder, stem = f"{CATEGORY}/{sequence}", f"frame{number + 1:06d}"
    return {
        "sequence_name": sequence,
        "frame_number": number,
        "frame_timestamp": 0.1 * number,
        "image": {"path": f"{folder}/images/{stem}.png", "size": list(size)},
        "mask": {"path": f"{folder}/masks/{stem}.png", "mass": 100.0},
        "depth": {"path": f"{folder}/depths/{stem}.png", "scale_adjustment": 1.0, "mask_path": f"{folder}/x.png"},
        "viewpoint": dict(viewpoint),
        "meta": {"frame_type": "train_known"},
    }


def sequence_entry(name: str, quality: float | None = 1.0, cloud_quality: float | None = 1.0) -> dict[str, Any]:
    cloud = {"path": f"{CATEGORY}/{name}/pointcloud.ply", "quality_score": cloud_quality, "n_points": 6}
    return {"sequence_name": name, "category": CATEGORY, "viewpoint_quality_score": quality, "point_cloud": cloud}


def write_annotations(
    root: Path, frames: Sequence[Entry], sequences: Sequence[Entry], splits: Mapping[str, Sequence[str]] | None
) -> Path:
    """The annotations and the set list (split -> names of sequences); without one there is none.

    Returns:
        The category's folder.
    """
    category = root / CATEGORY
    category.mkdir(parents=True, exist_ok=True)
    for file, entries in ((FRAMES, frames), (SEQUENCES, sequences)):
        (category / file).write_bytes(gzip.compress(json.dumps(list(entries)).encode(), 1))
    if splits is not None:
        listed = {
            split: [
                [f["sequence_name"], f["frame_number"], f["image"]["path"]]
                for f in frames
                if f["sequence_name"] in names
            ]
            for split, names in splits.items()
        }
        (category / SET_LIST).parent.mkdir(exist_ok=True)
        (category / SET_LIST).write_text(json.dumps(listed))
    return category


def write_tree(root: Path, counts: Mapping[str, int], splits: Mapping[str, Sequence[str]] | None) -> Path:
    """Sequences of so many frames around an octahedron of half size 1, with all their files; returns the category."""
    entries = []
    for index, (name, count) in enumerate(counts.items()):
        folder = root / CATEGORY / name
        for part in ("images", "masks", "depths"):
            (folder / part).mkdir(parents=True)
        for number, eye in enumerate(orbit(count, start=float(index))):
            entry = frame_entry(name, number, look(eye, np.zeros(3)))
            Image.fromarray(noise(name, number)).save(root / entry["image"]["path"])
            Image.fromarray(disc()).save(root / entry["mask"]["path"])
            Image.fromarray(depth_bits(np.full(SIZE, RADIUS))).save(root / entry["depth"]["path"])
            entries.append(entry)
        write_cloud(folder / "pointcloud.ply", OCTAHEDRON)
    return write_annotations(root, entries, [sequence_entry(name) for name in counts], splits)
