"""What a latent cache says of itself: `manifest.json`, written last, so that only a finished one opens."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from completesplat.data.packed.manifest import MANIFEST, Scalar, check_format, write_json
from completesplat.data.validation import (
    BadAnnotation,
    UnreadableFile,
    at,
    field,
    inside,
    list_field,
    optional_field,
    read_json,
)

FORMAT = 2
ARRAYS = ("mean", "log_variance", "condition")
DTYPES = ("float32", "float16", "uint8")


@dataclass(frozen=True)
class Array:
    """One `.npy` file; its first axis is the store's rows, one for each encoded picture."""

    file: str
    dtype: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class CachedSequence:
    """The rows of one sequence: from `first` on, one for each of the frames `stored` (places in the sequence)."""

    name: str
    frames: int
    first: int
    stored: tuple[int, ...]


@dataclass(frozen=True)
class Origin:
    """What a store was made from. Another store with the same origin would hold the same.

    Attributes:
        encoder: fingerprint of the autoreconstructor's encoder.
        conditioning: fingerprint of the frozen conditioning whose features are stored; None: pictures are.
        data: fingerprint of the training set.
        settings: of the data module: what pictures and splits depend on.
        image_size: side of the pictures that were encoded.
        frames: the largest number of frames of a sequence, evenly spaced; None: all.
        precision: in which means, log-variances and features are stored.
    """

    encoder: str
    conditioning: str | None
    data: str
    settings: dict[str, Scalar]
    image_size: int
    frames: int | None
    precision: str


@dataclass(frozen=True)
class LatentCacheManifest:
    """A whole store; `sequences` are those of the training set, in its order; `scale` is 1 / std of a latent."""

    version: str
    origin: Origin
    scale: float
    arrays: dict[str, Array]
    sequences: tuple[CachedSequence, ...]


def is_latent_cache(root: Path) -> bool:
    """Whether a folder holds a finished store."""
    return (root / MANIFEST).is_file()


def write_manifest(root: Path, manifest: LatentCacheManifest) -> None:
    """`manifest.json` in the store's folder, there as a whole or not at all."""
    write_json(root / MANIFEST, {"format": FORMAT, "kind": "latent_cache", **asdict(manifest)})


def read_manifest(root: Path) -> LatentCacheManifest:
    """The manifest of a store.

    Raises:
        DataError: missing, damaged, of another version of the format, or not that of a latent cache.
    """
    path = root / MANIFEST
    with at(file=path):
        content = read_json(path)
        if field(content, "kind", str) != "latent_cache":
            raise UnreadableFile("no latent cache: completesplat data latents makes one")
        check_format(content, FORMAT, "encode the pictures again")
        arrays = field(content, "arrays", dict)
        manifest = LatentCacheManifest(
            field(content, "version", str),
            _origin(field(content, "origin", dict)),
            field(content, "scale", float),
            {name: _array(root, field(arrays, name, dict)) for name in ARRAYS},
            tuple(_sequence(entry) for entry in field(content, "sequences", list)),
        )
        _check(manifest)
        return manifest


def _origin(entry: Mapping[str, Any]) -> Origin:
    return Origin(
        field(entry, "encoder", str),
        optional_field(entry, "conditioning", str),
        field(entry, "data", str),
        field(entry, "settings", dict),
        field(entry, "image_size", int),
        optional_field(entry, "frames", int),
        field(entry, "precision", str),
    )


def _array(root: Path, entry: Mapping[str, Any]) -> Array:
    file, dtype = field(entry, "file", str), field(entry, "dtype", str)
    inside(root, file)
    if dtype not in DTYPES:
        raise BadAnnotation(f"dtype must be one of {', '.join(DTYPES)}, not {dtype}")
    return Array(file, dtype, list_field(entry, "shape", int))


def _sequence(entry: object) -> CachedSequence:
    frames, stored = field(entry, "frames", int), list_field(entry, "stored", int)
    # Strictly increasing from 0 on and below `frames`.
    if not stored or any(b <= a for a, b in pairwise((-1, *stored, frames))):
        raise BadAnnotation("stored frames must be places in the sequence, in order")
    return CachedSequence(field(entry, "name", str), frames, field(entry, "first", int), stored)


def _check(manifest: LatentCacheManifest) -> None:
    """Refuse what cannot be true of a store, whatever its arrays hold."""
    rows = sum(len(sequence.stored) for sequence in manifest.sequences)
    if any(len(array.shape) != 4 or array.shape[0] != rows for array in manifest.arrays.values()):
        raise BadAnnotation(f"arrays of other shapes than {rows} x channels x height x width")
    if manifest.arrays["mean"].shape != manifest.arrays["log_variance"].shape:
        raise BadAnnotation("means and log-variances of different shapes")
    if not all(0 <= s.first <= rows - len(s.stored) for s in manifest.sequences):
        raise BadAnnotation("rows outside of the arrays")
    if len({sequence.name for sequence in manifest.sequences}) < len(manifest.sequences):
        raise BadAnnotation("two sequences of one name")
    if not manifest.scale > 0:
        raise BadAnnotation(f"scale must be above 0, not {manifest.scale}")
