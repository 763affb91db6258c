"""Records in the folders of jobs: what each job was (`run.json`), and the results of its test."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, cast

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from completesplat.errors import CompleteSplatError
from completesplat.wording import printable

SCORES = "metrics.json"
MODES = "hidden_modes.json"
RECORD = "run.json"
CONFIG = "config.yaml"
PROTOCOL = "protocol"
"""Key of the entry that says how results were measured. The others are predictors."""
MODEL = "model"
"""Name of the predictor that is the run's model. With several samples, it scores the first."""
BEST_OF_K = "best_of_k"
BEST_BY_METRIC = "best_of_k_by_metric"
MEAN_OF_K = "mean_of_k"
"""Names of its best samples (`scene_scores.BEST_RULES`), and of the mean of all samples' scores."""
UPPER_BOUND = "upper_bound"
"""Key that marks a predictor that saw the views of its scores."""
BAD_STEPS = "train/bad_steps"
"""Figure in the results of a training: steps that were skipped (`completesplat.training.callbacks.BadSteps`)."""
HOW = "make them with `completesplat test ckpt=RUN/checkpoints/last.ckpt out=DIR`"

FlatScores = dict[str, float]
"""Scores of a predictor: `full_novel_psnr`, `seconds_inference`, `scenes`, `upper_bound`."""


class SweepPlace(TypedDict):
    """Place of a job in a sweep: the sweep's folder, relative to the job's, and the job's number."""

    folder: str
    job: int


class Record(TypedDict, total=False):
    """Entries of `run.json` that are read here. Records of earlier versions have no `verb`, `groups` and `sweep`.

    `groups` are the chosen options of config groups, `extensions` the versions of used ones by name. `sweep` is None
    for a job that is none of a sweep. `unchanged` says that the job's ablation changes nothing, and `diverged` why a
    training has no weights.
    """

    command: list[str]
    overrides: list[str]
    commit: str | None
    verb: str
    groups: dict[str, str | None]
    sweep: SweepPlace | None
    extensions: dict[str, str]
    unchanged: bool
    diverged: str


class Protocol(TypedDict, total=False):
    """Statement of how results were measured. Code reads the entries below. Others are only printed."""

    name: str
    method: str
    data_set: str
    resolution: int
    scenes: int
    metrics: dict[str, dict[str, Any]]
    missing: dict[str, str]
    machine: dict[str, Any]
    checkpoint: dict[str, str]
    data_fingerprint: str


def read_mapping(path: Path) -> dict[str, object]:
    """Read the mapping in a file by `write_json`, or an empty one if that fails, as when its writer was killed."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            return {}
        for entry in content.get("not_finite", ()):
            place, _, value = entry.partition(": ")
            *outer, key = place.split(".")
            part = reduce(lambda part, key: part[key], outer, content)
            if isinstance(part, dict):  # else an entry of a list
                part[key] = float(value)
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return {}
    return content


def read_record(folder: Path) -> Record:
    """Read a folder's `run.json`, or an empty record if there is none."""
    return cast(Record, read_mapping(folder / RECORD))


def job_entries(verb: str, given: Sequence[str], folder: Path) -> dict[str, object]:
    """Return the entries of the record of the job that Hydra runs in this folder: what was asked for, and its sweep.

    The user gave the arguments `given` behind the verb.
    """
    hydra_config = HydraConfig.get()
    choices = hydra_config.runtime.choices.items()
    sweep: SweepPlace | None = None
    if hydra_config.mode == RunMode.MULTIRUN:
        above = Path(os.path.relpath(hydra_config.sweep.dir, folder))
        sweep = {"folder": above.as_posix(), "job": hydra_config.job.num}
    return {
        "command": [f"completesplat {verb}", *given],
        "overrides": list(hydra_config.overrides.task),
        "verb": verb,
        "groups": {group: option for group, option in choices if not group.startswith("hydra/")},
        "sweep": sweep,
    }


def bad_steps_of(metrics: Mapping[str, object]) -> int:
    """Return how many steps of a training were skipped, which its results state."""
    count = metrics.get(BAD_STEPS, 0)
    return int(count) if isinstance(count, int | float) and math.isfinite(count) else 0


