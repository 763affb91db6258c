"""What lies in the folders of runs: their results, the jobs of sweeps, predictions."""

import json
import os
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from omegaconf import OmegaConf

from completesplat.errors import CompleteSplatError


def planned(folder: Path) -> list[list[str]]:
    """The overrides of all jobs by number, of which hydra's sweeper makes the product.

    They come from the `multirun.yaml` that hydra leaves in the folder when a sweep starts. Empty where there is none,
    or where it takes more than that file to know the jobs: `glob(...)` depends on the files of the configuration.
    """
    path = folder / "multirun.yaml"
    if not path.is_file():
        return []
    given = OmegaConf.to_container(OmegaConf.load(path).hydra.overrides.task)
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


PROTOCOL = "protocol"
"""Where results say how they were measured, beside the entries of the predictors."""


@dataclass(frozen=True)
class Job:
    """One job, named after its folder, without a name if it has not started; `metrics` is None until it is done."""

    name: str
    overrides: dict[str, str] = field(default_factory=dict)
    """Those of `pairs`."""
    config: dict[str, Any] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)
    """The job's `run.json`."""
    metrics: dict[str, Any] | None = None

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


def collect(folder: Path) -> list[Job]:
    """All jobs of a sweep's folder, those without a folder of their own, which have not started, at the end."""
    folders = [path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    found = [_read_job(path) for path in sorted(folders, key=_natural)]
    told = [job for job in found if job.record]
    known = [job.overrides for job in told]
    waiting = [Job("", overrides) for overrides in map(pairs, planned(folder)) if overrides not in known]
    # A job that ended before it could say what it was is one of those that the plan misses.
    silent = [job for job in found if not job.record][len(waiting) :]
    return [*told, *silent, *waiting]


def pairs(overrides: Sequence[str]) -> dict[str, str]:
    """`["ablation=full", "+a.b=1"]` as `{"ablation": "full", "a.b": "1"}`.

    Without what says only where a job goes and that it may go on from there: `out=DIR` and `ckpt_path=last`.
    """
    split = (override.lstrip("+").partition("=") for override in overrides)
    return {key: value for key, _, value in split if key != "out" and (key, value) != ("ckpt_path", "last")}


def _natural(path: Path) -> list[str | int]:
    """A key that sorts `seed=10` behind `seed=9`."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]


def _read_job(folder: Path) -> Job:
    record = _read_json(folder / "run.json")
    if record is None:
        return Job(folder.name)
    config = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
    assert isinstance(config, dict)
    named = {str(key): value for key, value in config.items()}
    return Job(folder.name, pairs(record["overrides"]), named, record, _read_json(folder / "metrics.json"))


def _read_json(path: Path) -> dict[str, Any] | None:
    """None where there is no such file or only part of one: a job that was killed may leave the latter."""
    try:
        return json.loads(path.read_text())
    except (FileNotFoundError, json.JSONDecodeError):
        return None


SCORES, MODES = "metrics.json", "hidden_modes.json"
NEEDED = {SCORES: ("data_set", "resolution", "scenes"), MODES: ()}
"""Of a protocol, by name of the file."""
REGIONS = ("full", "object")
HOW = "make them with `completesplat test ckpt=RUN/checkpoints/last.ckpt out=DIR`"


@dataclass(frozen=True)
class Run:
    """One file of results: where it lies below the folder, how it was measured, and its entries by predictor."""

    name: str
    protocol: dict[str, Any]
    entries: dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Found:
    """All results below a folder, and a line for each file that could not be used."""

    scores: list[Run] = field(default_factory=list)
    modes: list[Run] = field(default_factory=list)
    sweeps: list[Path] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def find(folder: Path) -> Found:
    """Search a folder and all below it.

    Raises:
        CompleteSplatError: there is no such folder, or no results in it.
    """
    if not folder.is_dir():
        raise CompleteSplatError(f"runs={folder}: no such folder")
    found = Found(sweeps=sorted(path.parent for path in folder.rglob("multirun.yaml")))
    paths = sorted([*folder.rglob(SCORES), *folder.rglob(MODES)])
    if not paths:
        raise CompleteSplatError(f"runs={folder}: no {SCORES} and no {MODES} in it or below it; {HOW}")
    for path in paths:
        try:
            name = str(path.parent.relative_to(folder))
            (found.scores if path.name == SCORES else found.modes).append(_read(path, name))
        except ValueError as error:
            found.warnings.append(f"{path}: left out, {error}")
    return found


def _read(path: Path, name: str) -> Run:
    """Raises ValueError with the reason if the file is not what it should be."""
    content = _object(path)
    if path.name == MODES:
        protocol, entries = _object(path.with_name("protocol.json")), content
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
    return Run(name, protocol, scored)


def _is_entry(entry: dict[str, Any]) -> bool:
    """Whether regions hold views, and views hold metrics, as far as there are any."""
    views = [entry.get(region, {}) for region in REGIONS]
    parts = [part for view in views if isinstance(view, dict) for part in view.values()]
    return all(isinstance(part, dict) for part in [*views, *parts, entry.get("seconds") or {}])


def _object(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path.name} is missing beside it") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"it cannot be read as JSON ({' '.join(str(error).split())})") from None
    if not isinstance(content, dict):
        raise ValueError("it holds no mapping")
    return content


SCENE, RECORD, CONFIG = "scene.json", "run.json", "config.yaml"
ROWS = ("samplers.json", "controls.json", "depth.json")
"""What `completesplat report NAME` leaves beside its figure: settings and rows."""
FIGURES = {"": "*.png", "pictures": "step_*.png", "samples": "*.png"}
"""Subfolders of a run, and the pictures in each."""
SKIPPED = {"checkpoints", "weights", "images", "masks", "depths"}
"""Folders without anything to show that may hold very much."""


@dataclass(frozen=True)
class Folder:
    """One run: its name below the searched folder, and the figures that lie in it, by subfolder."""

    path: Path
    name: str
    figures: dict[str, list[Path]] = field(default_factory=dict)


@dataclass(frozen=True)
class Folders:
    """All that a page shows, in the order of the folders' names."""

    runs: list[Folder]
    predictions: list[Folder]


def find_folders(folder: Path, out: Path) -> Folders:
    """Search a folder and all below it, except where the page goes.

    Raises:
        CompleteSplatError: there is no such folder, or nothing to show in it.
    """
    if not folder.is_dir():
        raise CompleteSplatError(f"runs={folder}: no such folder")
    found = Folders([], [])
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if name not in SKIPPED and not name.startswith("."))
        path = Path(place)
        if path.resolve() == out.resolve():
            continue
        name = folder.resolve().name if path == folder else path.relative_to(folder).as_posix()
        if SCENE in files:
            found.predictions.append(Folder(path, name))
        elif RECORD in files or "multirun.yaml" in files or {*ROWS, "metrics.json", "hidden_modes.json"} & {*files}:
            figures = {part: sorted((path / part).glob(pattern)) for part, pattern in FIGURES.items()}
            run = Folder(path, name, {part: paths for part, paths in figures.items() if paths})
            if run.figures or {*ROWS, "metrics.json", "hidden_modes.json"} & {*files}:
                found.runs.append(run)
    if not found.runs and not found.predictions:
        raise CompleteSplatError(
            f"runs={folder}: nothing to show in it or below it; `completesplat fit`, `test`, `predict` and `report` "
            "write what a page is made of"
        )
    return found


def origin(path: Path, levels: int = 1) -> dict[str, str]:
    """Command, date and commit of what lies in a folder, as far as it or its parents (`levels` of them) say."""
    for place in [path, *path.parents[:levels]]:
        record = read_object(place / RECORD)
        if record:
            command = record.get("command")
            return {
                "command": _command(command) if isinstance(command, list) else "",
                "started": str(record.get("started") or ""),
                "commit": str(record.get("commit") or ""),
            }
    return {"command": "", "started": "", "commit": ""}


def read_object(path: Path) -> dict[str, Any]:
    """A file of JSON with an object in it; an empty one where there is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _command(parts: Sequence[Any]) -> str:
    """As it could be typed: the first part is the program and its verb."""
    return " ".join([str(part) for part in parts[:1]] + [shlex.quote(str(part)) for part in parts[1:]])
