"""What a packed store says of itself: `manifest.json`, written last."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from completesplat.atomic import atomic_path
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
from completesplat.errors import DataError

FORMAT = 2
MANIFEST = "manifest.json"

Scalar = str | int | float | bool | None


@dataclass(frozen=True)
class Refusal:
    """A sequence, or a frame of one, that is not in the store."""

    kind: str
    reason: str
    file: str | None
    sequence: str | None
    frame: int | None

    @staticmethod
    def of(error: DataError) -> "Refusal":
        """What a refusal says, without the exception."""
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
    """The part of a store that one source was made into.

    Attributes:
        listed: how many sequences the source's list has, usable or not.
        names: those that are here, in the order of the source.
    """

    fingerprint: str
    listed: int
    names: tuple[str, ...]
    shards: tuple[Shard, ...]
    refused: tuple[Refusal, ...]
    left_out: dict[str, int]


@dataclass(frozen=True)
class PackedManifest:
    """A whole store; `settings` are what was baked into its pictures and cameras."""

    root: Path
    codec: str
    settings: dict[str, Scalar]
    splits: dict[str, Split]


def is_packed(root: Path) -> bool:
    """Whether a folder holds a complete packed store."""
    return (root / MANIFEST).is_file()


def read_manifest(root: Path) -> PackedManifest:
    """The manifest of a store.

    Raises:
        DataError: it is missing, no JSON, of another version of the format, incomplete, or names files elsewhere.
    """
    path = root / MANIFEST
    with at(file=path):
        content = read_json(path)
        check_format(content, FORMAT, "prepare the data again")
        splits = field(content, "splits", dict)
        settings = field(content, "settings", dict)
        if not all(value is None or isinstance(value, str | int | float) for value in settings.values()):
            raise BadAnnotation("settings must be plain values")
        return PackedManifest(
            root,
            field(content, "codec", str),
            settings,
            {name: _split(root, field(splits, name, dict)) for name in splits},
        )


def write_manifest(manifest: PackedManifest) -> None:
    """`manifest.json` in the store's folder, there as a whole or not at all."""
    content = asdict(manifest)
    del content["root"]
    write_json(manifest.root / MANIFEST, {"format": FORMAT, **content})


def check_format(content: object, readable: int, remedy: str) -> None:
    """Refuse a manifest of another version of its format.

    Raises:
        UnreadableFile: of another version.
        BadAnnotation: it does not say of which.
    """
    found = field(content, "format", int)
    if found != readable:
        raise UnreadableFile(f"format {found}, this version reads {readable}: {remedy}")


def write_json(path: Path, content: object) -> None:
    """A JSON file that is there as a whole or not at all."""
    with atomic_path(path) as unfinished:
        unfinished.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")


def settings_must_match(manifest: PackedManifest, settings: Mapping[str, Scalar]) -> None:
    """Refuse a store that was made with other settings than these.

    Raises:
        DataError: names every setting that differs.
    """
    differing = differences(manifest.settings, settings)
    if differing:
        raise DataError(
            f"prepared with {differing}: set these as they were, or prepare the data again into another folder",
            str(manifest.root),
        )


def differences(found: Mapping[str, Scalar], wanted: Mapping[str, Scalar]) -> str:
    """`image_size=128 (asked for: 64), ...` for all settings that differ."""
    # JSON makes no difference between 1 and 1.0, nor does anything that the settings are used for.
    keys = [key for key in sorted({*found, *wanted}) if found.get(key) != wanted.get(key)]
    return ", ".join(f"{key}={found.get(key)} (asked for: {wanted.get(key)})" for key in keys)


def shard_from_json(root: Path, entry: object) -> Shard:
    """A shard's entry in the manifest or in its record.

    Raises:
        DataError: malformed, or its file lies elsewhere.
    """
    file = field(entry, "file", str)
    inside(root, file)
    size, frames = field(entry, "bytes", int), field(entry, "frames", int)
    return Shard(file, field(entry, "sha256", str), size, frames, list_field(entry, "sequences", str))


def refusal_from_json(entry: object) -> Refusal:
    """A refusal's entry.

    Raises:
        BadAnnotation: malformed.
    """
    return Refusal(
        field(entry, "kind", str),
        field(entry, "reason", str),
        optional_field(entry, "file", str),
        optional_field(entry, "sequence", str),
        optional_field(entry, "frame", int),
    )


def _split(root: Path, entry: dict[str, Any]) -> Split:
    names = list_field(entry, "names", str)
    shards = tuple(shard_from_json(root, shard) for shard in field(entry, "shards", list))
    if len(set(names)) < len(names) or sorted(name for shard in shards for name in shard.sequences) != sorted(names):
        raise BadAnnotation("the names of a split are not those of its shards")
    refused = tuple(refusal_from_json(refusal) for refusal in field(entry, "refused", list))
    left_out = field(entry, "left_out", dict)
    return Split(
        field(entry, "fingerprint", str),
        field(entry, "listed", int),
        names,
        shards,
        refused,
        {key: field(left_out, key, int) for key in left_out},
    )
