"""Jobs, single or of a sweep: their folders, locks and records, and how they continue."""

import json
import logging
import os
import platform
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from completesplat.commands.inputs import check_inputs
from completesplat.errors import CompleteSplatError
from completesplat.evaluation.provenance import git_commit
from completesplat.evaluation.records import job_entries, read_mapping
from completesplat.files import UNFINISHED, atomic_path, write_bytes, write_json, writing
from completesplat.imports import importing, postponing
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
LOCK = ".lock"
PROCESS_OF_JOB = "--process-of"
OF_MACHINES = ("trainer.devices", "trainer.num_nodes", "trainer.strategy")
MAY_CHANGE = ("ckpt_path", "data.allow_changed", "optimized_metric", "test", *OF_MACHINES)
"""Settings that may differ when a run continues, with all settings below them; also its end (`ENDS`)."""
ENDS = ("trainer.max_steps", "trainer.max_epochs", "trainer.max_time")
VARIABLES_OF_PROCESSES = ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK", "LOCAL_RANK", "WORLD_SIZE")


def one_of_several() -> bool:
    """Return whether torchrun (`LOCAL_RANK`) or srun (`SLURM_STEP_NUM_TASKS`) started several of this process."""
    return "LOCAL_RANK" in os.environ or int(os.environ.get("SLURM_STEP_NUM_TASKS", 1)) > 1


def is_first_process() -> bool:
    """Return whether this process is alone, or the first that torchrun (`RANK`) or srun (`SLURM_PROCID`) started."""
    return int(os.environ.get("RANK", os.environ.get("SLURM_PROCID", 0))) == 0


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


@contextmanager
def hold_job_lock(folder: Path, out: Path) -> Iterator[None]:
    """Hold the lock of a job's folder in the job's first process; the lock file names process and computer.

    The operating system releases the lock when the process ends, for whatever reason. The unfinished files of a killed
    process are removed, except below the folders of other jobs.

    Raises:
        CompleteSplatError: another process holds the lock, or its path is a link or a folder; or a job that is no shard
            and one that is would write into `out` at the same time.
    """
    path = folder / LOCK
    if not is_first_process():
        yield
        return
    if path.is_symlink() or path.is_dir():
        raise CompleteSplatError(f"{path}: is a link or a folder, and the lock is a file; remove it")
    try:
        with writing(path):
            lock = FileLock(path).acquire(blocking=False)
    except Timeout:
        raise _busy(folder) from None
    with lock:
        for other in out.glob("shard-*") if folder == out else [out]:
            if is_running(other):
                raise _busy(other)
        with writing(path):
            path.write_text(f"{os.getpid()}\n{platform.node()}\n")
        for place, folders, names in os.walk(folder):
            folders[:] = [name for name in folders if not Path(place, name, LOCK).exists()]
            for name in filter(UNFINISHED.fullmatch, names):
                Path(place, name).unlink(missing_ok=True)
        yield


def _busy(folder: Path) -> CompleteSplatError:
    holder = (folder / LOCK).read_text().split()
    named = f"process {holder[0]} on {holder[1]}" if len(holder) > 1 else "another process"
    return CompleteSplatError(f"{folder}: {named} is at work in it: wait for it or end it, or choose another out=DIR")


def is_running(out: Path) -> bool:
    """Return whether a process of this computer holds the lock of a job's directory."""
    path = out / LOCK
    if not path.is_file():
        return False
    try:
        with FileLock(path).acquire(timeout=0.2):  # for which another process may look, too
            return False
    except PermissionError:  # another user's run, which a lock cannot tell about
        return False
    except (Timeout, OSError):
        return True


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
    try:
        recorded = folder, job_entries(verb, given, folder), resolved
        with ended_by_signals(), _recorded(*recorded) if first else nullcontext():
            for key in ("checkpoint", "autoreconstructor_checkpoint"):
                # The path may refer to the job's choices (`hydra:runtime.choices`), which `start` cannot resolve.
                if path := OmegaConf.select(config, f"model.{key}"):
                    config.model[key] = str(Path(path, LAST)) if Path(path).is_dir() else path
            with _for_other_processes([program, verb, f"{PROCESS_OF_JOB}={os.getpid()}:{folder}"]):
                result = start(verb, config, out)
    except Interrupted as stop:
        if first:
            print(_how_to_continue(stop, verb, given, out), file=sys.stderr)
        raise
    print(out, *([result] if isinstance(result, str) else []), sep="\n")
    return optimized(config.get("optimized_metric"), out)


def optimized(metric: str | None, out: Path) -> float | None:
    """Return a job's metric for sweepers (NaN: not finite, None: not asked); raise CompleteSplatError if absent."""
    if metric is None:
        return None
    known = {name: value for name, value in read_mapping(out / METRICS).items() if isinstance(value, float)}
    if metric not in known:
        available = f"there are {', '.join(known)}{did_you_mean(metric, known)}"
        raise CompleteSplatError(f"optimized_metric={metric}: no figure in {out / METRICS}, {available}")
    return known[metric]


