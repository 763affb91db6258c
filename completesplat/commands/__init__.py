"""The verbs of the command line, one module each, and the code that starts them through Hydra."""

import logging
import os
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationToMissingValueError, MissingMandatoryValue, OmegaConfBaseException
from yaml import YAMLError

from completesplat.commands import jobs, new
from completesplat.commands.locks import hold_job_lock, one_of_several
from completesplat.errors import CompleteSplatError
from completesplat.evaluation.records import CONFIG
from completesplat.files import file_refusal
from completesplat.settings import composition, help
from completesplat.settings.arguments import SWEEP, for_hydra
from completesplat.settings.extensions import extension_of, extensions
from completesplat.settings.options import conf_folder
from completesplat.settings.sweeps import check_sweep, starts_search
from completesplat.signals import end_with, ended_by_signals

LOADED = re.compile(r"Error loading '([\w.]+)'")  # begins Hydra's message on what cannot be imported
CALLED = re.compile(r"Error in call to target '(torch|lightning|diffusers|torchmetrics)\.")
UNHELPFUL_WARNINGS = (
    ".*does not have many workers.*",
    ".*but have no `val_dataloader`.*",
    ".*LeafSpec.*",
    "Experiment logs directory .* exists.*",
    ".*logging interval.*",
    "Checkpoint directory .* exists and is not empty.*",
    ".*torch.distributed is disabled, unavailable or uninitialized.*",
)


def launch(verb: str, arguments: list[str]) -> None:
    """Compose the config of `conf/<verb>.yaml` with the arguments (`for_hydra`), and run it, once or as a sweep."""
    composition.use_working_folder()
    # Lightning starts a further process of the job for each device.
    if arguments and arguments[0].startswith(jobs.PROCESS_OF_JOB):
        return _join_job(verb, arguments[0])
    if any(flag in arguments for flag in help.HELP_FLAGS):
        return print(help.help_page(verb, arguments))
    if verb == "new":  # its files are the user's, and it has no folder for a job
        return new.run(composition.compose(verb, *arguments))
    # Hydra would print its own report and exit; errors are reported in one place, `cli.main`.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    # Logging stays silent on a full disk, because the next file that is written reports it in one line.
    logging.raiseExceptions = False
    program = sys.argv[0]
    overrides = for_hydra(verb, arguments)
    if _is_lone_search(verb, overrides):
        overrides = [SWEEP[0], *overrides]
    _check_start(overrides)
    if is_sweep(overrides):
        check_sweep(overrides)
        overrides += composition.sweep_arguments(verb, overrides)
    sys.argv = [f"completesplat {verb}", *overrides]
    failures: list[Exception] = []

    def job(config: DictConfig) -> float | None:
        try:
            with hold_job_lock(*jobs.job_folders(config)):
                return jobs.run_trial(verb, config, program, arguments)
        except Exception as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise  # Hydra names the job, runs the others, and raises at the end
            failures.append(error)
            return None

    with composition.nearest_names(verb):
        hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=verb)(job)()
    if failures:
        raise failures[0]


def is_sweep(overrides: Sequence[str]) -> bool:
    """Return whether Hydra's flag for several jobs is among the arguments."""
    return any(flag in overrides for flag in SWEEP)


def _is_lone_search(verb: str, overrides: Sequence[str]) -> bool:
    """Return whether a search for good settings is to be run, without Hydra's flag for several jobs."""
    return verb == "fit" and starts_search(overrides) and not is_sweep(overrides) and not shows_config(overrides)


def shows_config(overrides: Sequence[str]) -> bool:
    """Return whether Hydra only prints the config."""
    return any(argument.startswith("--cfg=") for argument in overrides)


