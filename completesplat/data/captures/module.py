"""Data module of a user's captures, which are read in place."""

import hashlib
import logging
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch

from completesplat.data.captures.captured_frames import Capture, CapturedFrame
from completesplat.data.captures.colmap import image_count, is_model, read_colmap
from completesplat.data.captures.conventions import require_sight
from completesplat.data.captures.transforms_json import read_polycam, read_transforms
from completesplat.data.loading.object_data_module import ObjectDataModule
from completesplat.data.packed.manifest import Scalar
from completesplat.data.placement import ObjectFraming, from_cameras, from_points, placed_sequence, upright_axes
from completesplat.data.sequences import MaskedImage, PosedSequence, SequenceSource
from completesplat.data.splits import SPLITS
from completesplat.errors import BadImage, DataError, MissingFile, errors_at, refused_to
from completesplat.quantities import Range

logger = logging.getLogger(__name__)

# Points whose distance from the median point exceeds this multiple of the median distance are outliers, because the
# farthest point determines the scale of the scene. Beyond the second multiple, they are errors of the reconstruction.
FARTHEST = 5.0
FARTHEST_USED = 100_000
FEWEST_HELD_OUT = 3
# Files and folders of captures of other programs, and what converts them to one that is read.
OTHERS = {
    "reconstruction.json": "OpenSfM: `opensfm export_colmap FOLDER` writes a model of COLMAP",
    "*.r3d": "Record3D: unpacked, `ns-process-data record3d --data FOLDER --output-dir OUT` writes transforms.json",
    "*.xml": "Metashape: `ns-process-data metashape --data IMAGES --xml FILE --output-dir OUT` writes transforms.json",
}
TRANSFORMS = ("transforms.json", "transforms_train.json")  # the second is NeRF's (synthetic)
# Of COLMAP, nerfstudio, and COLMAP's undistorter.
MODELS = ("sparse/*", "sparse", "colmap/sparse/*", "dense/*/sparse", "dense/sparse")
Members = Callable[[int], Sequence[int]]


