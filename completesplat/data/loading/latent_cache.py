"""Latent cache on disk: it is written row by row, read memory-mapped, and used as a training set."""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import reduce
from hashlib import sha256
from pathlib import Path
from types import TracebackType
from zlib import crc32

import numpy as np
import torch
from jaxtyping import Shaped

from completesplat.data.loading.augmentation import BoxMasks
from completesplat.data.loading.scenes import TrainingScenes
from completesplat.data.packed.manifest import MANIFEST, Scalar, differences, read_as
from completesplat.data.sequences import SequenceSource
from completesplat.data.validation import ChangedFile, MissingFile, UnreadableFile, at, inside, require_file
from completesplat.errors import CompleteSplatError, DataError
from completesplat.files import write_text, writing
from completesplat.scene import CachedScene
from completesplat.weights import sha256_of

HEADER: dict[str, str | int] = {"format": 4, "kind": "latent_cache"}
ARRAYS = ("mean", "log_variance", "condition")
CHECKSUMS = "checksum"
"""Name of the array with the CRC-32 of each row of the others. A row is checked when it is read, because the files may
have hundreds of gigabytes and each process opens them. This array and the manifest are checked when they are opened."""
NO_SUM = "0" * 64


@dataclass(frozen=True)
class Array:
    """One `.npy` file, whose first axis has one row for each encoded image."""

    file: str
    dtype: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class CachedSequence:
    """Rows of one sequence, which start at `first`, one for each of the frames `stored` (indices in the sequence)."""

    name: str
    frames: int
    first: int
    stored: tuple[int, ...]


@dataclass(frozen=True)
class Origin:
    """Inputs that determine the content of a store."""

    encoder: str  # a fingerprint, as are the next two
    conditioning: str | None  # of the frozen conditioning whose features are stored; None: images are stored
    data: str
    settings: dict[str, Scalar]  # of the data module: those that determine images and splits
    image_size: int
    frames: int | None  # largest number of evenly spaced frames of a sequence; None: all frames
    views: int  # other views that the posterior sees; 0: it sees the reference only
    precision: str


@dataclass(frozen=True)
class LatentCacheManifest:
    """Manifest of a store, with the sequences of the training set in order, and mean and std of latents by channel.

    `checksums` is the SHA-256 of the array of checksums. `sha256` is that of the manifest with zeros in its place.
    """

    version: str
    origin: Origin
    mean: tuple[float, ...]
    std: tuple[float, ...]
    arrays: dict[str, Array]
    sequences: tuple[CachedSequence, ...]
    checksums: str
    sha256: str = NO_SUM


def write_manifest(root: Path, manifest: LatentCacheManifest) -> None:
    """Write the manifest, which marks the store as finished."""
    text = json.dumps({**HEADER, **asdict(manifest)}, indent=2, allow_nan=False) + "\n"
    write_text(root / MANIFEST, text.replace(NO_SUM, sha256(text.encode()).hexdigest()))


def row_checksums(rows: Mapping[str, Shaped[np.ndarray, "row _ _ _"]]) -> Shaped[np.ndarray, "row 1 1 1"]:
    """Return one CRC-32 for each row, computed over all arrays in order."""
    content = zip(*(rows[name] for name in ARRAYS), strict=True)
    sums = [reduce(lambda value, part: crc32(part.tobytes(), value), parts, 0) for parts in content]
    return np.array(sums, dtype=np.uint32).reshape(-1, 1, 1, 1)


class ArrayWriter:
    """Context manager that appends rows of the shape `row` to a file, and writes their number into its header at exit.

    After an exception, such as a DiskError because the disk is full, the file is removed.
    """

    def __init__(self, path: Path, row: tuple[int, ...], dtype: str) -> None:
        self.path = path
        self.row = row
        self.dtype = np.dtype(dtype)
        self.count = 0

    def __enter__(self) -> "ArrayWriter":
        with writing(self.path):
            self.path.unlink(missing_ok=True)  # it may be a link
            self._file = self.path.open("wb")
            self._begin = self._write_header()
        return self

    def append(self, rows: Shaped[np.ndarray, "_ _ _ _"]) -> None:
        """Append rows of the writer's dtype."""
        assert (rows.shape[1:], rows.dtype) == (self.row, self.dtype)
        self.count += len(rows)
        with writing(self.path):
            self._file.write(np.ascontiguousarray(rows).data)

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        whole = False
        try:
            with writing(self.path), self._file:
                self._file.seek(0)
                # The header keeps its size, because NumPy pads it for a first axis of any length.
                assert self._write_header() == self._begin
                self._file.flush()
                os.fsync(self._file.fileno())
            whole = error is None
        finally:
            if not whole:
                self.path.unlink(missing_ok=True)

    def _write_header(self) -> int:
        header = {"descr": self.dtype.str, "fortran_order": False, "shape": (self.count, *self.row)}
        np.lib.format.write_array_header_1_0(self._file, header)
        return self._file.tell()

    def described(self) -> Array:
        """Return the manifest's entry of this array."""
        return Array(self.path.name, self.dtype.name, (self.count, *self.row))


