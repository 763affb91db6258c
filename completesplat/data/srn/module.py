"""Data module of ShapeNet-SRN, in the layout of pixelNeRF's archives `srn_cars.zip` and `srn_chairs.zip`.

An object has `intrinsics.txt`, `rgb/NNNNNN.png` and `pose/NNNNNN.txt`. Objects are rendered on white, without masks.
"""

import hashlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import ImageChops

from completesplat.data.loading.object_data_module import ObjectDataModule
from completesplat.data.loading.view_selection import Choice
from completesplat.data.packed.manifest import Scalar
from completesplat.data.placement import ObjectFraming, depths_around, square_of
from completesplat.data.sequences import MaskedImage, PosedSequence, SequenceSource, spread_places
from completesplat.data.splits import SPLITS
from completesplat.data.validation import finite_array, read_text, require_file, require_rotation
from completesplat.errors import BadAnnotation, BadCamera, ImageError, MissingFile, TooFewFrames, errors_at
from completesplat.geometry.cameras import Cameras, crop_resize
from completesplat.photo import files
from completesplat.quantities import Natural
from completesplat.tensors import stack

logger = logging.getLogger(__name__)

INTRINSICS = "intrinsics.txt"
DEEPER = "chairs_2.0_train"  # in the archive of chairs, the training objects lie in this folder
WHITE = 255


@dataclass(frozen=True)
class SRNObject:
    """Paths of one object's images and poses, in the order of their numbers."""

    folder: Path
    images: tuple[Path, ...]
    poses: tuple[Path, ...]


def list_object(folder: Path) -> SRNObject:
    """List an object's images and poses.

    Raises:
        BadAnnotation: the numbers of images are not those of the poses, or there are none.
    """
    images = tuple(sorted((folder / "rgb").glob("[!.]*.png")))
    poses = tuple(sorted((folder / "pose").glob("[!.]*.txt")))
    if not images or [path.stem for path in images] != [path.stem for path in poses]:
        counts = f"{len(images)} images in rgb, {len(poses)} poses in pose"
        raise BadAnnotation(f"{counts}; each image needs the pose of its number", str(folder))
    return SRNObject(folder, images, poses)


def read_intrinsics(path: Path) -> Cameras:
    """Read `intrinsics.txt`: focal length and principal point in the first line, height and width in the last.

    Returns:
        A camera at the origin (float64). Its field of view in the archives is 51.99 degrees, as in Splatter Image.

    Raises:
        BadAnnotation: the lines hold other numbers.
        BadCamera: focal length or size are not positive.
    """
    lines = read_text(path).split("\n")
    lines = [line for line in lines if line.strip()]
    if len(lines) < 2:
        raise BadAnnotation("needs a line `focal x y 0` and, as the last one, `height width`", str(path))
    with errors_at(path):
        focal, x, y, _ = finite_array(_numbers(lines[0]), (4,), "its first line").tolist()
        height, width = finite_array(_numbers(lines[-1]), (2,), "its last line").astype(int).tolist()
        if not (focal > 0 and height > 0 and width > 0):
            raise BadCamera(f"focal length {focal:g} and size {height} x {width} must be positive")
    intrinsics = torch.tensor([[focal, 0, x], [0, focal, y], [0, 0, 1]], dtype=torch.float64)
    return Cameras(torch.eye(4, dtype=torch.float64), intrinsics, (height, width))


def read_pose(path: Path) -> Float[torch.Tensor, "4 4"]:
    """Read a file of 16 numbers, camera to world in OpenCV's axes, and return world to camera (float64).

    Raises:
        BadAnnotation: it has other numbers.
        BadCamera: it is no rigid motion.
    """
    with errors_at(path):
        matrix = finite_array(_numbers(read_text(path)), (16,), "a pose").reshape(4, 4)
        require_rotation(matrix[:3, :3], "its rotation")
        return torch.from_numpy(np.linalg.inv(matrix))


def _numbers(text: str) -> list[float | str]:
    """Return the words of a text as numbers. A word that is none stays as it is, and is refused by `finite_array`."""
    numbers: list[float | str] = []
    for word in text.split():
        try:
            numbers.append(float(word))
        except ValueError:
            numbers.append(word)
    return numbers


def read_image(path: Path, camera: Cameras, framing: ObjectFraming) -> MaskedImage:
    """Read an image and its mask of all pixels that are not white.

    An image that this mask puts on white is unchanged. pixelNeRF's masks also leave out pixels of the object in which
    one channel is 255. An alpha channel is dropped, as pixelNeRF and Splatter Image do.

    Raises:
        BadImage: the image is damaged, or has another size than `intrinsics.txt` says.
    """
    with files.refused_as_bad(str(path)), files.decoded(path, str(path), files.FORMATS) as (stored, _):
        if stored.size != camera.image_size[::-1]:
            expected = f"{INTRINSICS} says {camera.image_size[0]} x {camera.image_size[1]}"
            raise ImageError(f"has {stored.height} x {stored.width} pixels, {expected}")
        image = stored.convert("RGB")
    red, green, blue = image.split()
    darkest = ImageChops.darker(ImageChops.darker(red, green), blue)
    mask = darkest.point([255] * WHITE + [0])
    return framing.cut(camera, image, mask)


