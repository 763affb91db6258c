"""Content of the folders of runs: results of tests, the jobs of sweeps, predictions."""

import json
import os
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ValueType
from omegaconf import OmegaConf

from completesplat.errors import CompleteSplatError

SCORES, MODES = "metrics.json", "hidden_modes.json"
RECORD, CONFIG, PLAN, SCENE = "run.json", "config.yaml", "multirun.yaml", "scene.json"
ROWS = ("samplers.json", "controls.json", "depth.json", "views.json")
"""Files that `completesplat report NAME` writes beside its figure: settings and rows."""
PROTOCOL = "protocol"  # the key of how results were measured, beside the entries of the predictors
NEEDED = {SCORES: ("data_set", "resolution", "scenes"), MODES: ()}
"""Entries that a protocol must have, by the name of the file of results."""
REGIONS = ("full", "object")
HOW = "make them with `completesplat test ckpt=RUN/checkpoints/last.ckpt out=DIR`"


def read_mapping(path: Path) -> dict[str, Any]:
    """Read the mapping in a JSON file.

    Raises:
        ValueError: there is no such file, it is not JSON, or it holds something else.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path.name} is missing beside it") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"it cannot be read as JSON ({' '.join(str(error).split())})") from None
    if not isinstance(content, dict):
        raise ValueError("it holds no mapping")
    return content


def mapping_or_empty(path: Path) -> dict[str, Any]:
    """Read the mapping in a JSON file; return an empty one if that fails, as when its writer was killed."""
    try:
        return read_mapping(path)
    except ValueError:
        return {}


@dataclass(frozen=True)
class Result:
    """File of results: its folder, the folder's name, how it was measured, and its entries by predictor."""

    folder: Path
    name: str
    protocol: dict[str, Any]
    entries: dict[str, dict[str, Any]]


@dataclass(frozen=True)
class RunTree:
    """Runs and results below a folder, in the order of names, and a line for each file that cannot be used."""

    folder: Path
    runs: list[Path] = field(default_factory=list)
    predictions: list[Path] = field(default_factory=list)
    sweeps: list[Path] = field(default_factory=list)
    scores: list[Result] = field(default_factory=list)
    modes: list[Result] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def find(folder: Path) -> RunTree:
    """Search a folder and everything below it, except hidden folders."""
    if not folder.is_dir():
        raise CompleteSplatError(f"runs={folder}: no such folder")
    tree, results = RunTree(folder), []
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        path, files = Path(place), set(names)
        if SCENE in files:
            tree.predictions.append(path)
        elif files & {RECORD, PLAN, SCORES, MODES, *ROWS}:
            tree.runs.append(path)
        if PLAN in files:
            tree.sweeps.append(path)
        results += [path / name for name in (SCORES, MODES) if name in files]
    for path in sorted(results):
        try:
            (tree.scores if path.name == SCORES else tree.modes).append(_result(path, folder))
        except ValueError as error:
            tree.warnings.append(f"{path}: left out, {error}")
    return tree


def _result(path: Path, root: Path) -> Result:
    """Read a file of results; raise ValueError with the reason if it is unusable."""
    content = read_mapping(path)
    if path.name == MODES:
        protocol, entries = read_mapping(path.with_name("protocol.json")), content
    else:
        test = content if PROTOCOL in content else content.get("test")
        if not isinstance(test, dict) or PROTOCOL not in test:
            raise ValueError(f"it does not say how it was measured; {HOW}")
        protocol, entries = test[PROTOCOL], test
        if content.get("upper_bound") and isinstance(test.get("model"), dict):  # stated by a fit about its model
            entries = test | {"model": test["model"] | {"upper_bound": True}}
    if not isinstance(protocol, dict):
        raise ValueError("its protocol is no mapping")
    if lacking := [key for key in NEEDED[path.name] if key not in protocol]:
        raise ValueError(f"its protocol does not say {', '.join(lacking)}")
    scored = {key: entry for key, entry in entries.items() if key != PROTOCOL and isinstance(entry, dict)}
    if not scored or not all(map(_is_entry, scored.values())):
        raise ValueError("it holds no scores by predictor")
    return Result(path.parent, str(path.parent.relative_to(root)), protocol, scored)


def _is_entry(entry: dict[str, Any]) -> bool:
    """Return whether all regions hold views, and all views hold metrics."""
    views = [entry.get(region, {}) for region in REGIONS]
    parts = [part for view in views if isinstance(view, dict) for part in view.values()]
    return all(isinstance(part, dict) for part in [*views, *parts, entry.get("seconds") or {}])


def origin(path: Path, levels: int = 1) -> dict[str, str]:
    """Return command, date and commit from the `run.json` of a folder or of one of its `levels` parents."""
    records = (mapping_or_empty(place / RECORD) for place in [path, *path.parents[:levels]])
    record: dict[str, Any] = next(filter(None, records), {})
    command = record.get("command")
    values = {"command": typed(command) if isinstance(command, list) else ""}
    return values | {key: str(record.get(key) or "") for key in ("started", "commit")}


def typed(command: Sequence[Any]) -> str:
    """Return a command as it could be typed; its first part is the program and its verb."""
    program, *arguments = map(str, command) if command else [""]
    return " ".join([program, *map(shlex.quote, arguments)])


@dataclass(frozen=True)
class Job:
    """Job of a sweep: its folder's name (empty before its start), `run.json`, `metrics.json` (None until it is done).

    `test` (`Evaluation.results` by predictor) and `protocol` are empty where nothing was tested.
    """

    name: str
    overrides: dict[str, str] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, Any] | None = None
    test: dict[str, Any] = field(default_factory=dict)
    protocol: dict[str, Any] = field(default_factory=dict)
    label: str = ""  # name of the job among those of its sweep


