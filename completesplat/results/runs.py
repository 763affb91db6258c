"""What lies in the folders of runs: results of tests, the jobs of sweeps, predictions."""

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
from hydra.core.override_parser.types import Override, ValueType
from omegaconf import OmegaConf

from completesplat.errors import CompleteSplatError

SCORES, MODES = "metrics.json", "hidden_modes.json"
RECORD, CONFIG, PLAN, SCENE = "run.json", "config.yaml", "multirun.yaml", "scene.json"
ROWS = ("samplers.json", "controls.json", "depth.json")
"""What `completesplat report NAME` leaves beside its figure: settings and rows."""
PROTOCOL = "protocol"
"""Where results say how they were measured, beside the entries of the predictors."""
NEEDED = {SCORES: ("data_set", "resolution", "scenes"), MODES: ()}
"""What a protocol must say, by the name of the file of results."""
REGIONS = ("full", "object")
HOW = "make them with `completesplat test ckpt=RUN/checkpoints/last.ckpt out=DIR`"


def read_mapping(path: Path) -> dict[str, Any]:
    """The mapping in a JSON file.

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
    """The mapping in a JSON file; an empty one where it cannot be read, as when its writer was killed."""
    try:
        return read_mapping(path)
    except ValueError:
        return {}


@dataclass(frozen=True)
class Result:
    """One file of results: its folder, the folder's name, how it was measured, and its entries by predictor."""

    folder: Path
    name: str
    protocol: dict[str, Any]
    entries: dict[str, dict[str, Any]]


@dataclass(frozen=True)
class RunTree:
    """What one walk finds below a folder, in the order of names, and a line for each file that cannot be used."""

    folder: Path
    runs: list[Path] = field(default_factory=list)
    predictions: list[Path] = field(default_factory=list)
    sweeps: list[Path] = field(default_factory=list)
    scores: list[Result] = field(default_factory=list)
    modes: list[Result] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def find(folder: Path) -> RunTree:
    """Search a folder and all below it, hidden folders apart.

    Raises:
        CompleteSplatError: there is no such folder.
    """
    if not folder.is_dir():
        raise CompleteSplatError(f"runs={folder}: no such folder")
    found, results = RunTree(folder), []
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        path, files = Path(place), set(names)
        if SCENE in files:
            found.predictions.append(path)
        elif files & {RECORD, PLAN, SCORES, MODES, *ROWS}:
            found.runs.append(path)
        if PLAN in files:
            found.sweeps.append(path)
        results += [path / name for name in (SCORES, MODES) if name in files]
    for path in sorted(results):
        try:
            (found.scores if path.name == SCORES else found.modes).append(_result(path, folder))
        except ValueError as error:
            found.warnings.append(f"{path}: left out, {error}")
    return found


def _result(path: Path, root: Path) -> Result:
    """Raises ValueError with the reason if the file is not what it should be."""
    content = read_mapping(path)
    if path.name == MODES:
        protocol, entries = read_mapping(path.with_name("protocol.json")), content
    else:
        test = content if PROTOCOL in content else content.get("test")
        if not isinstance(test, dict) or PROTOCOL not in test:
            raise ValueError(f"it does not say how it was measured; {HOW}")
        protocol, entries = test[PROTOCOL], test
        if content.get("upper_bound") and isinstance(test.get("model"), dict):  # which a fit says of its model
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
    """Whether regions hold views, and views hold metrics, as far as there are any."""
    views = [entry.get(region, {}) for region in REGIONS]
    parts = [part for view in views if isinstance(view, dict) for part in view.values()]
    return all(isinstance(part, dict) for part in [*views, *parts, entry.get("seconds") or {}])


def origin(path: Path, levels: int = 1) -> dict[str, str]:
    """Command, date and commit of what lies in a folder, as its `run.json` or that of one of `levels` parents says."""
    for place in [path, *path.parents[:levels]]:
        record = mapping_or_empty(place / RECORD)
        if record:
            command = record.get("command")
            return {
                "command": typed(command) if isinstance(command, list) else "",
                "started": str(record.get("started") or ""),
                "commit": str(record.get("commit") or ""),
            }
    return {"command": "", "started": "", "commit": ""}


def typed(command: Sequence[Any]) -> str:
    """A command as it could be typed; its first part is the program and its verb."""
    program, *arguments = map(str, command) if command else [""]
    return " ".join([program, *map(shlex.quote, arguments)])


