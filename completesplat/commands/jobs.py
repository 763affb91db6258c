"""The jobs of a sweep and single runs: their folders, locks and records, and how they continue."""

import gc
import hashlib
import json
import logging
import math
import os
import platform
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from hydra.utils import get_method, instantiate
from omegaconf import OmegaConf

from completesplat import __version__
from completesplat.commands.protocol import git_commit, write_json
from completesplat.errors import CompleteSplatError
from completesplat.files import atomic_path, writing
from completesplat.results.runs import typed
from completesplat.settings.checks import check_verb
from completesplat.settings.options import conf_folder, meant
from completesplat.settings.schema import check_settings
from completesplat.signals import Interrupted, ended_by_signals

LONGEST_NAME = 120
CONFIG, RECORD, METRICS = "config.yaml", "run.json", "metrics.json"
LAST = "checkpoints/last.ckpt"
LOCK = ".lock"
PROCESS_OF_JOB = "--process-of"
MAY_CHANGE = (
    *("ckpt_path", "data.allow_changed", "optimized_metric"),
    *("trainer.devices", "trainer.num_nodes", "trainer.strategy"),
)
"""Settings that may differ when a run continues; of the last one, also all settings below it."""
VARIABLES_OF_PROCESSES = ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK", "LOCAL_RANK", "WORLD_SIZE")


class SettingsOfWorkingFolder(SearchPathPlugin):
    """Hydra plugin that finds further options of the config groups in `./conf`; the package's own come first."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append `./conf`, if it exists, to the search path (Hydra calls this method)."""
        folder = Path.cwd() / "conf"
        if folder.is_dir() and not folder.samefile(conf_folder()):
            search_path.append("working-folder", f"file://{folder}")


def use_working_folder() -> None:
    """Append the working folder to `sys.path`, and its `conf` to Hydra's search path; each process must call this."""
    folder = str(Path.cwd())
    if not {"", folder} & set(sys.path):
        sys.path.append(folder)
    Plugins.instance().register(SettingsOfWorkingFolder)


def composed(verb: str, *overrides: str) -> Any:
    """Return a verb's config, as the command line would compose it in this folder, without starting anything."""
    use_working_folder()
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        return compose(verb, overrides=list(overrides))


def one_of_several() -> bool:
    """Return whether torchrun (`LOCAL_RANK`) or srun (`SLURM_STEP_NUM_TASKS`) started several of this process."""
    return "LOCAL_RANK" in os.environ or int(os.environ.get("SLURM_STEP_NUM_TASKS", 1)) > 1


def is_first() -> bool:
    """Return whether this process is alone, or the first that torchrun (`RANK`) or srun (`SLURM_PROCID`) started."""
    return int(os.environ.get("RANK", os.environ.get("SLURM_PROCID", 0))) == 0


class LogFile(logging.FileHandler):
    """Hydra's log file of a job. A link at its path is removed, not followed."""

    def __init__(self, filename: str, mode: str = "a") -> None:
        if os.path.islink(filename):
            os.unlink(filename)
        super().__init__(filename, mode)


@contextmanager
def alone_in(out: Path) -> Iterator[None]:
    """Hold the lock of a job's directory in the job's first process; the lock file names process and computer.

    The operating system releases the lock when the process ends, for whatever reason.

    Raises:
        CompleteSplatError: another process holds the lock, or its path is a link or a folder.
    """
    path = out / LOCK
    if not is_first():
        yield
        return
    if path.is_symlink() or path.is_dir():
        raise CompleteSplatError(f"{path}: is a link or a folder, and the lock is a file; remove it")
    try:
        with writing(path):
            lock = FileLock(path).acquire(blocking=False)
    except Timeout:
        holder = path.read_text().split()
        named = f"process {holder[0]} on {holder[1]}" if len(holder) > 1 else "another process"
        message = f"{out}: {named} is at work in it: wait for it or end it, or choose another out=DIR"
        raise CompleteSplatError(message) from None
    with lock:
        with writing(path):
            path.write_text(f"{os.getpid()}\n{platform.node()}\n")
        yield


def at_work(out: Path) -> bool:
    """Return whether a process of this computer holds the lock of a job's directory."""
    path = out / LOCK
    if not path.is_file():
        return False
    try:
        with FileLock(path).acquire(blocking=False):
            return False
    except (Timeout, OSError):
        return True


