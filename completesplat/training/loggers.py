"""Loggers: `metrics.csv`, which a resumed run continues, and one run of Weights & Biases for each directory."""

import csv
import io
import logging
import secrets
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch.loggers import CSVLogger, Logger, WandbLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, ListConfig, OmegaConf

from completesplat.errors import CompleteSplatError
from completesplat.evaluation.records import read_record
from completesplat.files import write_text, writing
from completesplat.weights import first_line

START_SECONDS = 6
"""Longest time that W&B's server may take to start a run, which delays training."""
AXIS = "trainer/global_step"

logger = logging.getLogger(__name__)


class ContinuedCSVLogger(CSVLogger):
    """Logger that writes each row to `metrics.csv` at once, so that a killed run loses no rows.

    A resumed run repeats the steps after its last checkpoint. It therefore keeps only those of the file's rows that
    come before the step of its checkpoint and before the first new row.
    """

    def __init__(self, save_dir: str) -> None:
        super().__init__(save_dir, name="", version="", flush_logs_every_n_steps=1)

    @property
    @rank_zero_experiment
    def experiment(self) -> "MetricsFile":
        """Return the metrics file, which Lightning calls the experiment."""
        if self._experiment is None:
            self._experiment = MetricsFile(self.log_dir)
        return self._experiment  # type: ignore[return-value]


class MetricsFile(ExperimentWriter):
    """Writer that appends rows to `metrics.csv`, or replaces the whole file when there is a new column."""

    def __init__(self, log_dir: str) -> None:
        super().__init__(log_dir)
        self.path = Path(self.metrics_file_path)
        self.has_header = False  # written by this process
        # Step of the checkpoint that the run goes on from, which `Checkpoints` sets. None: there is none.
        self.goes_on_from: int | None = None

    def _check_log_dir_exists(self) -> None:
        """Keep the old file, which Lightning would delete here, until it is replaced."""

    def save(self) -> None:
        """Write the rows that are not written yet.

        Raises:
            DiskError: the disk is full, or the folder no longer exists.
        """
        if not self.metrics:
            return
        new = set().union(*self.metrics) - set(self.metrics_keys)
        text = io.StringIO(newline="")
        if new or not self.has_header:
            old = self._rows_to_keep()
            self.metrics_keys = sorted(new.union(self.metrics_keys, *old))
            writer = csv.DictWriter(text, self.metrics_keys)
            writer.writeheader()
            writer.writerows([*old, *self.metrics])
            write_text(self.path, text.getvalue())
        else:
            csv.DictWriter(text, self.metrics_keys).writerows(self.metrics)
            with writing(self.path), self.path.open("a", newline="") as file:
                file.write(text.getvalue())
        self.metrics = []
        self.has_header = True

    def _rows_to_keep(self) -> list[dict[str, str]]:
        if not self.path.is_file():
            return []
        with self.path.open(newline="") as file:
            # The last line of a killed process may be incomplete.
            rows = list(csv.DictReader(line for line in file if line.endswith("\n")))
        if self.has_header:
            return rows
        first = min(row["step"] for row in self.metrics)
        if self.goes_on_from is not None:
            first = min(first, self.goes_on_from)
        return [row for row in rows if int(row["step"]) < first]


class Words(TypedDict, total=False):
    """What to find a run of W&B by."""

    job_type: str | None
    tags: Sequence[str]
    notes: str | None


