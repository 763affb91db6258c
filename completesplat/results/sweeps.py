"""Summary of a sweep: a table of its settings over seeds, as in the paper, and a chart."""

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

from completesplat.files import atomic_path, write_text
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

# Hydra imports this file for every run, even to print the help, so numpy, torch, rich and matplotlib are imported only
# when a job has ended.
log = logging.getLogger(__name__)

CAPTION = (
    "Mean ± sample standard deviation over seeds; PSNR in dB. "
    f"The best of our rows is in bold, the second best underlined. {SSIM_NOTE}"
)
NOTHING = "No job of this sweep has finished."
FOLDERS = re.compile(r"""(?<![^=,\[\s'"])/(?:[^/,\]\s'"]+/)+(?=[^/,\]\s'"])""")
"""Pattern of an absolute path inside an argument, up to its last part."""
COLUMN = "full_novel_psnr"
AXIS = "PSNR of novel views, all pixels (dB)"
LINES = {"mean_image": "--", "copy_reference": ":"}


class SweepSummary(Callback):
    """Hydra callback that rewrites a sweep's summary after every job and prints it after the last.

    Thus a sweep that is killed, or whose jobs fail, has a summary too, although hydra does not call `on_multirun_end`
    for it. If a summary cannot be written, a warning states the reason, and the sweep continues.
    """

    def on_job_end(self, config: Any, job_return: JobReturn, **kwargs: Any) -> None:
        """Rewrite the summary, whether the job finished or failed; do nothing outside a sweep."""
        if config.hydra.mode == RunMode.MULTIRUN:
            _summarize(config, last=False)

    def on_multirun_end(self, config: Any, **kwargs: Any) -> None:
        """Write the summary again, because jobs that end together may miss each other; print it and its path."""
        _summarize(config, last=True)


def _summarize(config: Any, last: bool) -> None:
    try:
        folder = Path(config.hydra.sweep.dir)
        summary = write_summary(folder)
        if last:
            show_summary(summary)
            print(folder / "summary.md")
    except Exception as error:  # no error of a summary may stop the remaining jobs
        log.warning("no summary of the sweep: %s: %s", type(error).__name__, error)


@dataclass(frozen=True)
class Summary:
    """Rows of a sweep with all metrics in all digits, and a table of the headline columns with remarks.

    `commands` started the jobs; usually there is one. Their absolute paths are cut to the last part.
    """

    rows: list[dict[str, Any]]
    table: Table
    commands: list[str]


def summarize(*folders: Path) -> Summary:
    """Read all jobs of a sweep's folder, or of its parts on several machines, finished or not."""
    from completesplat.results.scores import rows

    jobs = collect(*folders)
    results = rows([job for job in jobs if job.metrics is not None])
    commands = dict.fromkeys(FOLDERS.sub(".../", typed(job.record["command"])) for job in jobs if job.record)
    return Summary(results, _table(results, _remarks(jobs, results)), list(commands))


def _table(rows: Sequence[dict[str, Any]], remarks: list[str]) -> Table:
    from completesplat.results.scores import figures, headline

    names, identity = headline(rows), ("ablation", "seeds", "scenes")
    body = [
        TableRow(
            "naive" if row["seeds"] is None else "ours",
            [*(Cell("" if row[key] is None else str(row[key])) for key in identity), *cells],
        )
        for row, cells in zip(rows, figures(rows, names), strict=True)
    ]
    headings = [Heading("ablation", figures=False), Heading("seeds"), Heading("scenes"), *map(score_heading, names)]
    return Table("summary", "Test scenes, mean ± deviation over seeds", headings, body, remarks)


def _remarks(jobs: Sequence[Job], rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return sentences on finished and missing jobs, on rows that do not compare, on commit, machine and date."""
    from completesplat.results.scores import disagreeing

    finished = [job for job in jobs if job.metrics is not None]
    remarks = [f"{len(finished)} of {len(jobs)} jobs have finished."]
    missing = []
    for job in (job for job in jobs if job.metrics is None):
        seed = [f"seed={job.overrides[SEED]}"] if SEED in job.overrides else []
        missing.append(job.name or ", ".join([job.label, *seed]))  # a job has no folder before it starts
    if missing:
        remarks.append(f"Not finished: {'; '.join(missing)}.")
    mixed = [row for row in rows if isinstance(row["scenes"], str) and row["seeds"] is not None]
    remarks += [f"{row['ablation']} has seen the views that it is scored on." for row in rows if row["upper_bound"]]
    remarks += [f"{row['ablation']}: its jobs were tested on different scenes ({row['scenes']})." for row in mixed]
    if len({row["scenes"] for row in rows if row["seeds"] is not None}) > 1:
        remarks.append("The rows were not tested on equally many scenes and do not compare.")
    for predictor in disagreeing(finished):
        remarks.append(f"{predictor} does not score the same in all jobs, so they differ in their test data; its mean.")
    commits = list(dict.fromkeys(job.record["commit"] or "unknown" for job in jobs if job.record))
    remarks.append(f"Commit{'s' if len(commits) > 1 else ''} {', '.join(commits) or 'unknown'}.")
    here = machine()
    hardware = ", ".join([here["processor"], f"{here['cores']} cores", *([here["gpu"]] if "gpu" in here else [])])
    software = f"{here['system']}, Python {here['python']}, torch {here['torch']}"
    return [*remarks, f"Summary of {here['date']}, made on {hardware}, {software}."]


def write_summary(folder: Path, *parts: Path) -> Summary:
    """Write `summary.csv` (all metrics), `summary.md`, `summary.tex` and `summary.png` into a sweep's folder.

    `parts` are the folders of one sweep on several machines; the files then cover all of them.
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
    """Plot a bar for each setting with its standard deviation over seeds, and naive predictors as vertical lines."""
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
    """Return a value, or NaN, which is not drawn, if it is missing or infinite."""
    value = row.get(f"{COLUMN}_{kind}")
    return value if value is not None and math.isfinite(value) else math.nan
