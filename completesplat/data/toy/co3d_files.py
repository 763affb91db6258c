"""Files of one sequence in CO3D v2's layout (facebookresearch/co3d, `co3d/dataset/data_types.py`)."""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

from completesplat.data.toy.ingredients import Array
from completesplat.data.toy.scene import ToyScene, render_frame

# From OpenCV's camera axes (+x right, +y down) to PyTorch3D's (+x left, +y up).
TO_PYTORCH3D = np.diag([-1.0, -1.0, 1.0])
FRAMES_PER_SECOND = 10.0
CATEGORY = "toy_objects"


def write_sequence(
    category: Path, name: str, scene: ToyScene, size: int, split: str
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Write pictures, masks, depth and point cloud to `category`/`name`.

    Returns:
        The frames' annotations and the sequence's; their paths start with the category's name.
    """
    for folder in ("images", "masks", "depths", "depth_masks"):
        (category / name / folder).mkdir(parents=True)
    frames = [_write_frame(category, name, scene, frame, size, split) for frame in range(len(scene.camera_to_world))]
    _write_point_cloud(category / name / "pointcloud.ply", scene)
    cloud = {"path": f"{CATEGORY}/{name}/pointcloud.ply", "quality_score": 1.0, "n_points": len(scene.points)}
    sequence = {
        "sequence_name": name,
        "category": CATEGORY,
        "video": None,
        "point_cloud": cloud,
        "viewpoint_quality_score": 1.0,
    }
    return frames, sequence


def _write_frame(category: Path, name: str, scene: ToyScene, frame: int, size: int, split: str) -> dict[str, Any]:
    stem = f"frame{frame + 1:06d}"
    files = {
        "image": f"{name}/images/{stem}.jpg",
        "mask": f"{name}/masks/{stem}.png",
        "depth": f"{name}/depths/{stem}.jpg.geometric.png",
        "depth_mask": f"{name}/depth_masks/{stem}.png",
    }
    image, coverage, depth = render_frame(scene, frame, size)
    picture, mask = _to_bytes(image), _to_bytes(coverage)
    Image.fromarray(picture).save(category / files["image"], quality=95, subsampling=0)
    Image.fromarray(mask).save(category / files["mask"])
    # A 16-bit picture whose bits are float16, in units of `scale_adjustment`: this is how CO3D stores depth.
    Image.fromarray(depth.astype(np.float16).view(np.uint16)).save(category / files["depth"])
    Image.fromarray(np.full_like(mask, 255)).save(category / files["depth_mask"])
    paths = {key: f"{CATEGORY}/{path}" for key, path in files.items()}
    return {
        "sequence_name": name,
        "frame_number": frame,
        "frame_timestamp": frame / FRAMES_PER_SECOND,
        "image": {"path": paths["image"], "size": [size, size]},
        "mask": {"path": paths["mask"], "mass": float(coverage.sum())},
        "depth": {"path": paths["depth"], "scale_adjustment": scene.unit, "mask_path": paths["depth_mask"]},
        "viewpoint": _viewpoint(scene, frame),
        "meta": {"frame_type": f"{split}_known"},
    }


def _to_bytes(values: Array) -> Any:
    return np.round(255 * values.clip(0, 1)).astype(np.uint8)


def _viewpoint(scene: ToyScene, frame: int) -> dict[str, Any]:
    """PyTorch3D's camera (row vectors: X_cam = X_world R + T) in a world of the scene's own unit and origin."""
    world_to_camera = np.linalg.inv(scene.camera_to_world[frame])
    rotation = world_to_camera[:3, :3]
    translation = scene.unit * world_to_camera[:3, 3] - rotation @ scene.origin
    focal = 1 / np.tan(np.radians(scene.fov_degrees) / 2)
    return {
        "R": (TO_PYTORCH3D @ rotation).T.tolist(),
        "T": (TO_PYTORCH3D @ translation).tolist(),
        "focal_length": [focal, focal],
        "principal_point": [0.0, 0.0],
        "intrinsics_format": "ndc_norm_image_bounds",
    }


def _write_point_cloud(path: Path, scene: ToyScene) -> None:
    points, colors = scene.unit * scene.points + scene.origin, _to_bytes(scene.point_colors)
    types = [(axis, "<f4") for axis in "xyz"] + [(channel, "u1") for channel in ("red", "green", "blue")]
    vertices = np.empty(len(points), dtype=types)
    for axis, column in zip("xyz", points.T, strict=True):
        vertices[axis] = column
    for channel, column in zip(("red", "green", "blue"), colors.T, strict=True):
        vertices[channel] = column
    PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(path))