def members(hold_out: int, held_out: bool, frames: int) -> list[int]:
    """Return the held-out frames, or the others.

    Every `hold_out`-th frame is held out, from the first on (as LLFF and NeRF), or more for `FEWEST_HELD_OUT` frames.
    """
    step = min(hold_out, (frames - 1) // (FEWEST_HELD_OUT - 1))
    return [frame for frame in range(frames) if (frame % step == 0) == held_out]


def read_capture(folder: Path) -> Capture | None:
    """Read the capture in a folder: `TRANSFORMS`, Polycam's `keyframes`, or the largest model of COLMAP in `MODELS`.

    A model has its `images`, and perhaps `masks`, beside it or in a folder above. `folder` may also be a JSON file.

    Returns:
        The capture, or None if the folder has none.
    """
    files = [folder] if folder.suffix == ".json" else [folder / name for name in TRANSFORMS]
    for transforms in filter(Path.is_file, files):
        return read_transforms(transforms)
    if any((folder / "keyframes" / cameras).is_dir() for cameras in ("cameras", "corrected_cameras")):
        return read_polycam(folder / "keyframes")
    model = _largest_model(folder)
    if model is None:
        return None
    images = _images(model, folder)
    masks = images.with_name("masks")
    return read_colmap(model, images, masks if masks.is_dir() else None)


def _largest_model(folder: Path) -> Path | None:
    """Return the largest model of the first of `MODELS` whose images are there, else of the first that has models."""
    groups = []
    for pattern in MODELS:
        models = [path for path in sorted(folder.glob(pattern)) if is_model(path)]
        if models:
            groups.append(models)
    if not groups:
        return None
    with_images = [models for models in groups if _images(models[0], folder).is_dir()]
    models = with_images[0] if with_images else groups[0]
    if len(models) == 1:
        return models[0]
    model = max(models, key=image_count)
    logger.warning("%s: the largest of %d models, with %d images", model, len(models), image_count(model))
    return model


def read_captures(folders: Mapping[str, Path]) -> tuple[dict[str, Capture], list[DataError]]:
    """Read the captures in some of the folders, by name, and return also the errors of those that cannot be read."""
    captures = dict[str, Capture]()
    refused = list[DataError]()
    for name, folder in folders.items():
        with refused_to(refused.append, sequence=name):
            capture = read_capture(folder)
            if capture is not None:
                captures[name] = capture
    return captures, refused


def _images(model: Path, folder: Path) -> Path:
    """Return the folder `images` beside a model, or in a folder above it, but not above `folder`."""
    above = [parent / "images" for parent in model.parents if parent.is_relative_to(folder)]
    return next((images for images in above if images.is_dir()), folder / "images")


class CaptureSource(SequenceSource):
    """The same part of the frames of each capture.

    Args:
        captures: captures by name.
        members: (number of frames) -> indices of the frames that belong to the split.
    """

    def __init__(
        self, captures: Mapping[str, Capture], members: Members, framing: ObjectFraming, refused: list[DataError]
    ) -> None:
        super().__init__(sorted(captures), len(captures) + len(refused), refused, {})
        self.framing = framing
        self._captures = captures
        self._members = members
        self._sequences: dict[str, PosedSequence] = {}

    def fingerprint(self) -> str:
        """Return the SHA-256 of the files of cameras and points, not of the images."""
        digest = hashlib.sha256()
        for name in self.names:
            for path in self._captures[name].files:
                digest.update(hashlib.sha256(path.read_bytes()).digest())
        return digest.hexdigest()

    def read(self, name: str) -> PosedSequence:
        """Return one capture, whose cameras are computed at the first call."""
        if name not in self._sequences:
            with errors_at(self._captures[name].files[0], name):
                self._sequences[name] = self._make(name)
        return self._sequences[name]

    def check(self, name: str) -> None:
        """Check the headers of all images of a capture, and that a mask shows something, or raise a DataError."""
        with errors_at(sequence=name):
            frames = self._captures[name].frames
            for frame in frames:
                frame.check()
            if all(frame.is_hidden() for frame in frames):
                raise BadImage(
                    "its masks are black everywhere; a mask is white where the object is", str(frames[0].mask)
                )

    def _make(self, name: str) -> PosedSequence:
        """Place the object by all frames, so that all splits have the same scale, and move it to the origin.

        Float32, which holds all that follows, is too coarse for coordinates such as those of maps.
        """
        capture = self._captures[name]
        cameras = [frame.camera() for frame in capture.frames]
        points = capture.points
        if capture.files[0].suffix == ".json":  # COLMAP's convention is known
            require_sight(cameras, points)
        if points is None:
            placement = from_cameras(cameras)
        else:
            with np.errstate(all="ignore"):
                distance = np.linalg.norm(points - np.median(points, axis=0), axis=-1)
                distance /= np.median(distance)
            placement = from_points(points[distance <= FARTHEST], upright_axes(cameras), "the point cloud")
            lost = int((~(distance <= FARTHEST_USED)).sum())
            if lost:
                beyond = f"more than {FARTHEST_USED:,} scene radii away and are left out"
                logger.warning("%s: %d of %d points are %s", name, lost, len(points), beyond)
            points = points[distance <= FARTHEST_USED]
        numbers = self._members(len(capture.frames))
        read = partial(_read, name, [capture.frames[number] for number in numbers], self.framing)
        center = placement.center
        moved = torch.eye(4, dtype=torch.float64)
        moved[:3, 3] = center
        selected = [replace(cameras[i], world_to_camera=cameras[i].world_to_camera @ moved) for i in numbers]
        placement = placement._replace(center=torch.zeros_like(center))
        sequence = placed_sequence(name, numbers, selected, placement, self.framing, read)
        seeds = None if points is None else (sequence.scale * (torch.from_numpy(points) - center)).float()
        photos = tuple(capture.frames[number].image.name for number in numbers)
        return replace(sequence, points=seeds, origin=tuple(center.tolist()), photos=photos)


def _read(name: str, frames: list[CapturedFrame], framing: ObjectFraming, index: int) -> MaskedImage:
    with errors_at(sequence=name):
        image, mask = frames[index].read()
        return framing.cut(frames[index].camera(), image, mask)


class CaptureDataModule(ObjectDataModule):
    """Scenes of captures, each with its own training frames and held-out frames for validation and test.

    Images are undistorted (by pycolmap) when they are read, cut to the largest square around the principal point, and
    scaled to a common object size. The object is placed by the capture's points, else by its cameras.

    Args:
        root: folder or file of a capture (`read_capture`), a folder of such folders, or prepared captures.
        hold_out: one of every `hold_out` frames is for validation and test.
        **settings: of `ObjectDataModule`. The reference of validation and test is the first held-out frame.
    """

    splits_share_sequences = True

    def __init__(self, root: str, hold_out: Annotated[int, Range(2)] = 8, **settings: Any) -> None:
        super().__init__(root, **settings)
        self.hold_out = hold_out

    def describe(self) -> dict[str, str | None]:
        return {
            "data_set": "capture",
            "split": f"one of {self.hold_out} photos is held out, from the first on, and at least {FEWEST_HELD_OUT}",
            **self.described_views("a capture's first held-out frame"),
        }

    def packed_settings(self) -> dict[str, Scalar]:
        return {"hold_out": self.hold_out, **self.framing._asdict()}

    def open(self, split: str) -> Mapping[str, CaptureSource]:
        """Read the cameras of all captures. The error of one capture is only raised if none can be read."""
        unfinished = [self.root.parent / f".{self.root.name}.unfinished", *self.root.glob(".*.unfinished")]
        for folder in unfinished:
            if folder.is_dir():
                logger.warning("%s: left by an import that was interrupted: start it again", folder)
        if not self.root.exists():
            raise MissingFile("no such file or folder", str(self.root))
        captures, refused = read_captures({self.root.resolve().name or "capture": self.root})
        if not captures and not refused:
            folders = sorted(path for path in self.root.glob("[!.]*/") if path.is_dir())
            captures, refused = read_captures({folder.name: folder for folder in folders})
        if refused and not captures:
            raise refused[0]
        if not captures:
            for pattern, name in OTHERS.items():
                for path in sorted(self.root.glob(pattern)):
                    raise MissingFile(f"a capture of {name}", str(path))
            command = shlex.join(["completesplat", "data", "import", str(self.root), "cameras=colmap"])
            absent = "no cameras there: neither transforms.json nor sparse/0, nor folders that have one"
            raise MissingFile(f"{absent}; photos or a video get cameras by: {command}", str(self.root))
        sources = {}
        for part in SPLITS:
            chosen = partial(members, self.hold_out, part != "train")
            sources[part] = CaptureSource(captures, chosen, self.framing, refused)
        return sources
