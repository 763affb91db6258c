"""Writes a capture as a category of one sequence in CO3D v2's layout (facebookresearch/co3d, `data_types.py`)."""

import gzip
import json
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image
from plyfile import PlyData, PlyElement
from rich.progress import track

from completesplat.data.checks import at
from completesplat.data.images import decode
from completesplat.data.importing.capture import Capture, CapturedFrame, Lens, PointCloud
from completesplat.data.importing.pictures import read_picture
from completesplat.data.importing.undistortion import Undistortion

SUBSET = "imported"
# From OpenCV's camera axes (+x right, +y down) to PyTorch3D's (+x left, +y up).
TO_PYTORCH3D = np.diag([-1.0, -1.0, 1.0])
# Points further from the median point than so many times their median distance are taken for stray: the farthest point
# gives the scale of the scene.
FARTHEST = 5.0
FEWEST_HELD_OUT = 2


class Written(NamedTuple):
    """Numbers of what was written."""

    frames: int
    copied: int
    held_out: int
    points: int


class CaptureWriter:
    """Writes the files of one capture.

    Args:
        folder: the category's, for now; it exists and is empty.
        category: its final name, with which the paths in annotations start.
        sequence: name of the only sequence.
        quality: of JPEG files that are written anew.
    """

    def __init__(self, folder: Path, category: str, sequence: str, quality: int) -> None:
        self.folder = folder
        self.category = category
        self.sequence = sequence
        self.quality = quality
        self._undistortions: dict[Lens, Undistortion] = {}
        self._copied = 0

    def write(self, capture: Capture, hold_out: int, progress: bool) -> Written:
        """Write pictures, masks, point cloud, annotations and the set list `imported`.

        Files that are plain 8-bit RGB JPEG or PNG, of a lens without distortion, are copied byte for byte. All others
        are written anew: JPEG without chroma subsampling if they were JPEG, else PNG. Frames without a mask of their
        own get their alpha as the mask, or a white one.

        Raises:
            DataError: pictures or masks that are missing, unusable or of another size than the lens says.
        """
        for kind in ("images", "masks"):
            (self.folder / self.sequence / kind).mkdir(parents=True)
        held_out = held_out_frames(len(capture.frames), hold_out)
        frames = []
        shown = track(capture.frames, description="Importing pictures", disable=not progress)
        for number, frame in enumerate(shown):
            with at(frame.image, self.sequence, frame.number):
                frames.append(self._write_frame(number, frame, number in held_out))
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
            image.save(self.folder / path, **options)
        mask_path = f"{self.sequence}/masks/{stem}.png"
        mask.save(self.folder / mask_path)
        return {
            "sequence_name": self.sequence,
            "frame_number": number,
            "frame_timestamp": float(number),
            "image": {"path": f"{self.category}/{path}", "size": list(lens.image_size)},
            "mask": {
                "path": f"{self.category}/{mask_path}",
                "mass": float(np.asarray(mask, dtype=np.float64).sum() / 255),
            },
            "depth": None,
            "viewpoint": viewpoint(lens, frame.world_to_camera),
            "meta": {"frame_type": "test_unseen" if held_out else "train_known", "imported_from": frame.image.name},
        }

    def _undistortion(self, lens: Lens) -> Undistortion:
        if lens not in self._undistortions:
            # Captures have one lens, or one for each frame: keeping more than the last would fill the memory.
            self._undistortions = {lens: Undistortion(lens)}
        return self._undistortions[lens]

    def _write_cloud(self, cloud: PointCloud) -> int:
        distance = np.linalg.norm(cloud.points - np.median(cloud.points, axis=0), axis=-1)
        kept = distance <= FARTHEST * np.median(distance)
        types = [(axis, "<f4") for axis in "xyz"] + [(channel, "u1") for channel in ("red", "green", "blue")]
        vertices = np.empty(int(kept.sum()), dtype=types)
        for axis, column in zip("xyz", cloud.points[kept].T, strict=True):
            vertices[axis] = column
        for channel, column in zip(("red", "green", "blue"), cloud.colors[kept].T, strict=True):
            vertices[channel] = column
        path = self.folder / self.sequence / "pointcloud.ply"
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(path))
        return len(vertices)

    def _write_lists(self, frames: list[dict[str, Any]], held_out: set[int], points: int) -> None:
        cloud = {"path": f"{self.category}/{self.sequence}/pointcloud.ply", "quality_score": 1.0, "n_points": points}
        sequence = {
            "sequence_name": self.sequence,
            "category": self.category,
            "video": None,
            "point_cloud": cloud if points else None,
            "viewpoint_quality_score": 1.0,
        }
        keys = [[self.sequence, number, frame["image"]["path"]] for number, frame in enumerate(frames)]
        unseen = [keys[number] for number in sorted(held_out)]
        lists = {"train": [key for key in keys if key not in unseen], "val": unseen, "test": unseen}
        for name, content in (("frame_annotations", frames), ("sequence_annotations", [sequence])):
            (self.folder / f"{name}.jgz").write_bytes(gzip.compress(json.dumps(content).encode(), mtime=0))
        (self.folder / "set_lists").mkdir()
        (self.folder / "set_lists" / f"set_lists_{SUBSET}.json").write_text(json.dumps(lists))


def held_out_frames(frames: int, hold_out: int) -> set[int]:
    """Every `hold_out`-th frame from the first on (the split of LLFF and NeRF), or more often: at least two."""
    return set(range(0, frames, min(hold_out, frames // FEWEST_HELD_OUT)))


def viewpoint(lens: Lens, world_to_camera: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """PyTorch3D's camera (row vectors: X_cam = X_world R + T), its intrinsics in units of half the picture's sides."""
    half = np.array(lens.image_size[::-1]) / 2
    return {
        "R": (TO_PYTORCH3D @ world_to_camera[:3, :3]).T.tolist(),
        "T": (TO_PYTORCH3D @ world_to_camera[:3, 3]).tolist(),
        "focal_length": (np.array(lens.focal) / half).tolist(),
        "principal_point": ((half - lens.center) / half).tolist(),
        "intrinsics_format": "ndc_norm_image_bounds",
    }