def _how_to_continue(stop: Interrupted, verb: str, given: list[str], out: Path) -> str:
    """Return one line: the signal that ended a job, its checkpoint, and the command to continue the job or sweep."""
    hydra_config = HydraConfig.get()
    begun = (out / LAST).is_file()
    sweep = hydra_config.mode == RunMode.MULTIRUN
    replaced = ("out=", "ckpt_path=") if begun and not sweep else ("out=",)
    again = ["completesplat", verb, *(argument for argument in given if not argument.lstrip("-").startswith(replaced))]
    again += ["ckpt_path=last"] if begun and not sweep else []
    again.append(f"out={hydra_config.sweep.dir if sweep else out}")
    checkpoint = f"; the checkpoint is {out / LAST}" if begun else ""
    return f"ended by {stop.signal.name}{checkpoint}; {'go on' if begun else 'start again'} with: {shlex.join(again)}"


def start(verb: str, config: DictConfig, out: Path) -> object:
    """Check the settings and call the config's task or else the verb's `run`; return its result (a text is printed)."""
    with importing(), postponing() if verb == "predict" else nullcontext():
        check_values(verb, config)
        check_inputs(verb, config)
        check_parts_of_verb(verb, config)
        if config.get("task") is None:
            run = partial(import_module(f"completesplat.commands.{verb}").run, config, out)
        else:
            run = partial(instantiate, config.task, out=out, _convert_="all")
    return run()


def is_finished(out: Path, config: Mapping[str, object], overrides: Sequence[str] = ()) -> bool:
    """Return whether a job's directory holds its results up to its end, for jobs that can continue (`ckpt_path`).

    Raises:
        CompleteSplatError: the directory holds a run that would be lost, or that had other settings.
    """
    begun = (out / METRICS).is_file() or any((out / LAST).parent.glob("*.ckpt"))
    if "ckpt_path" not in config or not begun or not (out / CONFIG).is_file():
        return False
    if config["ckpt_path"] != "last":
        raise CompleteSplatError(f"{out} holds a run: continue it with ckpt_path=last, or choose another out=DIR")
    earlier = OmegaConf.load(out / CONFIG)
    _refuse_another_run(out, config, earlier, overrides)
    finished = (out / METRICS).is_file()
    if finished and _ends(config) != _ends(earlier):
        _refuse_earlier_end(out, _ends(config), _ends(earlier))
        return False
    if finished and config.get("test") and not OmegaConf.select(earlier, "test", default=True):
        raise CompleteSplatError(f"{out} is finished, without a test: completesplat test ckpt={out}")
    return finished


def _refuse_another_run(out: Path, config: Mapping[str, object], earlier: object, overrides: Sequence[str]) -> None:
    """Raise CompleteSplatError if a directory's run had settings that a run cannot continue with."""
    before = cast(dict[str, object], OmegaConf.to_container(earlier))
    different = _differences(before, config, (str(before.get("out") or "/nowhere"), str(config.get("out"))))
    others = {key for key in different if not key.startswith((*MAY_CHANGE, *ENDS))}
    if not others:
        return
    other_model = "model._target_" in others
    # `model` repeats settings from outside it.
    keys = [key for key in others if not key.startswith("model.") or key.removeprefix("model.") not in others]
    names = ["model"] if other_model else sorted(keys, key=lambda key: (key.count("."), key))
    listed = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    advice = "choose another out=DIR"
    if (out / LAST).is_file() and not other_model:
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
    if not isinstance(first, dict) or not isinstance(second, dict):
        if isinstance(first, str) and f"{first}/".startswith(f"{moved[0]}/"):
            first = moved[1] + first.removeprefix(moved[0])
        return set() if first == second else {key}
    parts = [(f"{key}.{part}".lstrip("."), part) for part in first.keys() | second.keys()]
    return {name for place, part in parts for name in _differences(first.get(part), second.get(part), moved, place)}


@contextmanager
def _recorded(out: Path, job: Mapping[str, object], config: Mapping[str, object]) -> Iterator[None]:
    """Record a job and its config; restore those of an earlier job if this one ends before it has written a file."""
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
    paths = [path for path in out.rglob("*") if path.name not in (LOCK, RECORD, CONFIG, "wandb_id")]
    paths = [path for path in paths if path.suffix != ".log" and "wandb" not in path.relative_to(out).parts]
    return {(path.stat().st_ino, path.stat().st_mtime_ns) for path in paths if path.is_file()}


def _record(out: Path, job: Mapping[str, object], config: Mapping[str, object]) -> Path | None:
    """Write `run.json` with `job_entries`, times and earlier ends; rename earlier results and return their new name."""
    path = out / RECORD
    now = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    record: dict[str, Any] = {"version": __version__, "commit": git_commit(), **job, "started": now}
    renamed = None
    if path.is_file() and (out / LAST).is_file():
        earlier = json.loads(path.read_text())
        record |= {"started": earlier["started"], "continued": [*earlier.get("continued", []), now]}
        record |= {"earlier_ends": earlier.get("earlier_ends", [])}
        if "ckpt_path" in config and (before := _ends(OmegaConf.load(out / CONFIG))) != _ends(config):
            record["earlier_ends"] += [{"until": now, "command": earlier["command"], **before}]
            if (results := out / METRICS).is_file():
                renamed = results.rename(out / f"metrics_{json.loads(results.read_text())['steps']}_steps.json")
    write_json(path, record)
    return renamed


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
