"""Content of the folders of runs: results of tests, the jobs of sweeps."""

import itertools
import json
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from completesplat.errors import CompleteSplatError
from completesplat.files import printable

SCORES = "metrics.json"
MODES = "hidden_modes.json"
RECORD = "run.json"
CONFIG = "config.yaml"
PLAN = "multirun.yaml"
PROTOCOL = "protocol"  # key of the entry that says how results were measured; the others are predictors
MODEL = "model"
UPPER_BOUND = "upper_bound"
"""Name of the predictor that is the run's model; key that marks a predictor that saw the views of its scores."""
SEED = "seed"
HOW = "make them with `completesplat test ckpt=RUN/checkpoints/last.ckpt out=DIR`"

FlatScores = dict[str, float]  # scores of a predictor: `full_novel_psnr`, `seconds_inference`, `scenes`, `upper_bound`


class Record(TypedDict, total=False):
    """Entries of `run.json` that are read here."""

    command: list[str]
    overrides: list[str]
    commit: str | None


class Protocol(TypedDict, total=False):
    """Statement of how results were measured. Code reads the entries below; others are only printed."""

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
    """Read the mapping in a file by `write_json`; return an empty one if that fails, as when its writer was killed."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        content = content if isinstance(content, dict) else {}
        for entry in content.get("not_finite", ()):
            place, _, value = entry.partition(": ")
            *outer, key = place.split(".")
            if isinstance(part := reduce(lambda part, key: part[key], outer, content), dict):  # else an entry of a list
                part[key] = float(value)
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return {}
    return content


def read_record(folder: Path) -> Record:
    """Read a folder's `run.json`; return an empty record if there is none."""
    return cast(Record, read_mapping(folder / RECORD))


def flat_scores(entry: Mapping[str, object]) -> FlatScores:
    """Flatten a predictor's entry in `Evaluation.results`: join the keys of all levels, and drop nulls."""
    scores: FlatScores = {}
    for key, value in entry.items():
        if isinstance(value, Mapping):
            scores |= {f"{key}_{name}": number for name, number in flat_scores(value).items()}
        elif isinstance(value, int | float):
            scores[key] = value
    return scores


class ResultsFile(NamedTuple):
    """File of results: its folder, the folder's name, how it was measured, and its scores by predictor."""

    folder: Path
    name: str
    protocol: Protocol
    entries: dict[str, FlatScores]


@dataclass(frozen=True)
class RunTree:
    """Sweeps and results below a folder, in the order of names, and a line for each file that cannot be used."""

    folder: Path
    sweeps: list[Path] = field(default_factory=list)
    scores: list[ResultsFile] = field(default_factory=list)
    modes: list[ResultsFile] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def find_results(folder: Path) -> RunTree:
    """Search a folder and everything below it, except hidden folders."""
    if not folder.is_dir():
        raise CompleteSplatError(f"runs={folder}: no such folder")
    tree = RunTree(folder)
    results = list[Path]()
    visited = set[str]()
    for place, folders, names in os.walk(folder, followlinks=True):
        if (real := os.path.realpath(place)) in visited:
            folders.clear()
            continue
        visited.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        path = Path(place)
        if PLAN in names:
            tree.sweeps.append(path)
        results += [path / name for name in (SCORES, MODES) if name in names]
    for path in sorted(results):
        try:
            (tree.scores if path.name == SCORES else tree.modes).append(_result(path, folder))
        except ValueError as error:
            tree.warnings.append(f"{path}: left out, {error}")
    return tree


