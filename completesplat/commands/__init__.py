"""The verbs of the command line, one thin file each, and how hydra starts them."""

import logging
import os
import secrets
import sys
import time
import warnings
from pathlib import Path
from typing import Any

from completesplat.commands.jobs import (
    PROCESS_OF_JOB,
    is_sweep,
    job_name,
    one_of_several,
    run_job,
    run_process_of_job,
    sweep_arguments,
)
from completesplat.commands.view import overrides
from completesplat.errors import CompleteSplatError

RUN_NAME = f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-{secrets.token_hex(3)}"
TASKS = ("data", "bench", "report")
UNHELPFUL_WARNINGS = (
    ".*does not have many workers.*",
    ".*but have no `val_dataloader`.*",
    ".*LeafSpec.*",
    "Experiment logs directory .* exists.*",
    ".*logging interval.*",
    "Checkpoint directory .* exists and is not empty.*",
)


def launch(verb: str, arguments: list[str]) -> None:
    """Compose the verb's configuration (`conf/<verb>.yaml`) and run it, once or as a sweep.

    `data`, `bench` and `report` have several tasks: `data toy` is short for `data data_task=toy`. `view PATH` is short
    for `view path=PATH`.
    """
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    if arguments and arguments[0].startswith(PROCESS_OF_JOB):
        return run_process_of_job(verb, Path(arguments[0].partition("=")[2]))
    # Hydra would print its own report and exit; errors are reported in one place, `cli.main`.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    if verb in TASKS and arguments and "=" not in arguments[0] and not arguments[0].startswith("-"):
        arguments = [f"{verb}_task={arguments[0]}", *arguments[1:]]
    if verb == "view":
        arguments = overrides(arguments)
    program, given = sys.argv[0], arguments
    if is_sweep(arguments):
        arguments = [*arguments, *sweep_arguments(verb, arguments, RUN_NAME)]
    elif one_of_several() and not any(argument.startswith("out=") for argument in arguments):
        raise CompleteSplatError("torchrun or srun started several processes of this run: give them one out=DIR")
    sys.argv = [f"completesplat {verb}", *arguments]

    failures: list[Exception] = []

    def job(config: Any) -> None:
        try:
            run_job(verb, config, program, given)
        except Exception as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise  # hydra says which job it was, goes on with the others, and raises in the end
            failures.append(error)

    hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=verb)(job)()
    if failures:
        raise failures[0]


def conf_folder() -> Path:
    """The configuration tree: inside an installed package, or beside it in the repository."""
    package = Path(__file__).parents[1]
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def register_resolvers() -> None:
    """Interpolations that `conf/` uses beside hydra's own."""
    from omegaconf import OmegaConf

    OmegaConf.register_new_resolver("run_name", lambda: RUN_NAME, replace=True)
    OmegaConf.register_new_resolver("best_precision", best_precision, replace=True)
    OmegaConf.register_new_resolver("job_name", job_name, replace=True)


def best_precision() -> str:
    """Lightning's precision for networks: bfloat16 where the processor computes in it, else float32."""
    import torch

    if torch.cuda.is_available():
        return "bf16-mixed" if torch.cuda.is_bf16_supported() else "32-true"
    return "bf16-mixed" if torch.cpu._is_avx512_bf16_supported() else "32-true"


def quieten() -> None:
    """Keep Lightning's hints about its products and settings out of the output; its errors and progress stay.

    To be called after Lightning is imported, which sets these levels itself.
    """
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in UNHELPFUL_WARNINGS:
        warnings.filterwarnings("ignore", message=message)


def refusal(error: BaseException) -> str | None:
    """One line for an error that the user can put right; None for a fault of the program."""
    from hydra.errors import HydraException, InstantiationException
    from omegaconf.errors import InterpolationToMissingValueError, MissingMandatoryValue, OmegaConfBaseException

    chain: BaseException | None = error
    while chain is not None:
        if isinstance(chain, CompleteSplatError):
            return " ".join(str(chain).split())
        chain = chain.__cause__
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} is needed: give {error.full_key}=VALUE"
    if isinstance(error, InterpolationToMissingValueError):
        key = str(error).partition("Missing mandatory value: ")[2].split()[0]  # omegaconf keeps it nowhere else
        return f"{key} is needed: give {key}=VALUE"
    if isinstance(error, HydraException | OmegaConfBaseException) and not isinstance(error, InstantiationException):
        return " ".join(str(error).split())
    return None


register_resolvers()  # here, because jobs that a cluster starts elsewhere import this module and do no more
