"""Latent cache on disk: an Arrow file as in a packed store, with one row for each sequence, used as a training set."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from zlib import crc32

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Shaped, UInt32

from completesplat.data.loading.scenes import TrainingScenes
from completesplat.data.packed.manifest import MANIFEST, Scalar, differences, read_as
from completesplat.data.packed.preparation import UNFINISHED
from completesplat.data.packed.shards import OpenShard, refused_as_damaged
from completesplat.data.sequences import SequenceSource
from completesplat.data.validation import require_file
from completesplat.errors import (
    BadAnnotation,
    ChangedFile,
    CompleteSplatError,
    DataError,
    MissingFile,
    errors_at,
)
from completesplat.files import atomic_path, write_text
from completesplat.scene import CachedScene
from completesplat.version import __version__

HEADER: dict[str, str | int] = {"format": 5, "kind": "latent_cache"}
Rows = dict[str, Shaped[np.ndarray, "frame ..."]]
Sums = Float[np.ndarray, "3 channel"]
PRECISIONS = {"float32": pa.float32(), "float16": pa.float16()}
FILE = "latents.arrow"
ARRAYS = ("mean", "log_variance", "condition")
CHECKSUMS = "checksums"
"""Name of the column with the CRC-32 of each frame. A frame is checked when it is read, because the file may have
hundreds of gigabytes and each process opens it. The manifest is checked when it is opened."""
NO_SUM = "0" * 64
ADVICE = "encode the images again"


@dataclass(frozen=True)
class CachedSequence:
    """Row of one sequence, with values for each of the frames `stored` (indices in the sequence)."""

    name: str
    frames: int
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

    def __post_init__(self) -> None:
        if self.precision not in PRECISIONS:
            raise BadAnnotation(f"precision must be one of {', '.join(PRECISIONS)}")


@dataclass(frozen=True)
class LatentCacheManifest:
    """Manifest of a store, with the sequences of the training set in order, and mean and std of latents by channel.

    `shapes` are those of one frame's values. `sha256` is that of the manifest with zeros in its place.
    """

    version: str
    origin: Origin
    mean: tuple[float, ...]
    std: tuple[float, ...]
    shapes: dict[str, tuple[int, ...]]
    sequences: tuple[CachedSequence, ...]
    bytes: int
    sha256: str = NO_SUM


def latent_schema(origin: Origin) -> pa.Schema:
    """Return the columns of a store. Each has one list for each sequence, of the values of all its stored frames."""
    encodings = pa.large_list(PRECISIONS[origin.precision])
    conditions = pa.large_list(pa.uint8()) if origin.conditioning is None else encodings
    return pa.schema(
        {
            "name": pa.string(),
            "mean": encodings,
            "log_variance": encodings,
            "condition": conditions,
            CHECKSUMS: pa.large_list(pa.uint32()),
        }
    )


def frame_checksums(rows: Rows) -> UInt32[np.ndarray, " frame"]:
    """Return one CRC-32 for each frame, computed over all arrays in order."""
    checksums = np.zeros(len(rows[ARRAYS[0]]), np.uint32)
    for frame in range(len(checksums)):
        for array in ARRAYS:
            checksums[frame] = crc32(rows[array][frame].tobytes(), checksums[frame])
    return checksums


def moments(sums: Sums) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return mean and standard deviation of each channel, where Var[h] = E[mean^2] + E[variance] - E[mean]^2."""
    count, total, squares = sums
    mean = total / count
    return tuple(mean.tolist()), tuple(np.sqrt(squares / count - np.square(mean)).tolist())


def write_cache(
    folder: Path, origin: Origin, batches: Iterable[tuple[Rows, Sums]], sequences: Sequence[CachedSequence]
) -> None:
    """Write the rows of all sequences, then the manifest, which marks the store as finished.

    Args:
        batches: at least one batch of the sequences' stored frames, in their order, each with its moment sums.
    """
    total = np.zeros(())
    written = 0
    schema = latent_schema(origin)
    waiting = Rows()
    with (
        atomic_path(folder / FILE, f"{FILE}{UNFINISHED}") as unfinished,
        unfinished.open("wb") as file,
        pa.ipc.new_stream(file, schema) as writer,
    ):
        for rows, sums in batches:
            total = total + sums
            waiting = {name: np.concatenate([waiting.get(name, x[:0]), x]) for name, x in rows.items()}
            for sequence in sequences[written:]:
                count = len(sequence.stored)
                if len(waiting["mean"]) < count:
                    break
                complete = {name: np.ascontiguousarray(values[:count]) for name, values in waiting.items()}
                writer.write_batch(_record_batch(sequence.name, complete, schema))
                waiting = {name: values[count:] for name, values in waiting.items()}
                written += 1
    mean, std = moments(total)
    manifest = LatentCacheManifest(
        version=__version__,
        origin=origin,
        mean=mean,
        std=std,
        shapes={name: rows.shape[1:] for name, rows in waiting.items()},
        sequences=tuple(sequences),
        bytes=(folder / FILE).stat().st_size,
    )
    text = json.dumps({**HEADER, **asdict(manifest)}, indent=2, allow_nan=False) + "\n"
    write_text(folder / MANIFEST, text.replace(NO_SUM, sha256(text.encode()).hexdigest()))