def _result(path: Path, root: Path) -> ResultsFile:
    """Read a file of results; raise ValueError, with the reason, if it is unusable."""
    from completesplat.metrics import Style  # which `predict` does not need

    content = read_mapping(path)
    if not content:
        raise ValueError("it cannot be read as a mapping in JSON")
    test = content if path.name == MODES or PROTOCOL in content else content.get("test")
    entries = {key: flat_scores(entry) for key, entry in _mapping(test).items() if isinstance(entry, Mapping)}
    entries.pop(PROTOCOL, None)
    statement = read_mapping(path.with_name("protocol.json")) if path.name == MODES else _mapping(test).get(PROTOCOL)
    protocol = _mapping(statement)
    needed = () if path.name == MODES else ("data_set", "resolution", "scenes")
    if not protocol or not all(key in protocol for key in needed):
        raise ValueError(f"it does not say how it was measured; {HOW}")
    if not entries:
        raise ValueError("it holds no scores by predictor")
    try:
        for metric in cast(Protocol, protocol).get("metrics", {}).values():
            Style(**metric.get("style", {"heading": ""}))
    except (AttributeError, TypeError):
        raise ValueError("a metric's style in it is not one of this version") from None
    name = printable(path.parent.relative_to(root).as_posix())
    return ResultsFile(path.parent, name, cast(Protocol, protocol), entries)


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}


def shell_command(command: Sequence[str]) -> str:
    """Return a command as it could be typed; its first part is the program and its verb."""
    return " ".join([*command[:1], *map(shlex.quote, command[1:])])


@dataclass(frozen=True)
class Job:
    """Job of a sweep: its folder in the sweep's (empty before its start), `run.json` and `metrics.json`.

    `test` and `protocol` are empty where nothing was tested. `label` tells the job from the others of its sweep.
    """

    name: str
    overrides: dict[str, str] = field(default_factory=dict)
    config: Mapping[str, object] = field(default_factory=dict)
    record: Record = field(default_factory=Record)
    finished: bool = False
    steps: int = 0
    test: dict[str, FlatScores] = field(default_factory=dict)
    protocol: Protocol = field(default_factory=Protocol)
    label: str = ""


def collect(*folders: Path) -> list[Job]:
    """Return all jobs of a sweep's folder; those that have not started, and so have no folder, come last.

    Several folders are parts of one sweep on several machines. Settings that only locate a machine's files are then
    ignored, and if a job is in several parts, the one with the most progress is taken.
    """
    parts = [_jobs(folder) for folder in folders]
    return _labelled(parts[0] if len(parts) == 1 else _joined(parts))


def _joined(parts: Sequence[list[Job]]) -> list[Job]:
    values: dict[str, list[set[str]]] = {}
    for number, jobs in enumerate(parts):
        for key, value in (pair for job in jobs for pair in job.overrides.items()):
            values.setdefault(key, [set() for _ in parts])[number].add(value)
    # Settings whose value is a path that is the same in all jobs of a part and differs between the parts.
    local = {
        key
        for key, by_part in values.items()
        if max(map(len, by_part)) == 1 and len(set.union(*by_part)) > 1 and all("/" in v for v in set.union(*by_part))
    }
    best: dict[object, Job] = {}
    for job in sorted((job for jobs in parts for job in jobs), key=lambda job: (job.finished, bool(job.record))):
        overrides = {key: value for key, value in job.overrides.items() if key not in local}
        best[frozenset(overrides.items()) or job.name] = replace(job, overrides=overrides)
    return list(best.values())


def _jobs(folder: Path) -> list[Job]:
    jobs = [_job(path, path.relative_to(folder).as_posix()) for path in _job_folders(folder)]
    verb = _plan(folder).get("verb")  # people write results of other verbs there, too
    recorded = [job for job in jobs if job.record and (verb is None or job.record["command"][0].endswith(f" {verb}"))]
    known = [job.overrides for job in recorded]
    waiting = [Job("", overrides) for overrides in map(_pairs, planned_jobs(folder)) if overrides not in known]
    # `waiting` also has the jobs that ended before their record, so that many folders without a record are left out.
    silent = [job for job in jobs if not job.record][len(waiting) :]
    return [*recorded, *silent, *waiting]


