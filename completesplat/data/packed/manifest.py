"""Manifest of a packed store, `manifest.json`, which is written last."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from completesplat.data.validation import field, parsed, read_json
from completesplat.errors import BadAnnotation, DataError, UnreadableFile, errors_at

MANIFEST = "manifest.json"
FORMAT = 2
HEADER = {"format": FORMAT}

Scalar = str | int | float | bool | None
T = TypeVar("T")


@dataclass(frozen=True)
class Refusal:
    """Record of a sequence or a frame that is not in the store because it could not be read."""

    kind: str
    reason: str
    file: str | None
    sequence: str | None
    frame: int | None

    @staticmethod
    def of(error: DataError) -> "Refusal":
        """Return the record of an error."""
        return Refusal(error.kind, error.reason, error.file, error.sequence, error.frame)


@dataclass(frozen=True)
class Shard:
    """One Arrow file and the sequences in it, in the order of its rows."""

    file: str
    sha256: str
    bytes: int
    frames: int
    sequences: tuple[str, ...]


@dataclass(frozen=True)
class Split:
    """Split of a store, made from one source.

    Attributes:
        listed: number of sequences in the source's list, usable or not.
        names: stored sequences, in the order of the source.
    """

    fingerprint: str
    listed: int
    names: tuple[str, ...]
    shards: tuple[Shard, ...]
    refused: tuple[Refusal, ...]
    left_out: dict[str, int]

    def __post_init__(self) -> None:
        stored = sorted(name for shard in self.shards for name in shard.sequences)
        if len(set(self.names)) < len(self.names) or stored != sorted(self.names):
            raise BadAnnotation("the names of a split are not those of its shards")


@dataclass(frozen=True)
class PackedManifest:
    """Manifest of a whole store. Its images and cameras depend on `settings`."""

    codec: str
    settings: dict[str, Scalar]
    splits: dict[str, Split]


def is_packed(root: Path) -> bool:
    """Return whether a folder holds a complete packed store."""
    return (root / MANIFEST).is_file()


def read_manifest(root: Path) -> PackedManifest:
    """Read the manifest of a store, with the errors of `read_as`."""
    return read_as(PackedManifest, root / MANIFEST, HEADER, "prepare the data again")


def read_as(kind: type[T], path: Path, header: Mapping[str, str | int], remedy: str) -> T:
    """Read a JSON file that starts with `header` into a dataclass.

    Raises:
        DataError: the file is missing, no JSON or incomplete, or has another header (the message has the `remedy`).
    """
    with errors_at(file=path):
        content = read_json(path)
        for key, readable in header.items():
            stored = field(content, key, type(readable))
            if stored != readable:
                raise UnreadableFile(f"{key} {stored}, this version reads {readable}: {remedy}")
        return parsed(kind, content)


def settings_must_match(root: Path, settings: Mapping[str, Scalar]) -> None:
    """Refuse a store that was made with other settings, or whose images are smaller than requested.

    Raises:
        DataError: settings differ; the message names each of them.
    """
    stored = read_manifest(root).settings
    wanted = dict(settings)
    stored_size = stored.get("image_size")
    wanted_size = wanted.get("image_size")
    if isinstance(stored_size, int) and isinstance(wanted_size, int) and stored_size > wanted_size:
        wanted["image_size"] = stored_size  # larger images are reduced when they are read
    differing = differences(stored, wanted)
    if differing:
        advice = "set these as they were, or prepare the data again into another folder"
        raise DataError(f"prepared with {differing}: {advice}", str(root))


def differences(stored: Mapping[str, Scalar], wanted: Mapping[str, Scalar]) -> str:
    """Return `image_size=128 (asked for: 64), ...` for all settings that differ."""
    # 1 and 1.0 are equal, because neither JSON nor any use of the settings distinguishes them.
    keys = [key for key in sorted({*stored, *wanted}) if stored.get(key) != wanted.get(key)]
    return ", ".join(f"{key}={stored.get(key)} (asked for: {wanted.get(key)})" for key in keys)
