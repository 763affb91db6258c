"""Sweeps: where their jobs go, so that a sweep that is started again continues, and one process starts them."""

import hashlib
import os
import re
from typing import Any

from completesplat.errors import CompleteSplatError

LONGEST_NAME = 120


def is_sweep(arguments: list[str]) -> bool:
    """Whether Hydra will start several jobs."""
    return "-m" in arguments or "--multirun" in arguments


def one_of_several() -> bool:
    """Whether a launcher started several of this process: torchrun (`LOCAL_RANK`) or srun (`SLURM_STEP_NUM_TASKS`)."""
    return "LOCAL_RANK" in os.environ or int(os.environ.get("SLURM_STEP_NUM_TASKS", 1)) > 1


def sweep_arguments(verb: str, arguments: list[str], run_name: str) -> list[str]:
    """What a sweep needs besides its own arguments: one directory, and in it one for each job, named by what is swept.

    Raises:
        CompleteSplatError: this is one of several processes that a launcher started, each of which would sweep.
    """
    if one_of_several():
        raise CompleteSplatError(
            "a sweep (-m) starts the processes of its jobs itself: start it once, without torchrun or srun"
        )
    keys = [override.split("=")[0] for override in arguments]
    added = [] if "out" in keys else [f"out=outputs/{verb}/{run_name}"]
    if verb == "fit" and "ckpt_path" not in keys:
        added.append("ckpt_path=last")
    swept = swept_keys(arguments)
    if swept and "hydra.sweep.subdir" not in keys:
        added.append(f"hydra.sweep.subdir=${{job_name:{','.join(swept)}}}")
    return added


def swept_keys(arguments: list[str]) -> list[str]:
    """Keys to which a command line gives several values (`seed=0,1`, `ablation=glob(*)`), in its order."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    overrides = [argument for argument in arguments if "=" in argument and not argument.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(overrides)
    return [override.key_or_group for override in parsed if override.is_sweep_override()]


def job_name(*keys: str, _root_: Any) -> str:
    """A directory's name for the job that Hydra is about to start: `ablation-no_skips+seed-0`.

    Without equals signs and commas, so that paths into it need no quotes in Hydra's overrides.
    """
    values = dict(override.lstrip("+~").split("=", 1) for override in _root_.hydra.overrides.task if "=" in override)
    full = "+".join(f"{key}-{values[key]}" for key in keys if key in values)
    name = re.sub(r"[^\w.+-]+", "_", full)
    if name == full and len(name) <= LONGEST_NAME:
        return name
    return f"{name[:LONGEST_NAME]}-{hashlib.sha256(full.encode()).hexdigest()[:8]}"