def _check_start(overrides: Sequence[str]) -> None:
    """Raise CompleteSplatError for an empty `out`, and if a sweep or several processes do not go with the arguments."""
    for empty in ("out=", "out=''", "out=null"):
        if empty in overrides:
            raise CompleteSplatError(f"{empty}: names no folder; give out=DIR")
    if is_sweep(overrides) and shows_config(overrides):
        raise CompleteSplatError("--cfg shows the settings of one run: leave out -m")
    if not one_of_several():
        return
    if is_sweep(overrides):
        message = "a sweep (-m) starts the processes of its jobs itself: start it once, without torchrun or srun"
        raise CompleteSplatError(message)
    if not any(argument.startswith("out=") for argument in overrides):
        raise CompleteSplatError("torchrun or srun started several processes of this run: give them one out=DIR")


def _join_job(verb: str, argument: str) -> None:
    """Work on a job whose first process has started.

    This process ends when that one ends.
    """
    starter, _, out = argument.partition("=")[2].partition(":")
    end_with(int(starter))
    with ended_by_signals():
        config = OmegaConf.load(Path(out, CONFIG))
        assert isinstance(config, DictConfig)
        jobs.resolve_start_weights(config)
        jobs.start(verb, config, Path(out))


def quieten() -> None:
    """Keep Lightning's hints about its products and settings out of the output; its errors and progress stay.

    Call this after importing Lightning, because the import sets these levels itself.
    """
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in UNHELPFUL_WARNINGS:
        warnings.filterwarnings("ignore", message=message)


def refusal(error: BaseException) -> str | None:
    """Return one line for an error that the user can put right, None for a fault of the program."""
    message: str | None = None
    own_error = _own_error(error)
    broken = _of_an_extension(error)
    if broken is not None:
        message = broken
    elif own_error is not None:
        message = str(own_error)
    elif isinstance(error, MissingMandatoryValue | InterpolationToMissingValueError):
        key = _missing_key(error)
        message = f"{key} is needed: give {key}=VALUE"
    elif isinstance(error, InstantiationException):
        message = _of_a_part(error)
    elif isinstance(error, HydraException | OmegaConfBaseException | YAMLError):
        message = str(error)
    if message is None:
        return None
    for extension in extensions():
        if f"{extension.conf}/" in message:
            message = f"{message} (a file of {extension}; update or uninstall it)"
    return " ".join(message.split())


def _missing_key(error: MissingMandatoryValue | InterpolationToMissingValueError) -> str:
    """Return the setting without a value.

    Those of a task are given without `task.`
    """
    key = error.full_key or ""
    if isinstance(error, InterpolationToMissingValueError):  # whose key is that of the setting that refers to it
        key = str(error).partition("Missing mandatory value: ")[2].split()[0]
    return key.removeprefix("task.")


def _of_an_extension(error: BaseException | None) -> str | None:
    """Return a message if the chain of causes has an extension's module, class or function that cannot be imported."""
    while error is not None:
        loaded = LOADED.match(str(error))
        extension = None if loaded is None else extension_of(loaded[1])
        if loaded is not None and extension is not None:
            return f"{loaded[1]}: cannot be imported ({error.__cause__!r}); update or uninstall {extension}"
        error = error.__cause__
    return None


def _of_a_part(error: InstantiationException) -> str | None:
    """Return a message if a part's module is missing or a library's class refuses an option, None for a fault."""
    cause = error.__cause__
    if cause is not None and isinstance(cause.__cause__, ModuleNotFoundError):
        return str(cause)
    called = CALLED.match(str(error))
    if called is None:
        return None
    # Lightning looks at the machine and at environment variables, and raises errors of many types.
    of_lightning = called[1] == "lightning" and isinstance(cause, Exception)
    if not of_lightning and not isinstance(cause, ValueError | TypeError):
        return None
    return f"{str(error).rpartition('full_key: ')[2].strip()}: {cause}"


def exit_status(error: BaseException) -> int:
    """Return the exit status for an error that `refusal` can explain."""
    own_error = _own_error(error)
    return 2 if own_error is None else own_error.exit_status


def _own_error(error: BaseException | None) -> CompleteSplatError | None:
    """Return the package's own error in a chain of causes, or a new one for a full disk or a bad file name."""
    while error is not None:
        own_error = error if isinstance(error, CompleteSplatError) else file_refusal(error)
        if own_error is not None:
            return own_error
        error = error.__cause__
    return None
