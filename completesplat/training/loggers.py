"""Loggers: `metrics.csv`, which a resumed run continues, and one run of Weights & Biases for each directory."""

import csv
import io
import logging
import os
import secrets
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from ssl import SSLError
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import urlopen

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch.loggers import CSVLogger, Logger, WandbLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from lightning.pytorch.utilities import rank_zero_only

from completesplat.errors import CompleteSplatError
from completesplat.files import write_text, writing

MODES = ("online", "offline", "disabled")
ANSWER_SECONDS, START_SECONDS = 4, 6
"""Time for a server to answer at all, and to start a run; their sum is the longest possible delay of training."""
AXIS, DATA = "trainer/global_step", "WANDB_DATA_DIR"

log = logging.getLogger(__name__)


class ContinuedCSVLogger(CSVLogger):
    """Logger that writes each row to `metrics.csv` at once, so that a killed run keeps its rows.

    A resumed run keeps the file's rows before the step of its checkpoint and before the first new row, because it
    repeats the steps after its last checkpoint.
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
    """Rows of numbers that are appended to `metrics.csv`; a new column replaces the whole file."""

    def __init__(self, log_dir: str) -> None:
        super().__init__(log_dir)
        self.path = Path(self.metrics_file_path)
        self.begun = False
        self.goes_on_from: int | None = None

    def _check_log_dir_exists(self) -> None:
        """Keep the old file until it is replaced; Lightning would delete it here."""

    def save(self) -> None:
        """Write the rows that are not written yet; raise DiskError if the disk refuses."""
        if not self.metrics:
            return
        new = set().union(*self.metrics) - set(self.metrics_keys)
        if new or not self.begun:
            old = self._rows_to_keep()
            self.metrics_keys = sorted(new.union(self.metrics_keys, *old))
            write_text(self.path, self._lines([*old, *self.metrics], header=True))
        else:
            lines = self._lines(self.metrics, header=False)
            with writing(self.path, len(lines)), self.path.open("a", newline="") as file:
                file.write(lines)
        self.metrics, self.begun = [], True

    def _lines(self, rows: Iterable[Mapping[str, Any]], header: bool) -> str:
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self.metrics_keys)
        if header:
            writer.writeheader()
        writer.writerows(rows)
        return text.getvalue()

    def _rows_to_keep(self) -> list[dict[str, str]]:
        if not self.path.is_file():
            return []
        with self.path.open(newline="") as file:
            # The last line of a killed process may be incomplete.
            rows = list(csv.DictReader(line for line in file if line.endswith("\n")))
        first = min(row["step"] for row in self.metrics)
        first = first if self.goes_on_from is None else min(first, self.goes_on_from)
        return [row for row in rows if self.begun or int(row["step"]) < first]


class WandbRun(WandbLogger):
    """Logger of a directory's only W&B run. Its id is in `save_dir/wandb_id`, so a resumed run continues it.

    `mode=online` becomes `offline`, with a warning, if the server does not answer or refuses; `wandb sync` uploads the
    log later. If W&B's own process dies, training goes on without it.

    Args:
        mode: online, offline or disabled.
        group, name: by default the sweep's folder (in a sweep), and the directory's name.
        scenes: number of scenes of a test that are shown.
    """

    def __init__(
        self,
        save_dir: str,
        mode: str,
        project: str,
        group: str | None = None,
        name: str | None = None,
        job_type: str | None = None,
        scenes: int = 16,
    ) -> None:
        if mode not in MODES:
            raise CompleteSplatError(f"wandb.mode={mode}: choose one of {', '.join(MODES)}")
        folder = Path(save_dir).absolute()
        if group is None and (folder.parent / "multirun.yaml").is_file():  # Hydra's file in a sweep's folder
            group = folder.parent.name
        about = {"mode": mode, "group": group, "job_type": job_type}
        try:
            super().__init__(name=name or folder.name, save_dir=save_dir, project=project, **about)  # type: ignore[arg-type]
        except ModuleNotFoundError as error:
            raise CompleteSplatError("logger=wandb needs wandb: pip install wandb, or leave it out") from error
        self._wandb_init.pop("anonymous", None)  # W&B would warn that Lightning gives it
        self.scenes = scenes
        self.lost = False

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """Return W&B's run, which begins at the first access."""
        if self._experiment is None:
            self._experiment = self._begin()
            self._experiment.define_metric(AXIS)
            self._experiment.define_metric("*", step_metric=AXIS, step_sync=True)
        return self._experiment

    def _begin(self) -> Any:
        import wandb

        limit = wandb.Settings(init_timeout=START_SECONDS)
        settings = self._wandb_init | {"id": self._id_of_folder(), "settings": limit}
        if settings["mode"] == "online":
            server = wandb.setup().settings.base_url
            try:
                if answers(server, ANSWER_SECONDS):
                    return wandb.init(**settings)
                reason = f"{server} does not answer"
            except wandb.Error as error:
                reason = str(error).partition("\n")[0]
            log.warning("W&B: %s; the run is kept offline, `wandb sync` uploads it later", reason)
            settings["mode"] = "offline"
        return wandb.init(**settings)

    def _id_of_folder(self) -> str:
        path = Path(self._save_dir) / "wandb_id"  # type: ignore[arg-type]
        if not (path.is_file() and path.read_text().strip()):
            write_text(path, secrets.token_hex(4) + "\n")
        return path.read_text().strip()

    @rank_zero_only
    def log_hyperparams(self, params: Any) -> None:
        """Add options to the run's config."""
        with self._dispensable():
            self.experiment.config.update(params, allow_val_change=True)

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, Any], step: int | None = None) -> None:
        """Log numbers, or W&B's images, histograms, tables and videos."""
        with self._dispensable(), self._files_beside():
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
    def _files_beside(self) -> Iterator[None]:
        """Let W&B copy the media of tables to the run's folder, because they would fill the user's home."""
        previous = os.environ.get(DATA)
        os.environ[DATA] = previous or str(Path(self._save_dir).absolute() / "wandb")  # type: ignore[arg-type]
        try:
            yield
        finally:
            if previous is None:
                del os.environ[DATA]

    @contextmanager
    def _dispensable(self) -> Iterator[None]:
        try:
            yield
        except ConnectionError as error:
            if not self.lost:
                log.warning("W&B: its process ended (%s); metrics.csv goes on without it", error)
            self.lost = True


@contextmanager
def finished(loggers: Iterable[Logger]) -> Iterator[None]:
    """Close W&B's runs in the end, so that the next job does not log to them; exit code 1 after an error."""
    exit_code = 1
    try:
        yield
        exit_code = 0
    finally:
        for logger in wandb_runs(loggers):
            logger.finish(exit_code)


def wandb_runs(loggers: Iterable[Logger]) -> list[WandbRun]:
    """Return the loggers that log to W&B."""
    return [logger for logger in loggers if isinstance(logger, WandbRun)]


def answers(url: str, seconds: float) -> bool:
    """Return whether a server answers, even with a refusal, within a time that includes the look-up of its name."""
    replies: list[bool] = []
    # The look-up of a name cannot be interrupted, so a thread that takes longer is abandoned.
    asking = threading.Thread(target=lambda: replies.append(_asked(url, seconds)), daemon=True)
    asking.start()
    asking.join(seconds)
    return replies == [True]


def _asked(url: str, seconds: float) -> bool:
    try:
        urlopen(url, timeout=seconds).close()
    except HTTPError as error:
        return error.code < 502  # a proxy reports 502 and above for a server that it does not reach
    except URLError as error:
        return isinstance(error.reason, SSLError)  # W&B may trust more certificates than Python
    except OSError:
        return False
    return True