SEED = "seed"


def collect(*folders: Path) -> list[Job]:
    """Return all jobs of a sweep's folder, at the end those that have not started and have no folder yet.

    Several folders are parts of one sweep on several machines. Settings that only locate a machine's files are then
    ignored, and if a job is in several parts, the one with the most progress is taken.
    """
    parts = [_jobs(folder) for folder in folders]
    return _labelled(parts[0] if len(parts) == 1 else _joined(parts))


def _joined(parts: Sequence[list[Job]]) -> list[Job]:
    """Join the jobs of several machines, each once."""
    values: dict[str, list[set[str]]] = {}
    for number, jobs in enumerate(parts):
        for key, value in (pair for job in jobs for pair in job.overrides.items()):
            values.setdefault(key, [set() for _ in parts])[number].add(value)
    # Settings with the same path everywhere in a part, and other paths in other parts.
    local = {
        key
        for key, by_part in values.items()
        if max(map(len, by_part)) == 1 and len(set.union(*by_part)) > 1 and all("/" in v for v in set.union(*by_part))
    }
    best: dict[Any, Job] = {}
    for job in (job for jobs in parts for job in jobs):
        overrides = {key: value for key, value in job.overrides.items() if key not in local}
        identity = frozenset(overrides.items()) or job.name
        if identity not in best or _progress(job) > _progress(best[identity]):
            best[identity] = replace(job, overrides=overrides)
    return list(best.values())


def _progress(job: Job) -> tuple[bool, bool]:
    return job.metrics is not None, bool(job.record)


def _jobs(folder: Path) -> list[Job]:
    folders = [path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    # `seed=10` comes after `seed=9`.
    split = {path: re.split(r"(\d+)", path.name) for path in folders}
    natural = {path: [int(part) if part.isdecimal() else part for part in parts] for path, parts in split.items()}
    jobs = [_job(path) for path in sorted(folders, key=natural.__getitem__)]
    recorded = [job for job in jobs if job.record]
    known = [job.overrides for job in recorded]
    waiting = [Job("", overrides) for overrides in map(_pairs, planned(folder)) if overrides not in known]
    # `waiting` includes jobs that ended before they wrote a record, so as many folders without one are left out.
    silent = [job for job in jobs if not job.record][len(waiting) :]
    return [*recorded, *silent, *waiting]


def planned(folder: Path) -> list[list[str]]:
    """Return the overrides of all jobs by number, as the product that hydra's sweeper makes.

    The list is empty without the `multirun.yaml` that hydra writes when a sweep starts, or if that file does not
    determine the jobs: `glob(...)` depends on the config files.
    """
    if not (folder / PLAN).is_file():
        return []
    arguments: Any = OmegaConf.to_container(OmegaConf.load(folder / PLAN).hydra.overrides.task)
    overrides = OverridesParser.create().parse_overrides(arguments)
    if any(o.is_sweep_override() and o.value_type == ValueType.GLOB_CHOICE_SWEEP for o in overrides):
        return []
    values = {
        o.get_key_element(): o.sweep_string_iterator() if o.is_discrete_sweep() else [o.get_value_element_as_str()]
        for o in overrides
    }
    return [list(job) for job in product(*([f"{key}={value}" for value in choices] for key, choices in values.items()))]


def _pairs(overrides: Sequence[str]) -> dict[str, str]:
    """Convert `["ablation=full", "+a.b=1"]` to `{"ablation": "full", "a.b": "1"}`.

    Leave out `out=DIR` and `ckpt_path=last`, which only say where a job writes and that it may resume there.
    """
    split = (override.lstrip("+").partition("=") for override in overrides)
    return {key: value for key, _, value in split if key != "out" and (key, value) != ("ckpt_path", "last")}


def _job(folder: Path) -> Job:
    record = mapping_or_empty(folder / RECORD)
    if not record:
        return Job(folder.name)
    config: Any = OmegaConf.to_container(OmegaConf.load(folder / CONFIG))
    metrics = mapping_or_empty(folder / SCORES) or None
    test: dict[str, Any] = dict((metrics or {}).get("test", {}))
    protocol = test.pop(PROTOCOL, {})
    return Job(folder.name, _pairs(record["overrides"]), config, record, metrics, test, protocol)


def _labelled(jobs: Sequence[Job]) -> list[Job]:
    """Name the jobs by the overrides, except the seed, that differ between them.

    The choice of a config group is named by its value alone (`no_skips`), any other setting as `key=value`. A job
    without differing overrides takes the name of its experiment, or `all`.
    """
    described = [job.overrides for job in jobs if job.overrides]
    keys = dict.fromkeys(key for overrides in described for key in overrides if key != SEED)
    differing = [key for key in keys if len({overrides.get(key) for overrides in described}) > 1]
    # A group fills a mapping of the config, or acts on all of it and leaves nothing under the group's name.
    settings = {key for job in jobs for key, value in job.config.items() if not isinstance(value, dict)}
    named = []
    for job in jobs:
        parts = []
        for key in (key for key in differing if key in job.overrides):
            bare = "." not in key and "@" not in key and key not in settings
            parts.append(job.overrides[key] if bare else f"{key}={job.overrides[key]}")
        named.append(replace(job, label=", ".join(parts) or job.overrides.get("experiment", "all")))
    return named
