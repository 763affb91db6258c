"""What is said below the table: what is missing, what does not compare, and where the figures come from."""

import re
import shlex
from collections.abc import Callable, Sequence
from typing import Any

from completesplat.reports.machine import machine
from completesplat.reports.sweeps.jobs import Job
from completesplat.reports.sweeps.labels import SEED
from completesplat.reports.sweeps.rows import disagreeing

# An absolute path inside an argument, up to its last part.
FOLDERS = re.compile(r"""(?<![^=,\[\s'"])/(?:[^/,\]\s'"]+/)+(?=[^/,\]\s'"])""")


def remarks(jobs: Sequence[Job], rows: Sequence[dict[str, Any]], label: Callable[[Job], str]) -> list[str]:
    """Sentences: how many jobs have finished, which have not, what must not be compared, commit, machine and date."""
    finished = [job for job in jobs if job.metrics is not None]
    said = [f"{len(finished)} of {len(jobs)} jobs have finished."]
    missing = [_described(job, label) for job in jobs if job.metrics is None]
    if missing:
        said.append(f"Not finished: {'; '.join(missing)}.")
    return [*said, *_incomparable(finished, rows), _commits(jobs), _machine()]


def commands(jobs: Sequence[Job]) -> list[str]:
    """The commands that started the jobs, usually one. Of absolute paths only the last part is told."""
    given = (job.record["command"] for job in jobs if job.record)
    lines = (" ".join([program, *map(shlex.quote, arguments)]) for program, *arguments in given)
    return list(dict.fromkeys(FOLDERS.sub(".../", line) for line in lines))


def _described(job: Job, label: Callable[[Job], str]) -> str:
    """The job's folder; `no_skips, seed=1` where there is none yet."""
    seed = [f"seed={job.overrides[SEED]}"] if SEED in job.overrides else []
    return job.name or ", ".join([label(job), *seed])


def _incomparable(finished: Sequence[Job], rows: Sequence[dict[str, Any]]) -> list[str]:
    mixed = [row for row in rows if isinstance(row["scenes"], str) and row["seeds"] is not None]
    said = [f"{row['ablation']} has seen the views that it is scored on." for row in rows if row["upper_bound"]]
    said += [f"{row['ablation']}: its jobs were tested on different scenes ({row['scenes']})." for row in mixed]
    if len({row["scenes"] for row in rows if row["seeds"] is not None}) > 1:
        said.append("The rows were not tested on equally many scenes and do not compare.")
    for predictor in disagreeing(finished):
        said.append(f"{predictor} does not score the same in all jobs, so they differ in their test data; its mean.")
    return said


def _commits(jobs: Sequence[Job]) -> str:
    known = list(dict.fromkeys(job.record["commit"] or "unknown" for job in jobs if job.record))
    return f"Commit{'s' if len(known) > 1 else ''} {', '.join(known) or 'unknown'}."


def _machine() -> str:
    here = machine()
    hardware = ", ".join([here["processor"], f"{here['cores']} cores", *([here["gpu"]] if "gpu" in here else [])])
    software = f"{here['system']}, Python {here['python']}, torch {here['torch']}"
    return f"Summary of {here['date']}, made on {hardware}, {software}."
