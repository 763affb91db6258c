"""Writers of data in CO3D's layout."""

import gzip
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from completesplat.errors import DataError
from completesplat.files import write_bytes, write_text
from completesplat.photo.saving import save_image, save_jpeg, to_uint8
from completesplat.ply_files import TYPES, vertex_header

FRAMES_PER_SECOND = 10.0
FOLDERS = ("images", "masks", "depths", "depth_masks")
Annotation = dict[str, Any]


def write_frame(
    folder: Path,
    place: tuple[str, str, int],
    image: Float[np.ndarray, "height width 3"],
    coverage: Float[np.ndarray, "height width"],
    depth: Float[np.ndarray, "height width"],
    viewpoint: Mapping[str, object],
    unit: float = 1.0,
) -> Annotation:
    """Write one frame and return its annotation.

    Args:
        folder: the sequence's folder, in which `FOLDERS` exist.
        place: category, name of the sequence, number of the frame.
        image, coverage: colours, and the object's share of each pixel, in [0, 1].
        depth: depth along the optical axis, 0 where it is unknown, in units that are `unit` of the annotation's.
        viewpoint: see `annotations.viewpoint`.
    """
    category, name, number = place
    stem = f"frame{number + 1:06d}"
    files = {
        "image": f"images/{stem}.jpg",
        "mask": f"masks/{stem}.png",
        "depth": f"depths/{stem}.jpg.geometric.png",
        "depth_mask": f"depth_masks/{stem}.png",
    }
    mask = to_uint8(coverage)
    save_jpeg(image, folder / files["image"])
    save_image(Image.fromarray(mask), folder / files["mask"])
    # CO3D stores depth as a 16-bit image whose bits are float16, in units of `scale_adjustment`.
    save_image(Image.fromarray(depth.astype(np.float16).view(np.uint16)), folder / files["depth"])
    save_image(Image.fromarray(np.full_like(mask, 255)), folder / files["depth_mask"])
    paths = {key: f"{category}/{name}/{path}" for key, path in files.items()}
    return {
        "sequence_name": name,
        "frame_number": number,
        "frame_timestamp": number / FRAMES_PER_SECOND,
        "image": {"path": paths["image"], "size": list(mask.shape)},
        "mask": {"path": paths["mask"], "mass": float(coverage.sum())},
        "depth": {"path": paths["depth"], "scale_adjustment": unit, "mask_path": paths["depth_mask"]},
        "viewpoint": viewpoint,
    }


def in_mode(image: Path, mode: str) -> Path:
    """Return the path of an image in a mode of the hidden part, given that of the image in `images`.

    Beside its `images`, a sequence has a folder with the same images in each mode, named after the mode.
    """
    return image.parent.parent / mode / image.name


def sequence_annotation(category: str, name: str, points: int) -> Annotation:
    """Return the annotation of a sequence without a video. If it has points, its cloud is `name`/pointcloud.ply."""
    cloud = {
        "path": f"{category}/{name}/pointcloud.ply",
        "quality_score": 1.0,
        "n_points": points,
    }
    return {
        "sequence_name": name,
        "category": category,
        "video": None,
        "point_cloud": cloud if points else None,
        "viewpoint_quality_score": 1.0,
    }


def write_points(path: Path, points: Float[np.ndarray, "n 3"], colors: UInt8[np.ndarray, "n 3"]) -> None:
    """Write a point cloud as a binary PLY file."""
    properties = [(axis, "float") for axis in "xyz"] + [(channel, "uchar") for channel in ("red", "green", "blue")]
    types = [(name, f"<{TYPES[kind]}") for name, kind in properties]
    vertices = np.rec.fromarrays([*points.T, *colors.T], dtype=types)
    path.write_bytes(vertex_header(len(vertices), properties) + vertices.tobytes())


def write_annotations(category: Path, frames: Sequence[Annotation], sequences: Sequence[Annotation]) -> None:
    for name, content in (("frame_annotations", frames), ("sequence_annotations", sequences)):
        # A fixed time stamp and no file name in the gzip header, so that equal content gives equal bytes.
        write_bytes(category / f"{name}.jgz", gzip.compress(json.dumps(content).encode(), mtime=0))


def write_set_list(category: Path, subset: str, lists: Mapping[str, Sequence[Sequence[object]]]) -> None:
    """Write set list `subset`, where `lists` has [sequence, frame number, image] by split."""
    (category / "set_lists").mkdir()
    write_text(category / "set_lists" / f"set_lists_{subset}.json", json.dumps(lists))


def is_written(description: Path, parameters: Mapping[str, Any]) -> bool:
    """Return whether the folder of a description has data of these parameters.

    Raises:
        DataError: the folder holds something else.
    """
    if not description.parent.exists():
        return False
    existing = None
    with suppress(OSError, ValueError):
        existing = json.loads(description.read_text())
    if existing != parameters:
        raise DataError(f"{description.parent} already holds something else: remove it or choose another folder")
    return True