def _record_batch(name: str, rows: Rows, schema: pa.Schema) -> pa.RecordBatch:
    """Return the row of a sequence with the values of all its stored frames."""
    columns = [rows[array].reshape(-1) for array in ARRAYS]
    columns.append(frame_checksums(rows))
    arrays = [pa.array([name])]
    for values in columns:
        offsets = pa.array([0, len(values)], pa.int64())
        arrays.append(pa.LargeListArray.from_arrays(offsets, pa.array(values)))
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


class LatentCache:
    """Latent cache of a training set, open for reading.

    `mean` and `std` are statistics by channel of latents drawn from the posteriors of all stored frames.
    The file is memory-mapped.

    Raises:
        DataError: the store is unfinished or damaged.
    """

    def __init__(self, folder: Path) -> None:
        if not (folder / MANIFEST).is_file():
            raise MissingFile("no finished latent cache: completesplat data latents makes one", str(folder))
        self.folder = folder
        self.manifest = read_as(LatentCacheManifest, folder / MANIFEST, HEADER, ADVICE)
        text = (folder / MANIFEST).read_text()
        digest = self.manifest.sha256
        if sha256(text.replace(digest, NO_SUM).encode()).hexdigest() != digest:
            raise ChangedFile(f"its checksum is another: {ADVICE}", str(folder / MANIFEST))
        self.origin = self.manifest.origin
        self.mean = self.manifest.mean
        self.std = self.manifest.std
        self.sequences = {sequence.name: sequence for sequence in self.manifest.sequences}
        self._places = {name: place for place, name in enumerate(self.sequences)}
        with errors_at(file=require_file(folder / FILE)):
            if (folder / FILE).stat().st_size != self.manifest.bytes:
                raise ChangedFile(f"another size than it was written with: {ADVICE}")
            self._rows = OpenShard(folder / FILE, f": {ADVICE}")
            columns = latent_schema(self.origin)
            if not self._rows.schema.equals(columns) or len(self._rows.places) != len(self._places):
                raise ChangedFile(f"not what the manifest describes: {ADVICE}")
        self.holds_images = self.origin.conditioning is None  # rather than features

    def scene(self, name: str, frame: int) -> CachedScene:
        """Return the frame with this index in a sequence, without batch axis, in float32.

        Raises:
            DataError: the frame was not encoded, or its rows differ from their checksum.
        """
        sequence = self.sequences[name]
        if frame not in sequence.stored:
            raise DataError("was not encoded", str(self.folder), name, frame)
        place = sequence.stored.index(frame)
        rows = {column: np.array(array[place : place + 1]) for column, array in self.arrays(name).items()}
        if frame_checksums(rows) != rows[CHECKSUMS]:
            raise ChangedFile(f"its checksum is another: {ADVICE}", str(self.folder), name, frame)
        mean = torch.from_numpy(rows["mean"][0].astype(np.float32))
        log_variance = torch.from_numpy(rows["log_variance"][0].astype(np.float32))
        # An image is divided as one that is read from the data set, for bitwise equal results.
        scale = 255 if self.holds_images else 1
        condition = torch.from_numpy(np.divide(rows["condition"][0], scale, dtype=np.float32))
        return CachedScene(mean, log_variance, condition, torch.tensor(frame), name)

    def arrays(self, name: str) -> Rows:
        """Return the values of all stored frames of a sequence, and their checksums, as they are in the file.

        Raises:
            DataError: the row is damaged or of another sequence.
        """
        with errors_at(file=self.folder / FILE, sequence=name):
            count = len(self.sequences[name].stored)
            shapes = {**self.manifest.shapes, CHECKSUMS: ()}
            with refused_as_damaged(f": {ADVICE}"):
                row = self._rows[self._places[name]]
                arrays = {}
                for column in (*ARRAYS, CHECKSUMS):
                    values = row.column(column)[0].values.to_numpy()
                    arrays[column] = values.reshape(count, *shapes[column])
                stored_name = row.column("name")[0].as_py()
            if stored_name != name:
                raise ChangedFile(f"another sequence is in its place: {ADVICE}")
            return arrays

    def must_belong_to(self, source: SequenceSource, settings: Mapping[str, Scalar]) -> None:
        """Refuse a store that was made with other settings or from another data set."""
        differing = differences(self.origin.settings, settings)
        if differing:
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
    `store` determines the order of items; its images are not read. Box masks hide parts of images as in `Augmentation`.

    Raises:
        CompleteSplatError: there are box masks, but the store holds features instead of images.
    """

    cache: LatentCache

    def __post_init__(self) -> None:
        if self.augmentation.box_masks is not None and not self.cache.holds_images:
            advice = "use data.latent_cache=null, or encode images"
            raise CompleteSplatError(f"data.box_masks cannot hide parts of encoded features: {advice}")

    def draw(self, name: str, epoch: int, rng: np.random.Generator) -> CachedScene:
        """Draw a random reference frame of the sequence `name` and return its encoding."""
        sequence = self.cache.sequences[name]
        reference, _ = self.views(sequence.frames, epoch, rng)
        stored = np.array(sequence.stored)
        scene = self.cache.scene(name, int(stored[np.abs(stored - reference).argmin()]))
        box_masks = self.augmentation.box_masks
        if box_masks is None:
            return scene
        boxes_rng = rng.spawn(3)[2]  # the third, as in `Augmentation`
        height, width = scene.condition.shape[-2:]
        visible = box_masks(height, width, boxes_rng)
        return replace(scene, condition=scene.condition * visible)
