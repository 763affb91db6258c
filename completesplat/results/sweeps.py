"""The summary of a sweep: its settings over seeds as a table, as in the paper, and a chart."""

import logging
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from hydra.types import RunMode

from completesplat.atomic import atomic_path, write_text
from completesplat.results.machine import machine
from completesplat.results.runs import SEED, Job, collect, typed
from completesplat.results.tables import (
    SSIM_NOTE,
    Cell,
    Heading,
    Table,
    TableRow,
    escape,
    latex_lines,
    markdown_lines,
    score_heading,
    show,
    write_csv,
)

# Hydra imports this file for every run, also to print the help: numpy, torch, rich and matplotlib are imported when a
# job has ended.
log = logging.getLogger(__name__)

CAPTION = (
    "Mean ± sample standard deviation over seeds; PSNR in dB. "
    f"The best of our rows is in bold, the second best underlined. {SSIM_NOTE}"
)
NOTHING = "No job of this sweep has finished."
FOLDERS = re.compile(r"""(?<![^=,\[\s'"])/(?:[^/,\]\s'"]+/)+(?=[^/,\]\s'"])""")
"""An absolute path inside an argument, up to its last part."""
COLUMN = "full_novel_psnr"
AXIS = "PSNR of novel views, all pixels (dB)"
LINES = {"mean_image": "--", "copy_reference": ":"}


class SweepSummary(Callback):
    """Rewrites a sweep's summary after every job and prints it after the last.

    A sweep that is killed, or whose jobs fail, thus has one too; hydra does not call `on_multirun_end` for it. A
    summary that cannot be written is logged as a warning with the reason, and the sweep goes on.
    """

    def on_job_end(self, config: Any, job_return: JobReturn, **kwargs: Any) -> None:
        """Rewrite the summary, whether the job finished or failed; nothing in a run that is no sweep."""
        if config.hydra.mode == RunMode.MULTIRUN:
            _summarize(config, last=False)

    def on_multirun_end(self, config: Any, **kwargs: Any) -> None:
        """Print the summary and where it is; written again, since jobs that end together may miss each other."""
        _summarize(config, last=True)


def _summarize(config: Any, last: bool) -> None:
    try:
        folder = Path(config.hydra.sweep.dir)
        summary = write_summary(folder)
        if last:
            show_summary(summary)
            print(folder / "summary.md")
    except Exception as error:  # whatever it is, the jobs that are still to come matter more
        log.warning("no summary of the sweep: %s: %s", type(error).__name__, error)


@dataclass(frozen=True)
class Summary:
    """What is said of a sweep: rows with all metrics in all digits, and a table of the headline columns with remarks.

    `commands` started the jobs; usually there is one. Each absolute path is cut to its last part.
    """

    rows: list[dict[str, Any]]
    table: Table
    commands: list[str]


def summarize(*folders: Path) -> Summary:
    """Read all jobs of a sweep's folder, or of its parts on several machines, finished or not."""
    from completesplat.results.scores import rows

    jobs = collect(*folders)
    found = rows([job for job in jobs if job.metrics is not None])
    commands = dict.fromkeys(FOLDERS.sub(".../", typed(job.record["command"])) for job in jobs if job.record)
    return Summary(found, _table(found, _remarks(jobs, found)), list(commands))


def _table(rows: Sequence[dict[str, Any]], remarks: list[str]) -> Table:
    from completesplat.results.scores import figures, headline

    shown, identity = headline(rows), ("ablation", "seeds", "scenes")
    body = [
        TableRow(
            "naive" if row["seeds"] is None else "ours",
            [*(Cell("" if row[key] is None else str(row[key])) for key in identity), *cells],
        )
        for row, cells in zip(rows, figures(rows, shown), strict=True)
    ]
    headings = [Heading("ablation", figures=False), Heading("seeds"), Heading("scenes"), *map(score_heading, shown)]
    return Table("summary", "Test scenes, mean ± deviation over seeds", headings, body, remarks)


def _remarks(jobs: Sequence[Job], rows: Sequence[dict[str, Any]]) -> list[str]:
    """Sentences: how many jobs have finished, which have not, what must not be compared, commit, machine and date."""
    from completesplat.results.scores import disagreeing

    finished = [job for job in jobs if job.metrics is not None]
    said = [f"{len(finished)} of {len(jobs)} jobs have finished."]
    missing = []
    for job in (job for job in jobs if job.metrics is None):
        seed = [f"seed={job.overrides[SEED]}"] if SEED in job.overrides else []
        missing.append(job.name or ", ".join([job.label, *seed]))  # there is no folder before a job starts
    if missing:
        said.append(f"Not finished: {'; '.join(missing)}.")
    mixed = [row for row in rows if isinstance(row["scenes"], str) and row["seeds"] is not None]
    said += [f"{row['ablation']} has seen the views that it is scored on." for row in rows if row["upper_bound"]]
    said += [f"{row['ablation']}: its jobs were tested on different scenes ({row['scenes']})." for row in mixed]
    if len({row["scenes"] for row in rows if row["seeds"] is not None}) > 1:
        said.append("The rows were not tested on equally many scenes and do not compare.")
    for predictor in disagreeing(finished):
        said.append(f"{predictor} does not score the same in all jobs, so they differ in their test data; its mean.")
    commits = list(dict.fromkeys(job.record["commit"] or "unknown" for job in jobs if job.record))
    said.append(f"Commit{'s' if len(commits) > 1 else ''} {', '.join(commits) or 'unknown'}.")
    here = machine()
    hardware = ", ".join([here["processor"], f"{here['cores']} cores", *([here["gpu"]] if "gpu" in here else [])])
    software = f"{here['system']}, Python {here['python']}, torch {here['torch']}"
    return [*said, f"Summary of {here['date']}, made on {hardware}, {software}."]