def sweep_folder(record: Record, folder: Path) -> Path | None:
    """Return the folder of the sweep that a job's record names, one of those above the job's `folder`, or None."""
    place = record.get("sweep")
    if place is None:
        return None
    above = [folder, *folder.parents]
    levels = len(Path(place["folder"]).parts)
    return above[levels] if levels < len(above) else None


def flat_scores(entry: Mapping[str, object]) -> FlatScores:
    """Flatten a predictor's entry in `SceneScores.results`: join the keys of all levels, and drop nulls."""
    scores: FlatScores = {}
    for key, value in entry.items():
        if isinstance(value, Mapping):
            scores |= {f"{key}_{name}": number for name, number in flat_scores(value).items()}
        elif isinstance(value, int | float):
            scores[key] = value
    return scores


class PredictorScores(NamedTuple):
    """Results of a test: how it was measured, and scores by predictor."""

    protocol: Protocol
    scores: dict[str, FlatScores]


def tested_predictors(content: Mapping[str, object]) -> PredictorScores:
    """Return the test in the content of a `metrics.json` by `fit` or `test`. It is empty if nothing was tested."""
    test = content if PROTOCOL in content else _mapping(content.get("test"))
    entries = {key: entry for key, entry in test.items() if key != PROTOCOL and isinstance(entry, Mapping)}
    scores = {predictor: flat_scores(entry) for predictor, entry in entries.items()}
    return PredictorScores(cast(Protocol, _mapping(test.get(PROTOCOL))), scores)


class ResultsFile(NamedTuple):
    """File of results: its folder, the folder's name, how it was measured, and its scores by predictor.

    `bad_steps` counts the skipped steps of the training, and `unchanged` says that its ablation changes nothing.
    """

    folder: Path
    name: str
    protocol: Protocol
    entries: dict[str, FlatScores]
    bad_steps: int = 0
    unchanged: bool = False


@dataclass(frozen=True)
class RunTree:
    """Sweeps and results below a folder, in the order of names, and a line for each file that cannot be used."""

    folder: Path
    sweeps: list[Path] = field(default_factory=list)
    scores: list[ResultsFile] = field(default_factory=list)
    modes: list[ResultsFile] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def find_results(folder: Path) -> RunTree:
    """Search a folder and everything below it, except hidden folders.

    Sweeps are those that the records of jobs name; jobs of earlier versions, which name none, count as single runs.
    """
    if not folder.is_dir():
        raise CompleteSplatError(f"runs={folder}: no such folder")
    tree = RunTree(folder)
    results: list[Path] = []
    sweeps: set[Path] = set()
    visited: set[str] = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in visited:
            folders.clear()
            continue
        visited.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        path = Path(place)
        results += [path / name for name in (SCORES, MODES) if name in names]
        if RECORD in names:
            sweep = sweep_folder(read_record(path), path)
            if sweep is not None and sweep.is_relative_to(folder):
                sweeps.add(sweep)
    tree.sweeps.extend(sorted(sweeps))
    for path in sorted(results):
        try:
            (tree.scores if path.name == SCORES else tree.modes).append(_result(path, folder))
        except ValueError as error:
            tree.warnings.append(f"{path}: left out, {error}")
    return tree


def _result(path: Path, root: Path) -> ResultsFile:
    """Read a file of results, or raise ValueError, with the reason, if it is unusable."""
    from completesplat.metrics import MetricFormat  # which `predict` does not need

    content = read_mapping(path)
    if not content:
        raise ValueError("it cannot be read as a mapping in JSON")
    needed: tuple[str, ...] = ()
    if path.name == MODES:
        statement = read_mapping(path.with_name("protocol.json"))
        protocol, entries = tested_predictors(content | {PROTOCOL: statement})
    else:
        needed = ("data_set", "resolution", "scenes")
        protocol, entries = tested_predictors(content)
    if not protocol or not all(key in protocol for key in needed):
        raise ValueError(f"it does not say how it was measured; {HOW}")
    if not entries:
        raise ValueError("it holds no scores by predictor")
    try:
        for metric in protocol.get("metrics", {}).values():
            MetricFormat(**metric.get("style", {"heading": ""}))
    except (AttributeError, TypeError):
        raise ValueError("a metric's style in it is not one of this version") from None
    name = printable(path.parent.relative_to(root).as_posix())
    unchanged = bool(read_record(path.parent).get("unchanged", False))
    return ResultsFile(path.parent, name, protocol, entries, bad_steps_of(content), unchanged)


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}
