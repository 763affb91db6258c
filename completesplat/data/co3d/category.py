"""Splits of CO3D categories into training, validation and test, with the sequences that are left out."""

import logging
import os
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from completesplat.data.co3d.annotations import CO3DFrame, CO3DVideo, Frames, read_frames, read_videos
from completesplat.data.splits import (
    SPLITS,
    ListedFrames,
    SeededSplit,
    overlaps,
    shared_names,
    split_by_hash,
    split_by_seed,
)
from completesplat.data.validation import field, path_below, read_json
from completesplat.errors import BadAnnotation, DataError, SharedSequences, errors_at, refused_to

logger = logging.getLogger(__name__)

FRAMES_FILE = "frame_annotations.jgz"
VIDEOS_FILE = "sequence_annotations.jgz"


def set_list_path(category: Path, subset: str | None) -> Path | None:
    """Return the path of the set list `subset`, which must exist, or None if the sequences are split by seed."""
    if subset is None:
        return None
    folder = category / "set_lists"
    subsets = sorted(path.stem.removeprefix("set_lists_") for path in folder.glob("set_lists_*.json"))
    if subset not in subsets:
        choice = f"choose data.subset among {', '.join(subsets)}, or" if subsets else "nor any other; give"
        advice = f"{choice} data.subset=null, which splits by seed"
        raise DataError(f"no set list {subset!r} there; {advice}", str(folder))
    return folder / f"set_lists_{subset}.json"


def read_set_list(path: Path, refused: list[DataError]) -> ListedFrames:
    """Read the frames of each split, and add the errors of single entries to `refused`.

    Raises:
        DataError: the file is missing, unreadable, or has no list for a split.
    """
    content = read_json(path)
    splits: ListedFrames = {}
    for split in SPLITS:
        with errors_at(path):
            members = field(content, split, list)
        splits[split] = set()
        for member in members:
            with refused_to(refused.append, path):
                if type(member) is not list or [type(part) for part in member[:2]] != [str, int]:
                    raise BadAnnotation(f"{split} has {str(member)[:80]}, [sequence name, number, path] is expected")
                splits[split].add((member[0], member[1]))
    return splits


def remove_test_sequences(path: Path, listed: ListedFrames, rule: SeededSplit) -> tuple[ListedFrames, list[str]]:
    """Return a set list whose splits share no sequence, and the names removed from validation.

    CO3D's `fewview_train` tests on all its training sequences (facebookresearch/co3d, issue 49); Splatter Image uses
    `fewview_dev` (`data_preprocessing/preprocess_co3d.py`). Validation loses sequences that are in training too. If it
    is then empty, it gets a seeded share of the training sequences.

    Raises:
        SharedSequences: a test sequence is also used for training or validation.
    """
    names = {split: {name for name, _ in listed[split]} for split in SPLITS}
    shared = shared_names(names)
    if any("test" in pair for pair in shared):
        advice = "choose another data.subset, or set data.allow_shared_sequences=true"
        raise SharedSequences(f"{'; '.join(overlaps(shared))}; {advice}", str(path))
    lost = names["train"] & names["val"]
    train = listed["train"]
    val = {frame for frame in listed["val"] if frame[0] not in lost}
    if not val and len(names["train"]) > 1:
        held_out = set(split_by_hash(sorted(names["train"]), rule.val_fraction, rule.split_seed)[1])
        message = "%s lists nothing for validation alone: %d of %d training sequences validate, by seed %d"
        logger.warning(message, path, len(held_out), len(names["train"]), rule.split_seed)
        val = {frame for frame in train if frame[0] in held_out}
        lost = lost - held_out
        train = train - val
    return {"train": train, "val": val, "test": listed["test"]}, sorted(lost)