def sweep_arguments(verb: str, arguments: list[str], run_name: str) -> list[str]:
    """Return arguments to add for a sweep: its directory, and in it one for each job, named by the swept settings.

    Raises:
        CompleteSplatError: this is one of several processes that a launcher started, each of which would sweep.
    """
    if one_of_several():
        message = "a sweep (-m) starts the processes of its jobs itself: start it once, without torchrun or srun"
        raise CompleteSplatError(message)
    keys = [override.split("=")[0] for override in arguments]
    added = [] if "out" in keys else [f"out=outputs/{verb}/{run_name}"]
    if verb == "fit" and "ckpt_path" not in keys:
        added.append("ckpt_path=last")
    swept = swept_keys(arguments)
    if swept and "hydra.sweep.subdir" not in keys:
        added.append(f"hydra.sweep.subdir=${{job_name:{','.join(swept)}}}")
    return added


def swept_keys(arguments: list[str]) -> list[str]:
    """Return the keys to which a command line gives several values (`seed=0,1`, `ablation=glob(*)`), in its order."""
    overrides = [argument for argument in arguments if "=" in argument and not argument.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(overrides)
    return [override.key_or_group for override in parsed if override.is_sweep_override()]


def job_name(*keys: str, _root_: Any) -> str:
    """Return the directory name for the job that Hydra is about to start: `ablation-no_skips+seed-0`.

    It has no equals signs and commas, so that paths into the directory need no quotes in Hydra's overrides.
    """
    values = dict(override.lstrip("+~").split("=", 1) for override in _root_.hydra.overrides.task if "=" in override)
    full = "+".join(f"{key}-{values[key]}" for key in keys if key in values)
    name = re.sub(r"[^\w.+-]+", "_", full)
    if name == full and len(name) <= LONGEST_NAME:
        return name
    return f"{name[:LONGEST_NAME]}-{hashlib.sha256(full.encode()).hexdigest()[:8]}"


def run_job(verb: str, config: Any, program: str, given: list[str]) -> float | None:
    """Run one job in its own directory, record its command and config there, and return the value of `optimized`.

    A job with `ckpt_path=last` is not repeated if its directory holds its results; see `is_finished`. The user started
    `program` with the arguments `given` behind the verb.
    """
    use_working_folder()  # a cluster may have started this process
    hydra_config = HydraConfig.get()
    out = Path(hydra_config.runtime.output_dir)
    OmegaConf.set_struct(config, False)
    config.out = str(out)
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    if is_finished(out, resolved):
        print(f"{out}: finished before, not repeated")
        return optimized(config.get("optimized_metric"), out)
    first = is_first()
    try:
        with ended_by_signals():
            if first:
                with atomic_path(out / CONFIG) as temporary:  # other processes may be reading it
                    OmegaConf.save(resolved, temporary)
                _record(out / RECORD, [f"completesplat {verb}", *given], list(hydra_config.overrides.task))
            for key in ("checkpoint", "autoreconstructor_checkpoint"):
                # The path may refer to the job's choices (`hydra:runtime.choices`), which `start` cannot resolve.
                if OmegaConf.select(config, f"model.{key}") is not None:
                    config.model[key] = resolved["model"][key]
            with _for_other_processes([program, verb, f"{PROCESS_OF_JOB}={os.getpid()}:{out}"]):
                start(verb, config, out)
    except Interrupted as stop:
        if first:
            print(_said(stop, verb, given, out), file=sys.stderr)
        raise
    print(out)
    return optimized(config.get("optimized_metric"), out)


def optimized(metric: str | None, out: Path) -> float | None:
    """Return a finished job's metric for a sweeper such as Optuna: NaN if not finite, None if no metric is asked for.

    Raises:
        CompleteSplatError: the job has no metric of this name; the message lists those that it has.
    """
    if metric is None:
        return None
    figures = json.loads((out / METRICS).read_text())
    lost = {entry.partition(": ")[0] for entry in figures.get("not_finite", [])}
    known = [name for name, x in figures.items() if name in lost or isinstance(x, float)]
    if metric not in known:
        available = f"there are {', '.join(known)}{meant(metric, known)}"
        raise CompleteSplatError(f"optimized_metric={metric}: no figure in {out / METRICS}, {available}")
    return math.nan if metric in lost else float(figures[metric])


def _said(stop: Interrupted, verb: str, given: list[str], out: Path) -> str:
    """Return one line: the signal that ended a job, its checkpoint, and the command to continue the job or sweep."""
    hydra_config, begun = HydraConfig.get(), (out / LAST).is_file()
    of_a_sweep = hydra_config.mode == RunMode.MULTIRUN
    dropped = ("out=", "ckpt_path=") if begun and not of_a_sweep else ("out=",)
    again = [f"completesplat {verb}", *(argument for argument in given if not argument.startswith(dropped))]
    again += ["ckpt_path=last"] if begun and not of_a_sweep else []
    again.append(f"out={hydra_config.sweep.dir if of_a_sweep else out}")
    checkpoint = f"; the checkpoint is {out / LAST}" if begun else ""
    return f"ended by {stop.signal.name}{checkpoint}; {'go on' if begun else 'start again'} with: {typed(again)}"


def start(verb: str, config: Any, out: Path) -> None:
    """Check the settings and call the function that the config names as its task, or else the verb's `run`."""
    with importing():
        check_verb(verb, config)
        if config.get("task") is None:
            run = partial(import_module(f"completesplat.commands.{verb}").run, config, out)
        else:
            settings: Any = OmegaConf.to_container(config.task, resolve=True)
            check_settings(get_method(settings["_target_"]), settings)
            run = partial(instantiate, config.task, out=out, _convert_="all")
    run()


@contextmanager
def importing() -> Iterator[None]:
    """Pause the garbage collector during imports, because it took a fifth of a prediction's time.

    The objects that exist after the first import of torch are frozen: the collector does not examine them again.
    """
    before = "torch" in sys.modules
    gc.disable()
    try:
        yield
    finally:
        if not before and "torch" in sys.modules:
            gc.freeze()
        gc.enable()


def is_finished(out: Path, config: Any) -> bool:
    """Return whether a job's directory holds its results, for jobs that can continue a run (`ckpt_path`).

    Raises:
        CompleteSplatError: the directory holds a run that would be lost, or that had other settings.
    """
    begun = (out / LAST).is_file() or (out / METRICS).is_file()
    if "ckpt_path" not in config or not begun or not (out / CONFIG).is_file():
        return False
    if config["ckpt_path"] != "last":
        raise CompleteSplatError(f"{out} holds a run: continue it with ckpt_path=last, or choose another out=DIR")
    different = _differences(OmegaConf.to_container(OmegaConf.load(out / CONFIG)), config)
    different = {key for key in different if key not in MAY_CHANGE and not key.startswith(f"{MAY_CHANGE[-1]}.")}
    if different:
        first = min(different, key=lambda key: (key.count("."), key))  # `model` repeats settings from outside it
        raise CompleteSplatError(f"{out} holds a run with another {first}: choose another out=DIR")
    return (out / METRICS).is_file()


def _differences(one: Any, other: Any, key: str = "") -> set[str]:
    """Return the keys of the settings that differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        return {
            name
            for part in one.keys() | other.keys()
            for name in _differences(one.get(part), other.get(part), f"{key}.{part}".lstrip("."))
        }
    return set() if one == other else {key}


def _record(path: Path, command: list[str], overrides: list[str]) -> None:
    """Write `run.json`: version, command and overrides, and the times of the start and of continuations."""
    now = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    record: dict[str, Any] = {"version": __version__, "commit": git_commit()}
    record |= {"command": command, "overrides": overrides, "started": now}
    if path.is_file() and (path.parent / LAST).is_file():
        earlier = json.loads(path.read_text())
        record |= {"started": earlier["started"], "continued": [*earlier.get("continued", []), now]}
    write_json(path, record)


@contextmanager
def _for_other_processes(arguments: list[str]) -> Iterator[None]:
    """Make the processes that Lightning starts for further devices work on this job.

    Lightning repeats the program's arguments, which in a sweep would start a second sweep, and adds Hydra's settings if
    Hydra is active; so both are replaced. At the end Lightning's variables and process group are removed: with them,
    the next job of a sweep would wait for this job's processes instead of starting its own.
    """
    program_arguments, hydra_config = sys.argv, HydraConfig.instance().cfg
    variables = {name: os.environ.get(name) for name in VARIABLES_OF_PROCESSES}
    sys.argv, HydraConfig.instance().cfg = arguments, None
    try:
        yield
    finally:
        sys.argv, HydraConfig.instance().cfg = program_arguments, hydra_config
        torch = sys.modules.get("torch")
        if torch is not None and torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
        for name in VARIABLES_OF_PROCESSES:
            os.environ.pop(name, None)
        os.environ.update({name: value for name, value in variables.items() if value is not None})
