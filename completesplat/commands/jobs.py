"""Jobs, single or of a sweep: their folders and records, and how they continue."""

import gc
import json
import logging
import os
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from completesplat.commands.inputs import check_inputs
from completesplat.commands.locks import LOCK, is_first_process
from completesplat.errors import CompleteSplatError
from completesplat.evaluation.provenance import git_commit
from completesplat.evaluation.records import job_entries, read_mapping
from completesplat.files import atomic_path, write_bytes, write_json
from completesplat.settings.checks import check_parts_of_verb, check_values
from completesplat.settings.composition import shard_folder, use_working_folder
from completesplat.settings.options import did_you_mean
from completesplat.signals import Interrupted, ended_by_signals
from completesplat.version import __version__
from completesplat.weights import RUN_CHECKPOINT

CONFIG = "config.yaml"
RECORD = "run.json"
METRICS = "metrics.json"
LAST = RUN_CHECKPOINT
PROCESS_OF_JOB = "--process-of"
OF_MACHINES = ("trainer.devices", "trainer.num_nodes", "trainer.strategy")
SCORES_CLASS = "evaluation.scoring._target_"  # named otherwise in earlier versions, and not part of the training
MAY_CHANGE = ("ckpt_path", "data.allow_changed", "optimized_metric", "test", SCORES_CLASS, *OF_MACHINES)
"""Settings that may differ when a run continues, with all settings below them; also its end (`ENDS`)."""
ENDS = ("trainer.max_steps", "trainer.max_epochs", "trainer.max_time")
VARIABLES_OF_PROCESSES = ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK", "LOCAL_RANK", "WORLD_SIZE")


class LogFile(logging.FileHandler):
    """Hydra's log file of a job. A link at its path is removed, not followed."""

    def __init__(self, filename: str, mode: str = "a") -> None:
        if os.path.islink(filename):
            os.unlink(filename)
        super().__init__(filename, mode)


def job_folders(config: DictConfig) -> tuple[Path, Path]:
    """Return the folder of a job's record, and that of its results, which jobs that are its shards share."""
    folder = HydraConfig.get().runtime.output_dir
    return Path(folder), Path(folder.removesuffix(shard_folder(config)))


def run_job(verb: str, config: DictConfig, program: str, given: list[str]) -> float | None:
    """Run one job, record its command and config in its own folder, and return the value of `optimized`.

    A job with `ckpt_path=last` is not repeated if its directory holds its results; see `is_finished`. The user started
    `program` with the arguments `given` behind the verb.
    """
    use_working_folder()  # a cluster may have started this process
    hydra_config = HydraConfig.get()
    folder, out = job_folders(config)
    OmegaConf.set_struct(config, False)
    config.out = str(out)
    resolved = cast(dict[str, object], OmegaConf.to_container(config, resolve=True))
    if is_finished(out, resolved, hydra_config.overrides.task):
        print(f"{out}: finished before, not repeated")
        return optimized(config.get("optimized_metric"), out)
    first = is_first_process()
    recorded = _recorded(folder, job_entries(verb, given, folder), resolved) if first else nullcontext()
    others = _for_other_processes([program, verb, f"{PROCESS_OF_JOB}={os.getpid()}:{folder}"])
    try:
        with ended_by_signals(), recorded:
            _resolve_start_weights(config)
            with others:
                result = start(verb, config, out)
    except Interrupted as stop:
        if first:
            print(_how_to_continue(stop, verb, given, out), file=sys.stderr)
        raise
    print(out)
    if isinstance(result, str):
        print(result)
    return optimized(config.get("optimized_metric"), out)


def _resolve_start_weights(config: DictConfig) -> None:
    """Replace the folders of runs that a training starts from by their checkpoints.

    Their paths may refer to the job's choices (`hydra:runtime.choices`), which other processes cannot resolve.
    """
    for key in ("checkpoint", "autoreconstructor_checkpoint"):
        path = OmegaConf.select(config, f"model.{key}")
        if path:
            config.model[key] = str(Path(path, LAST)) if Path(path).is_dir() else path


def optimized(metric: str | None, out: Path) -> float | None:
    """Return a job's metric for sweepers (NaN: not finite, None: not asked).

    Raises:
        CompleteSplatError: the job has no such metric.
    """
    if metric is None:
        return None
    figures = {name: value for name, value in read_mapping(out / METRICS).items() if isinstance(value, float)}
    if metric not in figures:
        available = f"there are {', '.join(figures)}{did_you_mean(metric, figures)}"
        raise CompleteSplatError(f"optimized_metric={metric}: no figure in {out / METRICS}, {available}")
    return figures[metric]