def write_summary(folder: Path, *parts: Path) -> Summary:
    """Write `summary.csv` (all metrics), `summary.md`, `summary.tex` and `summary.png` into a sweep's folder.

    With `parts`, the folders of one sweep on several machines, they are of all of these.
    """
    from completesplat.results.scores import IDENTITY

    summary = summarize(*(parts or [folder]))
    header = list(summary.rows[0]) if summary.rows else IDENTITY
    write_csv(folder / "summary.csv", header, ([row.get(key) for key in header] for row in summary.rows))
    write_text(folder / "summary.md", _markdown(summary))
    write_text(folder / "summary.tex", _latex(summary))
    _plot(summary.rows, folder / "summary.png")
    return summary


def _markdown(summary: Summary) -> str:
    table = "\n".join(markdown_lines(summary.table)) if summary.rows else NOTHING
    remarks = "\n".join(f"- {remark}" for remark in summary.table.remarks)
    commands = "```\n" + "\n".join(summary.commands) + "\n```\n" if summary.commands else ""
    return f"{table}\n\n{CAPTION}\n\n{remarks}\n\n{commands}".rstrip() + "\n"


def _latex(summary: Summary) -> str:
    table = latex_lines(summary.table) if summary.rows else [escape(NOTHING)]
    remarks = [escape(f"{remark} ") + r"\par" for remark in (CAPTION, *summary.table.remarks)]
    commands = [rf"\texttt{{{escape(command)}}}\par" for command in summary.commands]
    below = [r"\par\smallskip\footnotesize\raggedright", *remarks, *commands]
    lines = [r"% \usepackage{booktabs}", r"\begin{table}", r"\centering", *table, *below, r"\end{table}"]
    return "\n".join(lines) + "\n"


def show_summary(summary: Summary) -> None:
    """Print the headline columns, how SSIM was measured, and the remarks."""
    table = summary.table
    narrow = [replace(heading, group=heading.group.replace(", ", "\n")) for heading in table.headings]
    show(replace(table, headings=narrow, remarks=[SSIM_NOTE, *table.remarks]), width=160)


def _plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """A bar for each setting with its deviation over seeds, the naive predictors as upright lines."""
    from matplotlib.figure import Figure

    ours = [row for row in rows if row["seeds"] is not None]
    figure = Figure(figsize=(9, 1.6 + 0.42 * max(len(ours), 2)), layout="constrained")
    axes = figure.subplots()
    if not ours:
        axes.text(0.5, 0.5, NOTHING, ha="center", va="center")
        axes.set_axis_off()
    else:
        _draw(axes, ours, [row for row in rows if row["seeds"] is None])
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw(axes: Any, ours: list[dict[str, Any]], naive: list[dict[str, Any]]) -> None:
    means = [_finite(row, "mean") for row in ours]
    deviations = [_finite(row, "deviation") for row in ours]
    bars = axes.barh(range(len(ours)), means, xerr=deviations, capsize=3, color="C0", height=0.7)
    axes.set_yticks(range(len(ours)), [row["ablation"] for row in ours])
    axes.bar_label(bars, ["" if math.isnan(mean) else f"{mean:.2f}" for mean in means], padding=4)
    for row in naive:
        name, value = row["ablation"], _finite(row, "mean")
        if name in LINES and not math.isnan(value):
            label = f"{name.replace('_', ' ')}, {value:.2f}"
            axes.axvline(value, color="black", linestyle=LINES[name], label=label)
    axes.invert_yaxis()  # as in the table, the first row is on top
    axes.margins(x=0.1)
    axes.set_xlim(left=0)
    axes.set_xlabel(AXIS)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    if axes.get_legend_handles_labels()[0]:
        axes.figure.legend(loc="outside upper right", ncols=len(LINES))


def _finite(row: dict[str, Any], kind: str) -> float:
    """Not-a-number, which is not drawn, for all that has no place on an axis."""
    value = row.get(f"{COLUMN}_{kind}")
    return value if value is not None and math.isfinite(value) else math.nan