class Filters(NamedTuple):
    """Criteria for the sequences that are used.

    Attributes:
        min_frames: a sequence with fewer frames in a split is left out of the split.
        min_viewpoint_quality, min_point_cloud_quality: smallest CO3D scores, which a sequence then needs; None: any.
        most_training_sequences: largest number, taken by best viewpoint quality (DFM: 500); None: all.
    """

    min_frames: int = 2
    min_viewpoint_quality: float | None = None
    min_point_cloud_quality: float | None = None
    most_training_sequences: int | None = None


class SplitMembers(NamedTuple):
    """Frames and point clouds of one split by sequence, and the names left out by reason.

    Attributes:
        listed: number of sequences in the split's list, usable or not.
        captured: all frames of the same sequences, also those of other splits; the up direction is estimated from them.
        annotations: file that annotates the frames of each sequence.
    """

    listed: int
    frames: dict[str, list[CO3DFrame]]
    captured: dict[str, list[CO3DFrame]]
    point_clouds: dict[str, Path | None]
    annotations: dict[str, Path]
    left_out: dict[str, list[str]]

    def without(self, names: Collection[str], reason: str) -> "SplitMembers":
        """Return the split without some sequences, which are left out for this reason."""
        lost = [name for name in self.frames if name in names]
        if not lost:
            return self
        frames = {name: frames for name, frames in self.frames.items() if name not in names}
        return self._replace(frames=frames, left_out=self.left_out | {reason: lost})

    def below(self, category: str) -> "SplitMembers":
        """Return the split with the category before each name."""
        return SplitMembers(
            listed=self.listed,
            frames={f"{category}/{name}": value for name, value in self.frames.items()},
            captured={f"{category}/{name}": value for name, value in self.captured.items()},
            point_clouds={f"{category}/{name}": value for name, value in self.point_clouds.items()},
            annotations={f"{category}/{name}": value for name, value in self.annotations.items()},
            left_out={reason: [f"{category}/{name}" for name in names] for reason, names in self.left_out.items()},
        )


def joined(parts: Sequence[SplitMembers]) -> SplitMembers:
    """Return the split that has the sequences of several, which have different names."""
    whole = SplitMembers(0, {}, {}, {}, {}, {})
    for part in parts:
        whole.frames.update(part.frames)
        whole.captured.update(part.captured)
        whole.point_clouds.update(part.point_clouds)
        whole.annotations.update(part.annotations)
        for reason, names in part.left_out.items():
            whole.left_out.setdefault(reason, []).extend(names)
    return whole._replace(listed=sum(part.listed for part in parts))


class Category(NamedTuple):
    """Splits of a category or of several, the files that define them, and the errors in these files."""

    splits: dict[str, SplitMembers]
    files: list[Path]
    refused: list[DataError]


def read_categories(
    root: Path,
    categories: Sequence[str],
    subset: str | None,
    seeded: SeededSplit,
    filters: Filters,
    allow_shared: bool = False,
) -> Category:
    """Read a category, or several as one, whose sequences are then named CATEGORY/NAME.

    Each category is split and filtered for itself. The arguments and errors are those of `read_category`.
    """
    if len(categories) == 1:
        return read_category(root, categories[0], subset, seeded, filters, allow_shared)
    files = list[Path]()
    refused = list[DataError]()
    parts: dict[str, list[SplitMembers]] = {split: [] for split in SPLITS}
    for name in categories:
        category = read_category(root, name, subset, seeded, filters, allow_shared)
        files += category.files
        for error in category.refused:
            sequence = None if error.sequence is None else f"{name}/{error.sequence}"
            refused.append(type(error)(error.reason, error.file, sequence, error.frame))
        for split, members in category.splits.items():
            parts[split].append(members.below(name))
    return Category({split: joined(members) for split, members in parts.items()}, files, refused)


