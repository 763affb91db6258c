"""The jobs of a sweep's folder: what each was told to do, and what came of it."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from completesplat.reports.sweeps.planned import planned

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
    found = [_read(path) for path in sorted(folders, key=_natural)]
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


def _read(folder: Path) -> Job:
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