def open_array(root: Path, array: Array) -> np.memmap:
    """Map a stored array into memory without reading it, after checking its shape, dtype and length."""
    with at(file=root / MANIFEST):
        path = inside(root, array.file)
    with at(file=require_file(path)):
        try:
            mapped = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, EOFError, OSError) as error:
            raise UnreadableFile(f"damaged or no NumPy array: encode the images again ({error})") from None
        if not isinstance(mapped, np.memmap) or mapped.shape != array.shape or mapped.dtype != np.dtype(array.dtype):
            raise ChangedFile("not the array that the manifest describes: encode the images again")
        if path.stat().st_size != mapped.offset + mapped.nbytes:
            raise ChangedFile("longer than it was written: encode the images again")
        return mapped


class LatentCache:
    """Latent cache of a training set, open for reading.

    `mean` and `std` are statistics by channel of latents drawn from the posteriors of all stored frames.
    `arrays` are memory-mapped and have one row for each image.

    Raises:
        DataError: the store is unfinished or damaged.
    """

    def __init__(self, folder: Path) -> None:
        if not (folder / MANIFEST).is_file():
            raise MissingFile("no finished latent cache: completesplat data latents makes one", str(folder))
        self.folder = folder
        self.manifest = read_as(LatentCacheManifest, folder / MANIFEST, HEADER, "encode the images again")
        text, digest = (folder / MANIFEST).read_text(), self.manifest.sha256
        if sha256(text.replace(digest, NO_SUM).encode()).hexdigest() != digest:
            raise ChangedFile("its checksum is another: encode the images again", str(folder / MANIFEST))
        self.origin = self.manifest.origin
        self.mean, self.std = self.manifest.mean, self.manifest.std
        self.arrays = {name: open_array(folder, array) for name, array in self.manifest.arrays.items()}
        checksums = folder / self.manifest.arrays[CHECKSUMS].file
        if sha256_of(checksums) != self.manifest.checksums:
            raise ChangedFile("its checksum is another: encode the images again", str(checksums))
        self.sequences = {sequence.name: sequence for sequence in self.manifest.sequences}
        self.holds_images = self.origin.conditioning is None  # rather than features

    def scene(self, name: str, frame: int) -> CachedScene:
        """Return the frame with this index in a sequence, without batch axis, in float32.

        Raises:
            DataError: the frame was not encoded, or its rows differ from their checksum.
        """
        sequence = self.sequences[name]
        if frame not in sequence.stored:
            raise DataError("was not encoded", str(self.folder), name, frame)
        row = sequence.first + sequence.stored.index(frame)
        rows = {name: np.array(array[row : row + 1]) for name, array in self.arrays.items()}
        if row_checksums(rows) != rows[CHECKSUMS]:
            raise ChangedFile("its checksum is another: encode the images again", str(self.folder), name, frame)
        mean, log_variance, condition = (torch.from_numpy(rows[array][0].astype(np.float32)) for array in ARRAYS)
        if self.holds_images:
            # The same division as for images that are read from the data set, for bitwise equal results.
            condition = torch.from_numpy(np.divide(rows["condition"][0], 255, dtype=np.float32))
        return CachedScene(mean, log_variance, condition, torch.tensor(frame), name)

    def must_belong_to(self, source: SequenceSource, settings: dict[str, Scalar]) -> None:
        """Refuse a store that was made with other settings or from another data set."""
        if differing := differences(self.origin.settings, settings):
            raise DataError(f"encoded with {differing}: set these as they were, or encode again", str(self.folder))
        if self.origin.data != source.fingerprint() or list(self.sequences) != source.names:
            raise DataError("made from other data than the training set now: encode it again", str(self.folder))

    def __reduce__(self) -> tuple[type["LatentCache"], tuple[Path]]:
        # Worker processes map the files themselves, because pickling an array would copy all of it.
        return LatentCache, (self.folder,)


@dataclass(eq=False)
class CachedTrainingScenes(TrainingScenes):
    """Items of `TrainingScenes` without targets, with the same sequence and reference frame for (seed, epoch, index).

    If only some frames of a sequence were encoded, the nearest one (the earlier of two) replaces the reference frame.
    `store` determines the order of items; its images are not read. Box masks hide parts of images as in `augment`.

    Raises:
        CompleteSplatError: there are box masks, but the store holds features instead of images.
    """

    cache: LatentCache
    box_masks: BoxMasks | None

    def __post_init__(self) -> None:
        if self.box_masks is not None and not self.cache.holds_images:
            raise CompleteSplatError(
                "data.box_masks cannot hide parts of encoded features: use data.latent_cache=null, or encode images"
            )

    def draw(self, name: str, epoch: int, rng: np.random.Generator) -> CachedScene:
        """Draw a random reference frame of the sequence `name` and return its encoding."""
        sequence = self.cache.sequences[name]
        reference, _ = self.choose(sequence.frames, epoch, rng)
        stored = np.array(sequence.stored)
        scene = self.cache.scene(name, int(stored[np.abs(stored - reference).argmin()]))
        if self.box_masks is None:
            return scene
        boxes_rng = rng.spawn(3)[2]  # the third, as in `augment`
        height, width = scene.condition.shape[-2:]
        visible = self.box_masks(height, width, boxes_rng)
        return replace(scene, condition=scene.condition * visible)
