"""Jobs of a sweep, read from the records and results in their folders."""

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import cast

from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from completesplat.evaluation.records import (
    CONFIG,
    RECORD,
    SCORES,
    FlatScores,
    Protocol,
    Record,
    bad_steps_of,
    read_mapping,
    read_record,
    sweep_folder,
    tested_predictors,
)
from completesplat.settings.sweeps import swept_values

SEED = "seed"
VALIDATION = "val/"
"""Beginning of the names of figures of validation, which no score of a test has."""
MULTIRUN = "multirun.yaml"
MOST_JOBS = 10_000


@dataclass(frozen=True)
class Job:
    """Job of a sweep: the name of its folder in the sweep's, its record, its config and its results.

    `test` and `protocol` are empty where nothing was tested. `validation` has the last figures of a training's
    validation, by the names under which they were logged (`val/psnr_novel`). `label` tells the job from the others of
    its sweep.
    """

    name: str
    overrides: dict[str, str] = field(default_factory=dict)
    config: Mapping[str, object] = field(default_factory=dict)
    record: Record = field(default_factory=Record)
    finished: bool = False
    steps: int = 0
    bad_steps: int = 0
    test: dict[str, FlatScores] = field(default_factory=dict)
    protocol: Protocol = field(default_factory=Protocol)
    validation: FlatScores = field(default_factory=dict)
    label: str = ""


def collect(*folders: Path) -> list[Job]:
    """Return the jobs of a sweep's folder that have started.

    Several folders are parts of one sweep on several machines. Settings that only locate a machine's files are then
    ignored, and if a job is in several parts, the one with the most progress is taken.
    """
    parts = [[_job(path, folder) for path in _job_folders(folder)] for folder in folders]
    return _labelled(parts[0] if len(parts) == 1 else _joined(parts))


def not_started(sweep: Path, jobs: Sequence[Job]) -> list[str]:
    """Return the settings of the jobs that Hydra's file in a sweep's folder names, and that have not started.

    They are not known of sweepers that choose the settings as they go.
    """
    try:
        config = OmegaConf.load(sweep / MULTIRUN)
        overrides = [str(text) for text in OmegaConf.select(config, "hydra.overrides.task")]
        sweeper = str(OmegaConf.select(config, "hydra.sweeper._target_"))
        lists = swept_values(overrides)
    except (OmegaConfBaseException, HydraException, YAMLError, OSError, ValueError, TypeError):
        return []
    if lists is None or not sweeper.endswith(".BasicSweeper") or math.prod(map(len, lists.values())) > MOST_JOBS:
        return []
    started = {frozenset(job.overrides.items()) for job in jobs}
    fixed = _pairs(text for text in overrides if text.lstrip("+").partition("=")[0] not in lists)
    waiting = []
    for values in product(*lists.values()):
        swept = dict(zip(lists, values, strict=True))
        if frozenset((fixed | swept).items()) not in started:
            waiting.append(", ".join(f"{key}={value}" for key, value in swept.items()))
    return waiting


def _job_folders(sweep: Path) -> Iterator[Path]:
    """Yield the folders, at any depth, with the record of a job of this sweep.

    Records of earlier versions, which name no sweep, count as jobs of the sweep that they lie in.
    """
    for place, folders, names in os.walk(sweep):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        path = Path(place)
        if path != sweep and RECORD in names:
            folders.clear()
            record = read_record(path)
            if "sweep" not in record or sweep_folder(record, path) == sweep:
                yield path


def _job(folder: Path, sweep: Path) -> Job:
    name = folder.relative_to(sweep).as_posix()
    record = read_record(folder)
    config = _read_config(folder)
    if not config or "overrides" not in record:
        return Job(name)
    metrics = read_mapping(folder / SCORES)
    protocol, test = tested_predictors(metrics)
    return Job(
        name,
        overrides=_pairs(record["overrides"]),
        config=config,
        record=record,
        finished=bool(metrics),
        steps=cast(int, metrics.get("steps", 0)),
        bad_steps=bad_steps_of(metrics),
        test=test,
        protocol=protocol,
        validation=_validation_figures(metrics),
    )


def _validation_figures(metrics: Mapping[str, object]) -> FlatScores:
    figures = {}
    for name, value in metrics.items():
        if name.startswith(VALIDATION) and isinstance(value, float):
            figures[name] = value
    return figures


def _read_config(folder: Path) -> Mapping[str, object]:
    """Return a job's config, or an empty one if it cannot be read, as when its writer was killed."""
    try:
        config = OmegaConf.to_container(OmegaConf.load(folder / CONFIG))
    except (OmegaConfBaseException, YAMLError, OSError, ValueError):
        return {}
    return cast(Mapping[str, object], config) if isinstance(config, dict) else {}


def _pairs(overrides: Iterable[str]) -> dict[str, str]:
    """Convert `["ablation=full", "+a.b=1"]` to `{"ablation": "full", "a.b": "1"}`.

    Leave out `out=DIR` and `ckpt_path=last`, which only say where a job writes and that it may resume there.
    """
    split = (override.lstrip("+").partition("=") for override in overrides)
    return {key: value for key, _, value in split if key != "out" and (key, value) != ("ckpt_path", "last")}


def _joined(parts: Sequence[list[Job]]) -> list[Job]:
    """Return the jobs of all parts of a sweep. A job in several parts is taken from the one with the most progress."""
    local = _local_settings(parts)
    best: dict[object, Job] = {}
    jobs = [job for part in parts for job in part]
    for job in sorted(jobs, key=lambda job: (job.finished, bool(job.record))):
        overrides = {key: value for key, value in job.overrides.items() if key not in local}
        best[frozenset(overrides.items()) or job.name] = replace(job, overrides=overrides)
    return list(best.values())


def _local_settings(parts: Sequence[list[Job]]) -> set[str]:
    """Return the settings whose value is a path that all jobs of a part share and that differs between the parts."""
    values: dict[str, list[set[str]]] = {}
    for number, jobs in enumerate(parts):
        for job in jobs:
            for key, value in job.overrides.items():
                values.setdefault(key, [set() for _ in parts])[number].add(value)
    local = set()
    for key, by_part in values.items():
        together = set.union(*by_part)
        shared_in_parts = max(map(len, by_part)) == 1
        if shared_in_parts and len(together) > 1 and all("/" in value for value in together):
            local.add(key)
    return local


def _labelled(jobs: Sequence[Job]) -> list[Job]:
    """Name the jobs by the overrides, except the seed, that differ between them.

    The choice of a config group is named by its value alone (`no_skips`), any other setting as `key=value`. A job
    without differing overrides takes the name of its experiment, or `all`.
    """
    all_overrides = [job.overrides for job in jobs if job.overrides]
    keys = dict.fromkeys(key for overrides in all_overrides for key in overrides if key != SEED)
    differing = [key for key in keys if len({overrides.get(key) for overrides in all_overrides}) > 1]

    def label(job: Job) -> str:
        groups = job.record.get("groups", {})
        given = {key: job.overrides[key] for key in differing if key in job.overrides}
        parts = [value if key in groups else f"{key}={value}" for key, value in given.items()]
        return ", ".join(parts) or job.overrides.get("experiment", "all")

    return [replace(job, label=label(job)) for job in jobs]
