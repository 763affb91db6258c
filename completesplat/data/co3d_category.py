"""Which sequences and frames of a CO3D category are taken, and for which split."""

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from completesplat.data.checks import BadAnnotation, Refuse, inside
from completesplat.data.co3d_annotations import CO3DFrame, CO3DVideo, read_frames, read_videos
from completesplat.data.co3d_splits import (
    SeededSplit,
    kept_apart,
    read_set_list,
    set_list_path,
    split_by_seed,
)
from completesplat.data.sequences import SPLITS
from completesplat.errors import DataError


@dataclass(frozen=True)
class Filters:
    """Which sequences are taken, of those that are not broken.

    Attributes:
        min_frames: with fewer in a split, a sequence is left out of it.
        min_viewpoint_quality, min_point_cloud_quality: CO3D's scores; None: any. Where one is asked for, a sequence
            without the score is left out.
        most_training_sequences: those with the best viewpoint quality (DFM takes 500); None: all.
    """

    min_frames: int = 2
    min_viewpoint_quality: float | None = None
    min_point_cloud_quality: float | None = None
    most_training_sequences: int | None = None


@dataclass(frozen=True)
class SplitMembers:
    """What one split is made of, by sequence.

    Attributes:
        listed: how many sequences the split has by its list, usable or not.
        frames: those of the split, in order.
        captured: all frames of the same sequences, also those of other splits: they tell which way is up.
        left_out: names of sequences, by reason.
    """

    listed: int = 0
    frames: dict[str, list[CO3DFrame]] = field(default_factory=dict)
    captured: dict[str, list[CO3DFrame]] = field(default_factory=dict)
    point_clouds: dict[str, Path | None] = field(default_factory=dict)
    left_out: dict[str, list[str]] = field(default_factory=dict)


class Category(NamedTuple):
    """The splits, the files that say so, and what was found broken."""

    splits: dict[str, SplitMembers]
    files: list[Path]
    refused: list[DataError]


def read_category(
    root: Path, category: str, subset: str | None, seeded: SeededSplit, filters: Filters, allow_shared: bool = False
) -> Category:
    """The sequences of a category, their frames divided as the set list `subset` says, or else by seed.

    Frames that the set list does not name are not looked at.

    Args:
        allow_shared: take the set list as it is, also where a sequence is in several of its parts; else see
            `kept_apart`.

    Raises:
        DataError: the category, its annotations or its set list is missing, unreadable as a whole, or not below
            `root`; or training sequences are tested.
    """
    folder = inside(root, category)
    if not os.path.isdir(folder):
        raise DataError("no such CO3D category", str(folder))
    frames_file, videos_file = folder / "frame_annotations.jgz", folder / "sequence_annotations.jgz"
    set_list, refused = set_list_path(folder, subset), list[DataError]()
    refuse: Refuse = refused.append
    listed, lost = read_set_list(set_list, refuse) if set_list else None, list[str]()
    if set_list and listed is not None and not allow_shared:
        listed, lost = kept_apart(set_list, listed, seeded)
    wanted = set().union(*listed.values()) if listed is not None else None
    videos = read_videos(root, videos_file, refuse)
    frames = read_frames(root, frames_file, lambda *key: wanted is None or key in wanted, refuse)
    places = {(error.sequence, error.frame) for error in refused}
    for name in sorted(frames.keys() - videos.keys()):
        if (name, None) not in places:
            refuse(BadAnnotation("the sequence is not annotated", str(videos_file), name))
            places.add((name, None))
        del frames[name]
    if listed is None:
        listed = split_by_seed(frames, seeded)
    else:
        for name, number in sorted(wanted or ()):
            if number not in frames.get(name, ()) and not {(name, None), (name, number)} & places:
                refuse(BadAnnotation("the frame is listed, but not annotated", str(set_list), name, number))
    splits = {split: _members(split, listed[split], frames, videos, filters) for split in SPLITS}
    if lost:
        splits["val"].left_out["in training too"] = lost
    files = [frames_file, videos_file, *([set_list] if set_list else [])]
    return Category(splits, files, refused)


def _members(
    split: str,
    listed: Iterable[tuple[str, int]],
    frames: dict[str, dict[int, CO3DFrame]],
    videos: dict[str, CO3DVideo],
    filters: Filters,
) -> SplitMembers:
    members = SplitMembers(listed=len({name for name, _ in listed}))
    for name, number in sorted(listed):
        if number in frames.get(name, ()):
            members.frames.setdefault(name, []).append(frames[name][number])
    for name in list(members.frames):
        reason = _reason_to_leave_out(len(members.frames[name]), videos[name], filters)
        if reason:
            members.left_out.setdefault(reason, []).append(name)
            del members.frames[name]
    most = filters.most_training_sequences
    if split == "train" and most is not None:
        best = sorted(members.frames, key=lambda name: -(videos[name].viewpoint_quality or 0.0))
        for name in best[most:]:
            members.left_out.setdefault(f"not among the {most} with the best viewpoint quality", []).append(name)
            del members.frames[name]
    for name in members.frames:
        members.captured[name] = list(frames[name].values())
        members.point_clouds[name] = videos[name].point_cloud
    return members


def _reason_to_leave_out(frames: int, video: CO3DVideo, filters: Filters) -> str | None:
    if frames < filters.min_frames:
        return f"fewer than {filters.min_frames} frames"
    scores = (
        ("viewpoint", video.viewpoint_quality, filters.min_viewpoint_quality),
        ("point cloud", video.point_cloud_quality, filters.min_point_cloud_quality),
    )
    for name, score, least in scores:
        if least is not None and (score is None or score < least):
            return f"{name} quality below {least:g}, or not given"
    return None