def _job_folders(folder: Path) -> Iterator[Path]:
    """Yield the folders with a job's record, at any depth, and those at the top that have none in them."""
    for path in sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")):
        if (path / RECORD).is_file() or (path / PLAN).is_file():  # a job, or another sweep
            yield path
        else:
            yield from [job for job in _job_folders(path) if (job / RECORD).is_file()] or [path]


def planned_jobs(folder: Path) -> list[list[str]]:
    """Return the overrides of all jobs by number.

    The list is empty without the `multirun.yaml` that hydra writes when a sweep starts, or if that file does not
    determine the jobs: `glob(...)` depends on the config files.
    """
    values = {}
    try:
        arguments = list(_plan(folder).hydra.overrides.task)
        for override in OverridesParser.create().parse_overrides(arguments):
            sweep = override.is_sweep_override()
            texts = list(override.sweep_string_iterator()) if sweep else [override.get_value_element_as_str()]
            key = override.get_key_element()
            values[key] = [f"{key}={text}" for text in texts]
    except (HydraException, ValueError, AttributeError, TypeError):
        return []
    return [list(job) for job in itertools.product(*values.values())]


def _plan(folder: Path) -> Any:
    try:
        plan = OmegaConf.load(folder / PLAN)
    except (OmegaConfBaseException, YAMLError, OSError, ValueError):
        plan = None
    return plan if isinstance(plan, DictConfig) else OmegaConf.create()


def _pairs(overrides: Sequence[str]) -> dict[str, str]:
    """Convert `["ablation=full", "+a.b=1"]` to `{"ablation": "full", "a.b": "1"}`.

    Leave out `out=DIR` and `ckpt_path=last`, which only say where a job writes and that it may resume there.
    """
    split = (override.lstrip("+").partition("=") for override in overrides)
    return {key: value for key, _, value in split if key != "out" and (key, value) != ("ckpt_path", "last")}


def _job(folder: Path, name: str) -> Job:
    record = read_record(folder)
    metrics = read_mapping(folder / SCORES)
    try:
        config = cast(Mapping[str, object], OmegaConf.to_container(OmegaConf.load(folder / CONFIG)))
    except (OmegaConfBaseException, YAMLError, OSError, ValueError):  # its writer was killed
        config = {}
    if not config or not isinstance(config, dict) or "overrides" not in record:
        return Job(name)
    tested = metrics if PROTOCOL in metrics else _mapping(metrics.get("test"))
    entries = {name: entry for name, entry in tested.items() if name != PROTOCOL and isinstance(entry, Mapping)}
    test = {name: flat_scores(entry) for name, entry in entries.items()}
    steps = cast(int, metrics.get("steps", 0))
    protocol = cast(Protocol, _mapping(tested.get(PROTOCOL)))
    return Job(name, _pairs(record["overrides"]), config, record, bool(metrics), steps, test, protocol)


def _labelled(jobs: Sequence[Job]) -> list[Job]:
    """Name the jobs by the overrides, except the seed, that differ between them.

    The choice of a config group is named by its value alone (`no_skips`), any other setting as `key=value`. A job
    without differing overrides takes the name of its experiment, or `all`.
    """
    all_overrides = [job.overrides for job in jobs if job.overrides]
    keys = dict.fromkeys(key for overrides in all_overrides for key in overrides if key != SEED)
    differing = [key for key in keys if len({overrides.get(key) for overrides in all_overrides}) > 1]
    # A config group's key holds a mapping, or is absent if the group changes the whole config.
    settings = {key for job in jobs for key, value in job.config.items() if not isinstance(value, dict)}
    groups = {key for key in differing if "." not in key and "@" not in key and key not in settings}

    def label(job: Job) -> str:
        given = {key: job.overrides[key] for key in differing if key in job.overrides}
        parts = [value if key in groups else f"{key}={value}" for key, value in given.items()]
        return ", ".join(parts) or job.overrides.get("experiment", "all")

    return [replace(job, label=label(job)) for job in jobs]
