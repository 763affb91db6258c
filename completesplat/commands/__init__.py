"""The verbs of the command line, one module each, and the code that starts them through Hydra."""

import logging
import os
import re
import secrets
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from omegaconf import OmegaConf
from omegaconf.errors import InterpolationToMissingValueError, MissingMandatoryValue, OmegaConfBaseException

from completesplat.commands import jobs
from completesplat.errors import CompleteSplatError
from completesplat.files import file_refusal
from completesplat.settings import help
from completesplat.settings.arguments import SWEEP, behind_dashes, for_hydra
from completesplat.settings.checks import misspelt
from completesplat.settings.options import conf_folder, gsplat_constants
from completesplat.signals import end_with, ended_by_signals

RUN_NAME = f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-{secrets.token_hex(3)}"
CALLED = re.compile(r"Error in call to target '(?:torch|lightning|diffusers|torchmetrics)\.")
LIGHTNINGS = "MisconfigurationException"
UNHELPFUL_WARNINGS = (
    ".*does not have many workers.*",
    ".*but have no `val_dataloader`.*",
    ".*LeafSpec.*",
    "Experiment logs directory .* exists.*",
    ".*logging interval.*",
    "Checkpoint directory .* exists and is not empty.*",
    "FSDP2-wrapped module .* returned a view tensor.*",
    ".*torch.distributed is disabled, unavailable or uninitialized.*",
)


def launch(verb: str, arguments: list[str]) -> None:
    """Compose the verb's config (`conf/<verb>.yaml`) and run it, once or as a sweep.

    `data toy` is short for `data data_task=toy`, `predict A B` for `predict image=[A,B]`, `view PATH` for
    `view path=PATH`, `new KIND NAME` for `new kind=KIND name=NAME`.
    """
    jobs.use_working_folder()
    # Lightning starts a further process of the job for each device.
    if arguments and arguments[0].startswith(jobs.PROCESS_OF_JOB):
        starter, _, out_name = arguments[0].partition("=")[2].partition(":")
        out = Path(out_name)
        end_with(int(starter))
        with ended_by_signals():
            return jobs.start(verb, OmegaConf.load(out / jobs.CONFIG), out)
    program, original = sys.argv[0], arguments
    arguments = behind_dashes(arguments)
    if any(flag in arguments for flag in help.FLAGS):
        return print(help.page(verb, arguments))
    # Hydra would print its own report and exit; errors are reported in one place, `cli.main`.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    # Logging stays silent on a full disk, because the next file that is written reports it in one line.
    logging.raiseExceptions = False
    arguments = for_hydra(verb, arguments)
    if any(flag in arguments for flag in SWEEP):
        arguments = [*arguments, *jobs.sweep_arguments(verb, arguments, RUN_NAME)]
    elif jobs.one_of_several() and not any(argument.startswith("out=") for argument in arguments):
        raise CompleteSplatError("torchrun or srun started several processes of this run: give them one out=DIR")
    sys.argv = [f"completesplat {verb}", *arguments]
    failures: list[Exception] = []

    def job(config: Any) -> float | None:
        try:
            with jobs.alone_in(Path(HydraConfig.get().runtime.output_dir)):
                return jobs.run_job(verb, config, program, original)
        except Exception as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise  # Hydra names the job, runs the others, and raises at the end
            failures.append(error)
            return None

    try:
        hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=verb)(job)()
    except (HydraException, ValueError) as error:
        if (clearer := misspelt(error, verb, arguments, jobs.composed)) is None:
            raise
        raise clearer from error
    if failures:
        raise failures[0]


def compose(verb: str, *overrides: str) -> Any:
    """Return the config of a verb, as `completesplat VERB OVERRIDES...` composes it: `compose("fit", "trainer=ddp")`.

    Raises:
        CompleteSplatError: an override cannot be read, or names no option.
    """
    arguments = for_hydra(verb, overrides)
    try:
        config = jobs.composed(verb, *arguments)
    except (HydraException, ValueError) as error:
        if (clearer := misspelt(error, verb, arguments, jobs.composed)) is None:
            raise
        raise clearer from error
    OmegaConf.set_struct(config, False)
    return config


def best_precision() -> str:
    """Return Lightning's precision for networks: bfloat16 where the GPU, or else the CPU, supports it, or float32."""
    import torch

    on_gpu = torch.cuda.is_available()
    supported = torch.cuda.is_bf16_supported() if on_gpu else torch.cpu._is_avx512_bf16_supported()
    return "bf16-mixed" if supported else "32-true"


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
    if (own_error := _own_error(error)) is not None:
        return " ".join(str(own_error).split())
    if isinstance(error, MissingMandatoryValue | InterpolationToMissingValueError):
        named = str(error).partition("Missing mandatory value: ")[2].split()  # OmegaConf has it nowhere else
        key = error.full_key if isinstance(error, MissingMandatoryValue) else named[0]
        return f"{key} is needed: give {key}=VALUE"
    if isinstance(error, InstantiationException):
        # A missing module or name may be misspelt; any other error while parts are built is a fault of the program.
        if error.__cause__ is not None and isinstance(error.__cause__.__cause__, ModuleNotFoundError):
            return " ".join(str(error.__cause__).split())
        return _of_a_library(error)
    if isinstance(error, HydraException | OmegaConfBaseException):
        return " ".join(str(error).split())
    return None


def _of_a_library(error: InstantiationException) -> str | None:
    """Return one line for an option that a library's class refuses, None for an error of the package itself."""
    called, cause = CALLED.match(str(error)), error.__cause__
    if called is None or not (isinstance(cause, ValueError | TypeError) or type(cause).__name__ == LIGHTNINGS):
        return None
    key = str(error).rpartition("full_key: ")[2].strip()
    return f"{key}: {' '.join(str(cause).split())}"


def exit_status(error: BaseException) -> int:
    """Return the exit status for an error that `refusal` can explain."""
    own_error = _own_error(error)
    return 2 if own_error is None else own_error.exit_status


def _own_error(error: BaseException) -> CompleteSplatError | None:
    """Return the package's own error in a chain of causes, or a new one for a full disk or a bad file name."""
    chain: BaseException | None = error
    while chain is not None:
        if isinstance(chain, CompleteSplatError):
            return chain
        if (refused := file_refusal(chain)) is not None:
            return refused
        chain = chain.__cause__
    return None


# Resolvers used in `conf/`. They are registered here because jobs that a cluster starts import only this module.
OmegaConf.register_new_resolver("run_name", lambda: RUN_NAME, replace=True)
OmegaConf.register_new_resolver("best_precision", best_precision, replace=True)
OmegaConf.register_new_resolver("gsplat", lambda name: gsplat_constants()[name], replace=True)
OmegaConf.register_new_resolver("job_name", jobs.job_name, replace=True)
