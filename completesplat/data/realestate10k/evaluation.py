"""Test clips and test views of RealEstate10K, from the lists that were published with other works."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from completesplat.data.loading.scenes import Choice
from completesplat.data.sequences import PosedSequence, SequenceSource, shortened
from completesplat.data.validation import BadAnnotation, at, read_json, read_text
from completesplat.errors import DataError

CONTEXT, TARGET, SCORED = "context", "target", "target_quantify"
LINE = "KEY source target target target"

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class EvaluationIndex:
    """List of test views in the format of a published work: for each clip its tests as frame indices."""

    form: str
    views: dict[str, list[Choice]]


class ChosenSource(SequenceSource):
    """Clips by the name of their test, which is the clip's key, or `KEY#1`, `KEY#2` ... for several tests of a clip.

    `views` has reference and targets by name if there is an index; see `SequenceSource` for the other attributes.
    """

    def __init__(self, source: SequenceSource, clips: dict[str, str], views: dict[str, Choice], listed: int) -> None:
        self.names = list(clips)
        self.views = views
        self.listed = listed
        self.refused = source.refused
        self.left_out = source.left_out
        self._source = source
        self._clips = clips

    def read(self, name: str) -> PosedSequence:
        """Return the clip of a test; refuse it if it lacks a frame of the test's views."""
        sequence = replace(self._source.read(self._clips[name]), name=name)
        reference, targets = self.views.get(name, (sequence.frames[0], []))
        for frame in (reference, *targets):
            if frame not in sequence.frames:
                raise BadAnnotation("the frame is in the evaluation index, not in the data", None, name, frame)
        return sequence

    def verify(self) -> Sequence[DataError]:
        return self._source.verify()

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        return self._source.groups([self._clips[name] for name in names])

    def fingerprint(self) -> str:
        return self._source.fingerprint()


def read_index(path: Path) -> EvaluationIndex:
    """Read a list of test views in one of four formats. A target that is listed twice is scored twice.

    Three formats are JSON tables by clip (null: no test), where the first context frame is the reference:
    `{"context": [i, j], "target": [...]}` (dcharatan/pixelsplat, `assets/evaluation_index_re10k.json`);
    the same with the scored targets in "target_quantify", while "target" has the frames of a video
    (donydchen/mvsplat360, `assets/re10k_evaluation/re10k_inter_14_target_views_match.json`);
    a list, possibly empty, of pixelSplat's entries (Chrixtar/latentsplat, `assets/evaluation_index/re10k_extra.json`).
    The fourth has lines of a key and four frames, the reference first (eldar/flash3d, `datasets/re10k.py` and
    `splits/re10k_mine_filtered/test_files.txt`).

    Raises:
        DataError: the file is missing, unreadable or in another format.
    """
    text = read_text(path)
    with at(file=path):
        return _from_table(read_json(path)) if text.lstrip().startswith(("{", "[")) else _from_lines(text)


def read_keys(path: Path) -> list[str]:
    """Read a list of clips from a text file with one key a line, and refuse one with several columns."""
    keys = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        columns = line.split()
        if len(columns) > 1:
            reason = f"line {number}: {len(columns)} columns instead of a key (lists of views: data.evaluation_index)"
            raise BadAnnotation(reason, str(path))
        keys += columns
    return keys


def choose_clips(source: SequenceSource, index: EvaluationIndex | None, listed: list[str] | None) -> ChosenSource:
    """Select the clips that both lists name; a list that is None names all.

    Log the number of tests and the clips that are left out, as a warning if some of them are missing in the data.
    """
    keys, known, left_out = source.names, set(source.names), dict[str, list[str]]()
    if index is not None:
        left_out["null in the index"] = [key for key, tests in index.views.items() if not tests]
        left_out["in the index, not in the data"] = [k for k, tests in index.views.items() if tests and k not in known]
        left_out["not in the index"] = [key for key in keys if key not in index.views]
        keys = [key for key in keys if index.views.get(key)]
    if listed is not None:
        left_out["in the list, not in the data"] = [key for key in dict.fromkeys(listed) if key not in known]
        left_out["not in the list"] = [key for key in keys if key not in set(listed)]
        keys = [key for key in keys if key in set(listed)]
    clips, views = {key: key for key in keys} if index is None else {}, dict[str, Choice]()
    for key in keys:
        choices = [] if index is None else index.views[key]
        for number, choice in enumerate(choices, 1):
            name = f"{key}#{number}" if len(choices) > 1 else key
            clips[name], views[name] = key, choice
    parts = [f"{len(them)} {why}" + (f" ({shortened(them)})" if them else "") for why, them in left_out.items()]
    absent = {key for reason, them in left_out.items() if reason.endswith("not in the data") for key in them}
    tests = f"{len(clips)} scenes of {len(keys)} clips" if len(keys) < len(clips) else f"{len(keys)} clips"
    reasons = f"; left out: {', '.join(parts)}" if parts else ""
    logger.log(logging.WARNING if absent else logging.INFO, "%s to test%s", tests, reasons)
    return ChosenSource(source, clips, views, len(clips) + len(absent))


def _from_table(content: object) -> EvaluationIndex:
    if not isinstance(content, dict):
        raise BadAnnotation("not a table of clips")
    forms, views = dict[str, None](), dict[str, list[Choice]]()
    for key, value in content.items():
        with at(sequence=key):
            entries = [] if value is None else value if isinstance(value, list) else [value]
            views[key] = [_choice(entry) for entry in entries]
            if value is not None:
                scored = any(SCORED in entry for entry in entries)
                forms["latentSplat" if isinstance(value, list) else "MVSplat360" if scored else "pixelSplat"] = None
            if len(forms) > 1:
                raise BadAnnotation(f"formats of several works: {', '.join(forms)}")
    if not any(views.values()):
        raise BadAnnotation("no clip with views")
    return EvaluationIndex(next(iter(forms)), views)


def _choice(entry: object) -> Choice:
    if not isinstance(entry, dict) or entry.keys() - {SCORED} != {CONTEXT, TARGET}:
        raise BadAnnotation(
            "neither null, {context, target} (pixelSplat), {context, target, target_quantify} (MVSplat360) "
            "nor a list of {context, target} (latentSplat)"
        )
    for frames in entry.values():
        if not isinstance(frames, list) or not frames or not all(type(f) is int and f >= 0 for f in frames):
            raise BadAnnotation("context and target must be lists of frame numbers")
    return entry[CONTEXT][0], entry[SCORED if SCORED in entry else TARGET]


def _from_lines(text: str) -> EvaluationIndex:
    views: dict[str, list[Choice]] = {}
    for number, columns in enumerate(map(str.split, text.splitlines()), 1):
        if not columns:
            continue
        if len(columns) != len(LINE.split()) or not all(c.isascii() and c.isdecimal() for c in columns[1:]):
            reason = f"line {number}: not `{LINE}` with numbers of frames (Flash3D; lists of keys: data.scene_list)"
            raise BadAnnotation(reason)
        reference, *targets = map(int, columns[1:])
        views.setdefault(columns[0], []).append((reference, targets))
    if not views:
        raise BadAnnotation("no clip with views")
    return EvaluationIndex("Flash3D", views)
