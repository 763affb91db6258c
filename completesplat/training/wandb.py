"""Weights & Biases: one run for each directory."""

import logging
import secrets
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch.loggers import Logger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, ListConfig, OmegaConf

from completesplat.errors import CompleteSplatError
from completesplat.files import write_text

MODES = ("online", "offline", "disabled")
START_SECONDS = 6
"""Time for a server to start a run; it delays training at most by this."""
AXIS = "trainer/global_step"

log = logging.getLogger(__name__)


class WandbRun(WandbLogger):
    """Logger of a directory's only W&B run. Its id is in `save_dir/wandb_id`, so a resumed run continues it.

    `mode=online` becomes `offline`, with a warning, if the server does not answer or refuses; `wandb sync` uploads the
    log later. If W&B's own process dies, training goes on without it.

    Args:
        mode: online, offline or disabled.
        group, name: by default the sweep's folder (in a sweep), and the directory's name.
    """

    def __init__(
        self,
        save_dir: str,
        mode: str,
        project: str,
        group: str | None = None,
        name: str | None = None,
        job_type: str | None = None,
    ) -> None:
        if mode not in MODES:
            raise CompleteSplatError(f"wandb.mode={mode}: choose one of {', '.join(MODES)}")
        self.folder = Path(save_dir).absolute()
        if group is None and (self.folder.parent / "multirun.yaml").is_file():  # Hydra's file in a sweep's folder
            group = self.folder.parent.name
        try:
            options: dict[str, Any] = {"mode": mode, "group": group, "job_type": job_type}
            super().__init__(name=name or self.folder.name, save_dir=save_dir, project=project, **options)
        except ModuleNotFoundError as error:
            raise CompleteSplatError("logger=wandb needs wandb: pip install wandb, or leave it out") from error
        self._wandb_init.pop("anonymous", None)  # W&B would warn that Lightning gives it
        self.lost = False

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """Return W&B's run, which begins at the first access."""
        if self._experiment is None:
            run = self._experiment = self._begin()
            run.define_metric(AXIS)
            run.define_metric("*", step_metric=AXIS, step_sync=True)
        return self._experiment

    def _begin(self) -> Any:
        import wandb

        path = self.folder / "wandb_id"
        if not (path.is_file() and path.read_text().strip()):
            write_text(path, secrets.token_hex(4) + "\n")
        settings = {"id": path.read_text().strip(), "settings": wandb.Settings(init_timeout=START_SECONDS)}
        try:
            return wandb.init(**self._wandb_init | settings)
        except wandb.Error as error:
            reason = str(error).partition("\n")[0]
            log.warning("W&B: %s; the run is kept offline, `wandb sync` uploads it later", reason)
        wandb.teardown()  # its process still holds the run's id
        return wandb.init(**self._wandb_init | settings | {"mode": "offline"})

    @rank_zero_only
    def log_hyperparams(self, params: object) -> None:
        """Add options to the run's config."""
        with self._dispensable():
            self.experiment.config.update(params, allow_val_change=True)

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, object], step: int | None = None) -> None:
        """Log numbers, or W&B's images."""
        with self._dispensable():
            self.experiment.log({**metrics, **({} if step is None else {AXIS: step})})

    @rank_zero_only
    def finish(self, exit_code: int) -> None:
        """Close the run if it has begun."""
        import wandb

        if self._experiment is None:
            return
        with self._dispensable():
            self._experiment.finish(exit_code=exit_code)
        self._experiment = None
        if self.lost:
            with suppress(ConnectionError):
                wandb.teardown()  # so that the next job of a sweep gets a new process

    @contextmanager
    def _dispensable(self) -> Iterator[None]:
        try:
            yield
        except ConnectionError as error:
            if not self.lost:
                log.warning("W&B: its process ended (%s); metrics.csv goes on without it", error)
            self.lost = True


@contextmanager
def wandb_runs(loggers: Iterable[Logger], config: DictConfig | ListConfig) -> Iterator[None]:
    """Log the config to W&B's runs, and close them in the end, so that the next job does not log to them.

    Their exit code is 1 after an error.
    """
    runs = [logger for logger in loggers if isinstance(logger, WandbRun)]
    exit_code = 1
    try:
        for run in runs:
            run.log_hyperparams(OmegaConf.to_container(config, resolve=True))
        yield
        exit_code = 0
    finally:
        for run in runs:
            run.finish(exit_code)
