"""What is known of a sweep."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from completesplat.reports.sweeps.headline import SSIM_NOTE
from completesplat.reports.sweeps.jobs import collect
from completesplat.reports.sweeps.labels import labels
from completesplat.reports.sweeps.remarks import commands, remarks
from completesplat.reports.sweeps.rows import rows

CAPTION = (
    "Mean ± sample standard deviation over seeds; PSNR in dB. "
    f"The best of our rows is in bold, the second best underlined. {SSIM_NOTE}"
)
NOTHING = "No job of this sweep has finished."


@dataclass(frozen=True)
class Summary:
    """A sweep's table and all that is said below it."""

    rows: list[dict[str, Any]]
    """Those of `completesplat.reports.sweeps.rows`."""
    remarks: list[str]
    commands: list[str]


def summarize(folder: Path) -> Summary:
    """Read all jobs of a sweep's folder, finished or not."""
    jobs = collect(folder)
    label = labels(jobs)
    table = rows([job for job in jobs if job.metrics is not None], label)
    return Summary(table, remarks(jobs, table, label), commands(jobs))
