"""Test clips and test views of RealEstate10K, from the lists that were published with other works."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from completesplat.data.loading.view_selection import Choice
from completesplat.data.sequences import PosedSequence, SequenceSource, first_names
from completesplat.data.validation import read_json, read_text
from completesplat.errors import BadAnnotation, DataError, errors_at

CONTEXT = "context"
TARGET = "target"
SCORED = "target_quantify"
LINE = "KEY source target target target"

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class EvaluationIndex:
    """List of test views in the format of a published work: for each clip its tests as frame indices."""

    form: str
    views: dict[str, list[Choice]]


class ChosenSource(SequenceSource):
    """Clips by the name of their test, which is the clip's key, or `KEY#1`, `KEY#2` ... for several tests of a clip.

    `views` has reference and targets by name if there is an index.
    """

    def __init__(self, source: SequenceSource, clips: dict[str, str], views: dict[str, Choice], listed: int) -> None:
        super().__init__(list(clips), listed, source.refused, source.left_out)
        self.views = views
        self._source = source
        self._clips = clips

    def read(self, name: str) -> PosedSequence:
        """Return the clip of a test, or refuse it if it lacks a frame of the test's views."""
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
    with errors_at(file=path):
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
    """Select the clips that both lists name, where None is a list of all.

    Log the number of tests and the clips that are left out, as a warning if some of them are missing in the data.
    """
    keys = source.names
    tests = dict[str, list[Choice]]() if index is None else index.views
    left_out = dict[str, list[str]]()
    absent = set[str]()
    if index is not None:
        left_out["null in the index"] = [key for key in tests if not tests[key]]
        keys = [key for key in keys if tests.get(key) != []]
    wanted = {}
    if index is not None:
        wanted["index"] = [key for key in tests if tests[key]]
    if listed is not None:
        wanted["list"] = listed
    known = set(source.names)
    for what, names in wanted.items():
        selected = set(names)
        missing = [name for name in dict.fromkeys(names) if name not in known]
        left_out[f"in the {what}, not in the data"] = missing
        left_out[f"not in the {what}"] = [key for key in keys if key not in selected]
        keys = [key for key in keys if key in selected]
        absent.update(missing)
    clips, views = _named_tests(keys, tests)
    _report(len(clips), len(keys), left_out, logging.WARNING if absent else logging.INFO)
    return ChosenSource(source, clips, views, len(clips) + len(absent))


def _named_tests(keys: Sequence[str], tests: Mapping[str, list[Choice]]) -> tuple[dict[str, str], dict[str, Choice]]:
    """Return clips and views by the name of their test. Clips without an index are their own tests."""
    clips = dict[str, str]()
    views = dict[str, Choice]()
    for key in keys:
        choices = tests.get(key, [])
        names = [key] if len(choices) < 2 else [f"{key}#{number}" for number in range(1, len(choices) + 1)]
        clips.update(dict.fromkeys(names, key))
        views.update(zip(names, choices, strict=False))  # without an index there are no choices
    return clips, views


def _report(scenes: int, clips: int, left_out: Mapping[str, list[str]], level: int) -> None:
    """Log the number of tests, and the clips that are left out by reason."""
    parts = []
    for reason, names in left_out.items():
        examples = f" ({first_names(names)})" if names else ""
        parts.append(f"{len(names)} {reason}{examples}")
    message = f"{scenes} scenes of {clips} clips to test" if clips < scenes else f"{clips} clips to test"
    if parts:
        message = f"{message}; left out: {', '.join(parts)}"
    logger.log(level, message)


def _from_table(content: object) -> EvaluationIndex:
    if not isinstance(content, dict):
        raise BadAnnotation("not a table of clips")
    forms = dict[str, None]()
    views = dict[str, list[Choice]]()
    for key, value in content.items():
        with errors_at(sequence=key):
            if value is None:
                views[key] = []
            elif isinstance(value, list):
                views[key] = [_choice(entry) for entry in value]
                forms["latentSplat"] = None
            else:
                views[key] = [_choice(value)]
                forms["MVSplat360" if SCORED in value else "pixelSplat"] = None
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