def _how_to_continue(stop: Interrupted, verb: str, given: list[str], out: Path) -> str:
    """Return one line: the signal that ended a job, its checkpoint, and the command to continue the job or sweep."""
    hydra_config = HydraConfig.get()
    sweep = hydra_config.mode == RunMode.MULTIRUN
    begun = (out / LAST).is_file()
    goes_on = begun and not sweep
    replaced = ("out=", "ckpt_path=") if goes_on else ("out=",)
    command = ["completesplat", verb]
    command += [argument for argument in given if not argument.startswith(replaced)]
    if goes_on:
        command.append("ckpt_path=last")
    command.append(f"out={hydra_config.sweep.dir if sweep else out}")
    if begun:
        return f"ended by {stop.signal.name}; the checkpoint is {out / LAST}; go on with: {shlex.join(command)}"
    return f"ended by {stop.signal.name}; start again with: {shlex.join(command)}"


def start(verb: str, config: DictConfig, out: Path) -> object:
    """Check the settings and call the config's task or else the verb's `run`.

    Returns:
        The result of `run` or of the task. A text is printed.
    """
    first = "torch" not in sys.modules
    gc.disable()  # it takes a third of a prediction's time to examine all that is imported again and again
    try:
        check_values(verb, config)
        check_inputs(verb, config)
        check_parts_of_verb(verb, config)
        if config.get("task") is None:
            run = partial(import_module(f"completesplat.commands.{verb}").run, config, out)
        else:
            run = partial(instantiate, config.task, out=out, _convert_="all")
    finally:
        if first:
            gc.freeze()
        gc.enable()
    return run()


def is_finished(out: Path, config: Mapping[str, object], overrides: Sequence[str] = ()) -> bool:
    """Return whether a job's directory holds its results up to its end, for jobs that can continue (`ckpt_path`).

    Raises:
        CompleteSplatError: the directory holds a run that would be lost, or that had other settings.
    """
    finished = (out / METRICS).is_file()
    begun = finished or any((out / LAST).parent.glob("*.ckpt"))
    if "ckpt_path" not in config or not begun or not (out / CONFIG).is_file():
        return False
    if config["ckpt_path"] != "last":
        raise CompleteSplatError(f"{out} holds a run: continue it with ckpt_path=last, or choose another out=DIR")
    earlier = OmegaConf.load(out / CONFIG)
    _refuse_another_run(out, config, earlier, overrides)
    if not finished:
        return False
    if _ends(config) != _ends(earlier):
        _refuse_earlier_end(out, _ends(config), _ends(earlier))
        return False
    if config.get("test") and not OmegaConf.select(earlier, "test", default=True):
        raise CompleteSplatError(f"{out} is finished, without a test: completesplat test ckpt={out}")
    return True


def _refuse_another_run(out: Path, config: Mapping[str, object], earlier: object, overrides: Sequence[str]) -> None:
    """Raise CompleteSplatError if a directory's run had settings that a run cannot continue with."""
    before = cast(dict[str, object], OmegaConf.to_container(earlier))
    moved = str(before.get("out") or "/nowhere"), str(config.get("out"))
    different = _differences(before, config, moved)
    others = {key for key in different if not key.startswith((*MAY_CHANGE, *ENDS))}
    if not others:
        return
    advice = "choose another out=DIR"
    if "model._target_" in others:
        raise CompleteSplatError(f"{out} holds a run with another model: {advice}")
    # `model` repeats settings from outside it.
    names = [key for key in others if key.removeprefix("model.") not in others - {key}]
    names.sort(key=lambda key: (key.count("."), key))
    listed = ", ".join(names[:3])
    if len(names) > 3:
        listed += f" and {len(names) - 3} more"
    if (out / LAST).is_file():
        same = [argument for argument in overrides if not argument.startswith(("out=", "ckpt_path="))]
        again = shlex.join(["completesplat", "fit", *same, f"ckpt_path={out / LAST}", "out=MORE"])
        advice = f"give all settings of {out / RECORD} again, or continue in another folder: {again}"
    raise CompleteSplatError(f"{out} holds a run with another {listed}: {advice}")


def _refuse_earlier_end(out: Path, ends: Mapping[str, Any], earlier: Mapping[str, Any]) -> None:
    """Raise CompleteSplatError unless a finished run can go on to its new end, which comes after the earlier one."""
    if not (out / LAST).is_file():
        raise CompleteSplatError(f"{out} has no {LAST} to continue from: choose another out=DIR")
    steps = json.loads((out / METRICS).read_text())["steps"]
    if 0 <= ends["trainer.max_steps"] <= steps:
        raise CompleteSplatError(f"trainer.max_steps={ends['trainer.max_steps']}: {out} has {steps} steps; give more")
    epochs = ends["trainer.max_epochs"]
    before = earlier["trainer.max_epochs"]
    unlimited = (None, -1)
    if epochs not in unlimited and (before in unlimited or epochs < before):
        raise CompleteSplatError(f"trainer.max_epochs={epochs} may end before the run in {out}: choose another out=DIR")