class WandbRun(WandbLogger):
    """Logger of a directory's only W&B run. Its id is in `save_dir/wandb_id`, so a resumed run continues it.

    `mode=online` becomes `offline`, with a warning, if the server does not answer or refuses; `wandb sync` uploads the
    log later. If W&B's own process dies, training goes on without it.

    Args:
        group, name: by default the sweep's folder (in a sweep), and the directory's name.
        log_model: whether `log_weights` keeps the weights with the run.
        **words: what to find the run by.
    """

    def __init__(
        self,
        save_dir: str,
        mode: Literal["online", "offline", "disabled"],
        project: str,
        group: str | None = None,
        name: str | None = None,
        log_model: bool = False,
        **words: Unpack[Words],
    ) -> None:
        self.folder = Path(save_dir).absolute()
        # Hydra's file in a sweep's folder, which may hold its jobs in further folders.
        sweeps = (parent.name for parent in self.folder.parents if (parent / "multirun.yaml").is_file())
        try:
            super().__init__(
                name=name or self.folder.name,
                save_dir=save_dir,
                project=project,
                mode=mode,
                group=group or next(sweeps, None),
                **words,
            )
        except ModuleNotFoundError as error:
            raise CompleteSplatError("logger=wandb needs wandb: pip install wandb, or leave it out") from error
        self._wandb_init.pop("anonymous", None)  # W&B would warn that Lightning gives it
        self.lost = False
        self.keeps_weights = log_model

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """Return W&B's run, which begins at the first access."""
        if self._experiment is None:
            run = self._begin()
            self._experiment = run
            write_text(self.folder / "wandb_id", f"{run.id}\n")  # not always ours: a sweep's agent sets WANDB_RUN_ID
            run.define_metric(AXIS)
            run.define_metric("*", step_metric=AXIS, step_sync=True)
        return self._experiment

    def _begin(self) -> Any:
        import wandb

        path = self.folder / "wandb_id"
        stored_id = path.read_text().strip() if path.is_file() else ""
        options = dict(self._wandb_init)
        options["id"] = stored_id or secrets.token_hex(4)
        with _refused_by_wandb():
            options["settings"] = wandb.Settings(init_timeout=START_SECONDS)
            try:
                return wandb.init(**options)
            except wandb.Error as error:
                reason = first_line(error)
            wandb.teardown()  # its process still holds the run's id
            options["mode"] = "offline"
            run = wandb.init(**options)
        logger.warning("W&B: %s; the run is kept offline, `wandb sync` uploads it later", reason)
        return run

    @rank_zero_only
    def log_hyperparams(self, params: object) -> None:
        """Add options to the run's config."""
        with self._dispensable():
            self.experiment.config.update(params, allow_val_change=True)

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, object], step: int | None = None) -> None:
        row = dict(metrics)
        if step is not None:
            row[AXIS] = step
        with self._dispensable():
            self.experiment.log(row)

    @rank_zero_only
    def log_weights(self, folder: Path, figures: Mapping[str, object]) -> None:
        """Keep a folder of weights with the run as an artifact of type model, if `log_model` asks for it.

        Args:
            figures: the run's last figures, which describe the artifact.
        """
        import wandb

        if not self.keeps_weights or not folder.is_dir():
            return
        with self._dispensable():
            run = self.experiment
            artifact = wandb.Artifact(f"weights-{run.id}", type="model", metadata=dict(figures))
            artifact.add_dir(str(folder))
            run.log_artifact(artifact)

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
        """Log a warning, once, if W&B's process has ended, and go on without it."""
        try:
            yield
        except ConnectionError as error:
            if not self.lost:
                logger.warning("W&B: its process ended (%s); metrics.csv goes on without it", error)
            self.lost = True


@contextmanager
def _refused_by_wandb() -> Iterator[None]:
    """Raise CompleteSplatError for a name or a setting that W&B refuses also without its server."""
    import wandb

    try:
        yield
    except (wandb.Error, ValueError, TypeError) as error:
        advice = "check wandb.project, wandb.group, wandb.name and the WANDB_ variables, or leave logger=wandb out"
        raise CompleteSplatError(f"logger=wandb: {' '.join(str(error).split())[:300]}; {advice}") from error


@contextmanager
def wandb_runs(loggers: Iterable[Logger], config: DictConfig | ListConfig, folder: Path) -> Iterator[None]:
    """Log the config to W&B's runs, and close them in the end, so that the next job does not log to them.

    Their exit code is 1 after an error.

    Args:
        folder: folder of the job, whose record has the chosen options (`options.ablation`), the user's own command and
            the commit.
    """
    record = read_record(folder)
    program, *arguments = record.get("command") or [""]
    asked = {
        "options": record.get("groups"),
        "command": f"{program} {shlex.join(arguments)}",
        "commit": record.get("commit"),
    }
    runs = [run for run in loggers if isinstance(run, WandbRun)]
    exit_code = 1
    try:
        for run in runs:
            settings: Any = OmegaConf.to_container(config, resolve=True)
            run.log_hyperparams({**settings, **asked})
        yield
        exit_code = 0
    finally:
        for run in runs:
            run.finish(exit_code)