@dataclass(frozen=True)
class Job:
    """A job of a sweep. One that has not started has no name, one that is not done has no `metrics`."""

    name: str
    """That of the job's folder."""
    overrides: dict[str, str] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)
    """The job's `run.json`."""
    metrics: dict[str, Any] | None = None
    label: str = ""
    """What the job is called among those of its sweep."""

    @property
    def test(self) -> dict[str, Any]:
        """`Evaluation.results` of the test set, by predictor; empty where nothing was tested."""
        return {key: entry for key, entry in self._results.items() if key != PROTOCOL}

    @property
    def protocol(self) -> dict[str, Any]:
        """How the test was done; empty where nothing was tested, or where the results do not say it."""
        return self._results.get(PROTOCOL, {})

    @property
    def _results(self) -> dict[str, Any]:
        return (self.metrics or {}).get("test", {})


SEED = "seed"


def collect(folder: Path) -> list[Job]:
    """All jobs of a sweep's folder; those without a folder of their own, which have not started, at the end."""
    folders = [path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    found = [_job(path) for path in sorted(folders, key=_natural)]
    recorded = [job for job in found if job.record]
    known = [job.overrides for job in recorded]
    waiting = [Job("", overrides) for overrides in map(_pairs, planned(folder)) if overrides not in known]
    # A job that ended before it could write its record is one of those that the plan misses.
    silent = [job for job in found if not job.record][len(waiting) :]
    return _labelled([*recorded, *silent, *waiting])


def planned(folder: Path) -> list[list[str]]:
    """The overrides of all jobs by number, of which hydra's sweeper makes the product.

    They come from the `multirun.yaml` that hydra leaves in the folder when a sweep starts. Empty where there is none,
    or where it takes more than that file to know the jobs: `glob(...)` depends on the files of the configuration.
    """
    if not (folder / PLAN).is_file():
        return []
    given = OmegaConf.to_container(OmegaConf.load(folder / PLAN).hydra.overrides.task)
    assert isinstance(given, list)
    overrides = OverridesParser.create().parse_overrides(given)
    if any(o.is_sweep_override() and o.value_type == ValueType.GLOB_CHOICE_SWEEP for o in overrides):
        return []
    choices = {override.get_key_element(): _choices(override) for override in overrides}
    return [list(job) for job in product(*choices.values())]


def _choices(override: Override) -> list[str]:
    key = override.get_key_element()
    if override.is_discrete_sweep():
        return [f"{key}={value}" for value in override.sweep_string_iterator()]
    return [f"{key}={override.get_value_element_as_str()}"]


def _pairs(overrides: Sequence[str]) -> dict[str, str]:
    """`["ablation=full", "+a.b=1"]` as `{"ablation": "full", "a.b": "1"}`.

    Without those that only say where a job goes and that it may go on from there: `out=DIR` and `ckpt_path=last`.
    """
    split = (override.lstrip("+").partition("=") for override in overrides)
    return {key: value for key, _, value in split if key != "out" and (key, value) != ("ckpt_path", "last")}


def _natural(path: Path) -> list[str | int]:
    """A key that sorts `seed=10` behind `seed=9`."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]


def _job(folder: Path) -> Job:
    record = mapping_or_empty(folder / RECORD)
    if not record:
        return Job(folder.name)
    config = OmegaConf.to_container(OmegaConf.load(folder / CONFIG))
    assert isinstance(config, dict)
    named = {str(key): value for key, value in config.items()}
    return Job(folder.name, _pairs(record["overrides"]), named, record, mapping_or_empty(folder / SCORES) or None)


def _labelled(jobs: Sequence[Job]) -> list[Job]:
    """The jobs, named by the overrides that are not equal in all of them, the seed apart.

    The choice of a config group is named by its value alone (`no_skips`), any other setting as `key=value`. A job that
    differs in nothing bears the name of its experiment, or `all`.
    """
    described = [job.overrides for job in jobs if job.overrides]
    keys = dict.fromkeys(key for overrides in described for key in overrides if key != SEED)
    differing = [key for key in keys if len({overrides.get(key) for overrides in described}) > 1]
    # A group fills a mapping of the configuration, or acts on all of it and leaves nothing under its own name.
    settings = {key for job in jobs for key, value in job.config.items() if not isinstance(value, dict)}
    named = []
    for job in jobs:
        parts = []
        for key in (key for key in differing if key in job.overrides):
            bare = "." not in key and "@" not in key and key not in settings
            parts.append(job.overrides[key] if bare else f"{key}={job.overrides[key]}")
        named.append(replace(job, label=", ".join(parts) or job.overrides.get("experiment", "all")))
    return named