def _differences(first: object, second: object, moved: tuple[str, str], key: str = "") -> set[str]:
    """Return the keys of settings that differ by more than the folder's move."""
    if isinstance(first, dict) and isinstance(second, dict):
        names: set[str] = set()
        for part in first.keys() | second.keys():
            place = f"{key}.{part}" if key else part
            names |= _differences(first.get(part), second.get(part), moved, place)
        return names
    if isinstance(first, str) and f"{first}/".startswith(f"{moved[0]}/"):
        first = moved[1] + first.removeprefix(moved[0])
    return set() if first == second else {key}


@contextmanager
def _recorded(out: Path, job: Mapping[str, object], config: Mapping[str, object]) -> Iterator[None]:
    """Record a job and its config.

    Those of an earlier job are restored if this one ends before it has written a file.
    """
    earlier = {path: path.read_bytes() for path in (out / RECORD, out / CONFIG) if path.is_file()}
    before = _written(out)
    renamed = _record(out, job, config)
    with atomic_path(out / CONFIG) as temporary:  # other processes may be reading it
        OmegaConf.save(config, temporary)
    try:
        yield
    except BaseException:
        if _written(out) == before:
            for path, content in earlier.items():
                write_bytes(path, content)
            if renamed is not None:
                renamed.rename(out / METRICS)
        raise


def _written(out: Path) -> set[tuple[int, int]]:
    """Return inode and time of change of each file of a job but its lock, record, config, log and W&B's files."""
    files = set()
    for path in out.rglob("*"):
        is_record = path.name in (LOCK, RECORD, CONFIG, "wandb_id") or path.suffix == ".log"
        if is_record or "wandb" in path.relative_to(out).parts or not path.is_file():
            continue
        status = path.stat()
        files.add((status.st_ino, status.st_mtime_ns))
    return files


def _record(out: Path, job: Mapping[str, object], config: Mapping[str, object]) -> Path | None:
    """Write `run.json` with `job_entries`, times and earlier ends.

    Returns:
        The new name of earlier results, if there were any.
    """
    path = out / RECORD
    now = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    record: dict[str, Any] = {"version": __version__, "commit": git_commit(), **job, "started": now}
    renamed = None
    if path.is_file() and (out / LAST).is_file():
        earlier = json.loads(path.read_text())
        record["started"] = earlier["started"]
        record["continued"] = [*earlier.get("continued", []), now]
        record["earlier_ends"] = earlier.get("earlier_ends", [])
        if "ckpt_path" in config:
            ends = _ends(OmegaConf.load(out / CONFIG))
            if ends != _ends(config):
                record["earlier_ends"].append({"until": now, "command": earlier["command"], **ends})
                renamed = _rename_results(out)
    write_json(path, record)
    return renamed


def _rename_results(out: Path) -> Path | None:
    """Name the results of a run that goes on after their number of steps.

    Returns:
        The new path, or None if there are no results.
    """
    results = out / METRICS
    if not results.is_file():
        return None
    steps = json.loads(results.read_text())["steps"]
    return results.rename(out / f"metrics_{steps}_steps.json")


def _ends(config: object) -> dict[str, Any]:
    return {key: OmegaConf.select(OmegaConf.create(config), key) for key in ENDS}  # type: ignore[call-overload]


@contextmanager
def _for_other_processes(arguments: list[str]) -> Iterator[None]:
    """Make the processes that Lightning starts for further devices work on this job.

    Lightning repeats the program's arguments, which in a sweep would start a second sweep, and adds Hydra's settings if
    Hydra is active; so both are replaced. At the end Lightning's variables and process group are removed: with them,
    the next job of a sweep would wait for this job's processes instead of starting its own.
    """
    program_arguments = sys.argv
    hydra_config = HydraConfig.instance().cfg
    variables = {name: os.environ.get(name) for name in VARIABLES_OF_PROCESSES}
    sys.argv = arguments
    HydraConfig.instance().cfg = None
    try:
        yield
    finally:
        sys.argv = program_arguments
        HydraConfig.instance().cfg = hydra_config
        torch = sys.modules.get("torch")
        if torch is not None and torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
        for name in VARIABLES_OF_PROCESSES:
            os.environ.pop(name, None)
        os.environ.update({name: value for name, value in variables.items() if value is not None})
