"""Jobs, single or of a sweep: their folders, their start, and the command that continues an interrupted one."""

import gc
import logging
import math
import os
import shlex
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import cast

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from completesplat.commands.continuing import is_finished, recorded
from completesplat.commands.earlier_stage import start_checkpoint, take_architecture
from completesplat.commands.inputs import check_inputs
from completesplat.commands.locks import is_first_process
from completesplat.errors import CompleteSplatError, DivergenceError
from completesplat.evaluation.records import SCORES, job_entries, read_mapping
from completesplat.settings.checks import check_parts_of_verb, check_values
from completesplat.settings.composition import shard_folder, typed_keys, use_working_folder
from completesplat.settings.extensions import versions_of
from completesplat.settings.options import did_you_mean, source_of
from completesplat.signals import Interrupted, ended_by_signals
from completesplat.weights import RUN_CHECKPOINT

PROCESS_OF_JOB = "--process-of"
log = logging.getLogger(__name__)
VARIABLES_OF_PROCESSES = ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK", "LOCAL_RANK", "WORLD_SIZE")


class LogFile(logging.FileHandler):
    """Hydra's log file of a job. A link at its path is removed, not followed."""

    def __init__(self, filename: str, mode: str = "a") -> None:
        if os.path.islink(filename):
            os.unlink(filename)
        os.makedirs(os.path.dirname(os.path.abspath(filename)), exist_ok=True)  # a job's name may have folders
        super().__init__(filename, mode)


def job_folders(config: DictConfig) -> tuple[Path, Path]:
    """Return the folder of a job's record, and that of its results, which jobs that are its shards share."""
    folder = HydraConfig.get().runtime.output_dir
    return Path(folder), Path(folder.removesuffix(shard_folder(config)))


def run_trial(verb: str, config: DictConfig, program: str, given: list[str]) -> float | None:
    """Run one job (`run_job`), and return its metric for a search: the worst value if it diverged or is not finite.

    Searches such as Optuna's stop at a job that fails. A job that diverges only has bad settings.
    """
    direction = OmegaConf.select(HydraConfig.get().sweeper, "direction")
    searches = HydraConfig.get().mode == RunMode.MULTIRUN and direction is not None
    try:
        value = run_job(verb, config, program, given)
    except DivergenceError as error:
        if not searches:
            raise
        log.warning("%s: %s; the search goes on", job_folders(config)[1], error)
        value = math.nan
    if searches and value is not None and math.isnan(value):
        return -math.inf if str(direction).endswith("maximize") else math.inf
    return value


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
    if "typed" in config:
        config.typed = typed_keys(hydra_config.overrides.task)
    taken = take_architecture(config)
    if taken is not None:
        log.info(taken)
    idle = None
    if verb == "fit":
        from completesplat.commands.ablations import idle_ablation  # imports what `predict` does not need

        idle = idle_ablation(config)
    if idle is not None:
        same = f"ablation={idle}: changes nothing here, its settings are those without it"
        if config.skip_unchanged:
            print(f"{out}: left out; {same}")
            return None
        log.warning("%s; skip_unchanged=true leaves such jobs out", same)
    resolved = cast(dict[str, object], OmegaConf.to_container(config, resolve=True))
    if is_finished(out, resolved, hydra_config.overrides.task):
        print(f"{out}: finished before, not repeated")
        return optimized(config.get("optimized_metric"), out)
    keeps_record = is_first_process()
    entries = job_entries(verb, given, folder) | {"unchanged": idle is not None}
    entries["extensions"] = used_extensions(resolved, hydra_config.runtime.choices)
    record = recorded(folder, entries, resolved) if keeps_record else nullcontext()
    others = _for_other_processes([program, verb, f"{PROCESS_OF_JOB}={os.getpid()}:{folder}"])
    try:
        with ended_by_signals(), record:
            resolve_start_weights(config)
            with others:
                result = start(verb, config, out)
    except Interrupted as stop:
        if keeps_record:
            print(_how_to_continue(stop, verb, given, out), file=sys.stderr)
        raise
    print(out)
    if isinstance(result, str):
        print(result)
    return optimized(config.get("optimized_metric"), out)


def used_extensions(config: object, choices: Mapping[str, object]) -> dict[str, str]:
    """Return the extensions whose code a config names, or whose options were chosen: versions by name."""
    versions = versions_of(_targets(config))
    for group, option in choices.items():
        source = source_of(f"{group.partition('@')[0]}/{option}")
        if source is not None:
            versions[source.name] = source.version
    return versions


def _targets(config: object) -> Iterator[str]:
    """Yield each `_target_` in a plain config."""
    if isinstance(config, dict):
        if "_target_" in config:
            yield str(config["_target_"])
        config = list(config.values())
    if isinstance(config, list):
        for part in config:
            yield from _targets(part)


def resolve_start_weights(config: DictConfig) -> None:
    """Replace the folders of runs that a training starts from by their checkpoints.

    Their paths may refer to the job's choices (`hydra:runtime.choices`), which other processes cannot resolve.
    """
    for key in ("checkpoint", "autoreconstructor_checkpoint"):
        path = OmegaConf.select(config, f"model.{key}")
        if path:
            config.model[key] = str(start_checkpoint(path))


def optimized(metric: str | None, out: Path) -> float | None:
    """Return a job's metric for sweepers (NaN: not finite, None: not asked).

    Raises:
        CompleteSplatError: the job has no such metric.
    """
    if metric is None:
        return None
    figures = {name: value for name, value in read_mapping(out / SCORES).items() if isinstance(value, float)}
    if metric not in figures:
        available = f"there are {', '.join(figures)}{did_you_mean(metric, figures)}"
        raise CompleteSplatError(f"optimized_metric={metric}: no figure in {out / SCORES}, {available}")
    return figures[metric]


def _how_to_continue(stop: Interrupted, verb: str, given: list[str], out: Path) -> str:
    """Return one line: the signal that ended a job, its checkpoint, and the command to continue the job or sweep."""
    hydra_config = HydraConfig.get()
    sweep = hydra_config.mode == RunMode.MULTIRUN
    checkpoint = out / RUN_CHECKPOINT
    begun = checkpoint.is_file()
    goes_on = begun and not sweep
    replaced = ("out=", "ckpt_path=") if goes_on else ("out=",)
    command = ["completesplat", verb]
    command += [argument for argument in given if not argument.startswith(replaced)]
    if goes_on:
        command.append("ckpt_path=last")
    command.append(f"out={hydra_config.sweep.dir if sweep else out}")
    if begun:
        return f"ended by {stop.signal.name}; the checkpoint is {checkpoint}; go on with: {shlex.join(command)}"
    return f"ended by {stop.signal.name}; start again with: {shlex.join(command)}"


def start(verb: str, config: DictConfig, out: Path) -> object:
    """Check the settings and call the config's task or else the verb's `run`.

    Returns:
        The result of `run` or of the task. A text is printed.
    """
    imports_torch = "torch" not in sys.modules
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
        if imports_torch:
            gc.freeze()
        gc.enable()
    return run()


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
