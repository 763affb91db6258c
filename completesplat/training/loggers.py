"""`metrics.csv`, also of a run that was interrupted and goes on."""

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter


class ContinuedCSVLogger(CSVLogger):
    """Writes `metrics.csv`, each row at once, so that a run that is killed keeps what it logged.

    Of what the file holds already, the rows before the first step that is logged now stay; the others are what an
    interrupted run did after its last checkpoint, and is done again.
    """

    def __init__(self, save_dir: str) -> None:
        super().__init__(save_dir, name="", version="", flush_logs_every_n_steps=1)

    @property
    @rank_zero_experiment
    def experiment(self) -> "MetricsFile":
        """The file (Lightning's name for what a logger writes to)."""
        if self._experiment is None:
            self._experiment = MetricsFile(self.log_dir)
        return self._experiment  # type: ignore[return-value]


class MetricsFile(ExperimentWriter):
    """Rows of numbers, appended to `metrics.csv`; it is made anew, as a whole, when a column is added."""

    def __init__(self, log_dir: str) -> None:
        super().__init__(log_dir)
        self.path = Path(self.metrics_file_path)
        self.begun = False

    def _check_log_dir_exists(self) -> None:
        """Keep the old file until there is something to put in its place; Lightning would delete it here."""

    def save(self) -> None:
        """Write the rows that are not written yet."""
        if not self.metrics:
            return
        new = set().union(*self.metrics) - set(self.metrics_keys)
        if new or not self.begun:
            old = self._rows_to_keep()
            self.metrics_keys = sorted(new.union(self.metrics_keys, *old))
            self._replace([*old, *self.metrics])
        else:
            with self.path.open("a", newline="") as file:
                csv.DictWriter(file, self.metrics_keys).writerows(self.metrics)
        self.metrics, self.begun = [], True

    def _rows_to_keep(self) -> list[dict[str, str]]:
        if not self.path.is_file():
            return []
        with self.path.open(newline="") as file:
            # The last line of a process that was killed may have no end.
            rows = list(csv.DictReader(line for line in file if line.endswith("\n")))
        first = min(row["step"] for row in self.metrics)
        return [row for row in rows if self.begun or int(row["step"]) < first]

    def _replace(self, rows: Iterable[Mapping[str, Any]]) -> None:
        temporary = self.path.with_suffix(".csv.new")
        with temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self.metrics_keys)
            writer.writeheader()
            writer.writerows(rows)
        temporary.replace(self.path)
