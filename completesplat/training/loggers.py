"""Logger of `metrics.csv`, which a resumed run continues."""

import csv
import io
from collections.abc import Iterable, Mapping
from pathlib import Path

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter

from completesplat.files import write_text, writing


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
        self.begun = False
        self.goes_on_from: int | None = None

    def _check_log_dir_exists(self) -> None:
        """Keep the old file until it is replaced; Lightning would delete it here."""

    def save(self) -> None:
        """Write the rows that are not written yet.

        Raises:
            DiskError: the disk is full, or the folder no longer exists.
        """
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

    def _lines(self, rows: Iterable[Mapping[str, object]], header: bool) -> str:
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