def read_category(
    root: Path, category: str, subset: str | None, seeded: SeededSplit, filters: Filters, allow_shared: bool = False
) -> Category:
    """Read a category, split by the set list `subset`, or by seed if there is none.

    Annotations of frames that the set list does not name are ignored. `allow_shared` skips `remove_test_sequences`.

    Raises:
        DataError: the category, its annotations or its set list is missing, unreadable as a whole, or not below
            `root`; or a test sequence is in another split too.
    """
    folder = path_below(root, category)
    if not os.path.isdir(folder):
        raise DataError(f"no such CO3D category; {_existing_categories(root)}", str(folder))
    frames_file = folder / FRAMES_FILE
    videos_file = folder / VIDEOS_FILE
    set_list = set_list_path(folder, subset)
    refused = list[DataError]()
    listed = None
    lost = list[str]()
    if set_list is not None:
        listed = read_set_list(set_list, refused)
        if not allow_shared:
            listed, lost = remove_test_sequences(set_list, listed, seeded)
    wanted = None if listed is None else set().union(*listed.values())
    videos = read_videos(root, videos_file, refused.append)
    frames = read_frames(root, frames_file, lambda *key: wanted is None or key in wanted, refused.append)
    _refuse_unannotated(frames, videos, videos_file, refused)
    if wanted is not None:
        _refuse_missing_frames(frames, wanted, set_list, refused)
    listed = split_by_seed(frames, seeded) if listed is None else listed
    splits = {split: _members(split, listed[split], frames, frames_file, videos, filters) for split in SPLITS}
    if lost:
        splits["val"].left_out["in training too"] = lost
    return Category(splits, [file for file in (frames_file, videos_file, set_list) if file is not None], refused)


def _existing_categories(root: Path) -> str:
    """Return which categories there are, for a message."""
    names = sorted(path.parent.name for path in root.glob(f"*/{FRAMES_FILE}"))
    if not names:
        return f"no folder there has {FRAMES_FILE}: is data.root right?"
    return f"there are {', '.join(names)}"


def _refuse_unannotated(frames: Frames, videos: Collection[str], file: Path, refused: list[DataError]) -> None:
    """Remove the frames of sequences that have no annotation, and refuse those sequences, each once."""
    known = {error.sequence for error in refused if error.frame is None}
    for name in sorted(frames.keys() - videos):
        if name not in known:
            refused.append(BadAnnotation("the sequence is not annotated", str(file), name))
        del frames[name]


def _refuse_missing_frames(
    frames: Frames, wanted: Iterable[tuple[str, int]], file: Path | None, refused: list[DataError]
) -> None:
    """Refuse frames of a set list that no annotation has, unless they or their sequences are refused already."""
    known = {(error.sequence, error.frame) for error in refused}
    for name, number in sorted(wanted):
        if number not in frames.get(name, ()) and not {(name, None), (name, number)} & known:
            refused.append(BadAnnotation("the frame is listed, but not annotated", str(file), name, number))


def _members(
    split: str,
    listed: Iterable[tuple[str, int]],
    frames: Frames,
    frames_file: Path,
    videos: dict[str, CO3DVideo],
    filters: Filters,
) -> SplitMembers:
    members: dict[str, list[CO3DFrame]] = {}
    for name, number in sorted(listed):
        if number in frames.get(name, ()):
            members.setdefault(name, []).append(frames[name][number])
    out: dict[str, str] = {}
    for name, frames_of_split in members.items():
        reason = _reason_to_leave_out(len(frames_of_split), videos[name], filters)
        if reason is not None:
            out[name] = reason
    most = filters.most_training_sequences
    if split == "train" and most is not None:
        best = sorted(members.keys() - out.keys(), key=lambda name: (-(videos[name].viewpoint_quality or 0.0), name))
        out.update(dict.fromkeys(best[most:], f"not among the {most} with the best viewpoint quality"))
    left_out: dict[str, list[str]] = {}
    for name, reason in out.items():
        left_out.setdefault(reason, []).append(name)
    names = [name for name in members if name not in out]
    return SplitMembers(
        listed=len({name for name, _ in listed}),
        frames={name: members[name] for name in names},
        captured={name: list(frames[name].values()) for name in names},
        point_clouds={name: videos[name].point_cloud for name in names},
        annotations=dict.fromkeys(names, frames_file),
        left_out=left_out,
    )


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