class SRNSource(SequenceSource):
    """Objects of one split."""

    def __init__(self, folder: Path, framing: ObjectFraming) -> None:
        objects = {}
        for path in sorted(folder.glob(f"[!.]*/{INTRINSICS}")):
            objects[path.parent.name] = path.parent
        super().__init__(list(objects), len(objects), [], {})
        self.framing = framing
        self._objects = objects

    def fingerprint(self) -> str:
        """Return the SHA-256 of intrinsics and poses, not of the images."""
        digest = hashlib.sha256()
        for name in self.names:
            listed = list_object(self._objects[name])
            for path in (listed.folder / INTRINSICS, *listed.poses):
                digest.update(path.read_bytes())
        return digest.hexdigest()

    def read(self, name: str) -> PosedSequence:
        """Return an object's views in the units of its files, as Splatter Image uses them."""
        with errors_at(sequence=name):
            listed = list_object(self._objects[name])
            lens = read_intrinsics(listed.folder / INTRINSICS)
            cameras = [replace(lens, world_to_camera=read_pose(path)) for path in listed.poses]
        square = square_of(lens)
        size = self.framing.image_size
        squares = stack([crop_resize(camera, *square, size) for camera in cameras])
        ranges = depths_around(squares, torch.zeros(3, dtype=torch.float64), self.framing)
        numbers = tuple(range(len(cameras)))
        read = partial(_read, name, listed.images, lens, self.framing)
        photos = tuple(path.name for path in listed.images)
        return PosedSequence(name, numbers, squares, ranges, read, photos=photos)


def _read(name: str, images: tuple[Path, ...], lens: Cameras, framing: ObjectFraming, index: int) -> MaskedImage:
    with errors_at(sequence=name, frame=index):
        return read_image(require_file(images[index]), lens, framing)


class SRNDataModule(ObjectDataModule):
    """Scenes of one category of ShapeNet-SRN, with the archive's own splits.

    Units are those of the files, in which Splatter Image's published weights give their depths.

    Args:
        root: folder of the unpacked archive, with `CATEGORY_train`, `CATEGORY_val` and `CATEGORY_test`, or prepared
            objects.
        category: cars or chairs.
        reference: number of the view that is the input of validation and test; all others are targets, or at most
            `evaluation_targets` evenly spread ones.
        **settings: of `ObjectDataModule`. The depth range is around the origin, where the objects are.
    """

    def __init__(self, root: str, category: str, reference: Natural = 64, **settings: Any) -> None:
        super().__init__(root, **settings)
        self.category = category
        self.reference = reference

    def describe(self) -> dict[str, str | None]:
        described = {"data_set": "srn", "subset": self.category, "split": "the archive's own"}
        return described | self.described_views(f"view {self.reference}")

    def packed_settings(self) -> dict[str, Scalar]:
        return {"category": self.category, **self.framing._asdict()}

    def open(self, split: str) -> Mapping[str, SRNSource]:
        """List the objects of one split.

        For a test, the folder `CATEGORY_test` alone is enough. The other splits are then empty.

        Raises:
            MissingFile: there are no test objects, or neither objects of this split nor a folder of test objects.
        """
        source = SRNSource(self.folder_of(split), self.framing)
        if not source.names and (split == "test" or not self.folder_of("test").is_dir()):
            others = ", ".join(f"{self.category}_{other}" for other in SPLITS)
            where = "give the folder of the unpacked srn_cars.zip or srn_chairs.zip"
            raise MissingFile(f"no objects with {INTRINSICS}; {where}, which has {others}", str(self.folder_of(split)))
        return {split: source}

    def folder_of(self, split: str) -> Path:
        """Return the folder with the objects of one split."""
        folder = self.root / f"{self.category}_{split}"
        return folder / DEEPER if (folder / DEEPER).is_dir() else folder

    def evaluation_views(self, sequence: PosedSequence, split: str) -> Choice:
        """Return the view `reference` and others as targets; raise TooFewFrames if there is no such view."""
        count = len(sequence.frames)
        if count <= self.reference:
            missing = f"{count} views, so there is no view {self.reference} (data.reference)"
            raise TooFewFrames(missing, sequence=sequence.name)
        others = [view for view in range(count) if view != self.reference]
        targets = [others[place] for place in spread_places(len(others), self.views.targets_of(split))]
        return self.reference, targets
