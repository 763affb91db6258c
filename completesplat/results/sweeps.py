"""The table at the end of a sweep: ablations over seeds, as in the paper."""

import csv
import logging
import math
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from rich.console import Console

from completesplat.atomic import atomic_path
from completesplat.results.machine import machine
from completesplat.results.rows import IDENTITY, SEED, disagreeing, labels, rows
from completesplat.results.runs import Job, collect
from completesplat.results.tables import (
    MARKED_LATEX,
    MARKED_MARKDOWN,
    SSIM_NOTE,
    columns,
    escape,
    figure,
    group,
    marks,
    metric,
    table,
)

# An absolute path inside an argument, up to its last part.
FOLDERS = re.compile(r"""(?<![^=,\[\s'"])/(?:[^/,\]\s'"]+/)+(?=[^/,\]\s'"])""")


def remarks(jobs: Sequence[Job], rows: Sequence[dict[str, Any]], label: Callable[[Job], str]) -> list[str]:
    """Sentences: how many jobs have finished, which have not, what must not be compared, commit, machine and date."""
    finished = [job for job in jobs if job.metrics is not None]
    said = [f"{len(finished)} of {len(jobs)} jobs have finished."]
    missing = [_described(job, label) for job in jobs if job.metrics is None]
    if missing:
        said.append(f"Not finished: {'; '.join(missing)}.")
    return [*said, *_incomparable(finished, rows), _commits(jobs), _machine()]


def commands(jobs: Sequence[Job]) -> list[str]:
    """The commands that started the jobs, usually one. Of absolute paths only the last part is told."""
    given = (job.record["command"] for job in jobs if job.record)
    lines = (" ".join([program, *map(shlex.quote, arguments)]) for program, *arguments in given)
    return list(dict.fromkeys(FOLDERS.sub(".../", line) for line in lines))


def _described(job: Job, label: Callable[[Job], str]) -> str:
    """The job's folder; `no_skips, seed=1` where there is none yet."""
    seed = [f"seed={job.overrides[SEED]}"] if SEED in job.overrides else []
    return job.name or ", ".join([label(job), *seed])


def _incomparable(finished: Sequence[Job], rows: Sequence[dict[str, Any]]) -> list[str]:
    mixed = [row for row in rows if isinstance(row["scenes"], str) and row["seeds"] is not None]
    said = [f"{row['ablation']} has seen the views that it is scored on." for row in rows if row["upper_bound"]]
    said += [f"{row['ablation']}: its jobs were tested on different scenes ({row['scenes']})." for row in mixed]
    if len({row["scenes"] for row in rows if row["seeds"] is not None}) > 1:
        said.append("The rows were not tested on equally many scenes and do not compare.")
    for predictor in disagreeing(finished):
        said.append(f"{predictor} does not score the same in all jobs, so they differ in their test data; its mean.")
    return said


def _commits(jobs: Sequence[Job]) -> str:
    known = list(dict.fromkeys(job.record["commit"] or "unknown" for job in jobs if job.record))
    return f"Commit{'s' if len(known) > 1 else ''} {', '.join(known) or 'unknown'}."


def _machine() -> str:
    here = machine()
    hardware = ", ".join([here["processor"], f"{here['cores']} cores", *([here["gpu"]] if "gpu" in here else [])])
    software = f"{here['system']}, Python {here['python']}, torch {here['torch']}"
    return f"Summary of {here['date']}, made on {hardware}, {software}."


CAPTION = (
    "Mean ± sample standard deviation over seeds; PSNR in dB. "
    f"The best of our rows is in bold, the second best underlined. {SSIM_NOTE}"
)
NOTHING = "No job of this sweep has finished."


@dataclass(frozen=True)
class Summary:
    """A sweep's table and all that is said below it."""

    rows: list[dict[str, Any]]
    """Those of `completesplat.results.rows`."""
    remarks: list[str]
    commands: list[str]


def summarize(folder: Path) -> Summary:
    """Read all jobs of a sweep's folder, finished or not."""
    jobs = collect(folder)
    label = labels(jobs)
    table = rows([job for job in jobs if job.metrics is not None], label)
    return Summary(table, remarks(jobs, table, label), commands(jobs))


def latex(summary: Summary) -> str:
    """A `table` with the headline columns, best in bold and second best underlined, and the remarks below."""
    table = _tabular(summary) if summary.rows else [escape(NOTHING)]
    remarks = [escape(f"{remark} ") + r"\par" for remark in (CAPTION, *summary.remarks)]
    commands = [rf"\texttt{{{escape(command)}}}\par" for command in summary.commands]
    below = [r"\par\smallskip\footnotesize\raggedright", *remarks, *commands]
    lines = [r"% \usepackage{booktabs}", r"\begin{table}", r"\centering", *table, *below, r"\end{table}"]
    return "\n".join(lines) + "\n"


def _tabular(summary: Summary) -> list[str]:
    shown = columns(summary.rows)
    marked = {column: marks(summary.rows, column) for column in shown}
    groups = [(name, len(list(members))) for name, members in groupby(shown, key=group)]
    above = " & ".join(rf"\multicolumn{{{count}}}{{c}}{{{escape(name)}}}" for name, count in groups)
    heading = " & ".join(["ablation", "seeds", "scenes", *(escape(metric(column)) for column in shown)])
    lines = [rf"\begin{{tabular}}{{l{'r' * (2 + len(shown))}}}", r"\toprule"]
    lines += [rf"& & & {above} \\", rf"{heading} \\", r"\midrule"]
    for index, row in enumerate(summary.rows):
        if index and row["seeds"] is None and summary.rows[index - 1]["seeds"] is not None:
            lines.append(r"\midrule")  # the naive predictors, below our own
        figures = [_marked(figure(row, column), marked[column][index]) for column in shown]
        lines.append(" & ".join([*_identity(row), *figures]) + r" \\")
    return [*lines, r"\bottomrule", r"\end{tabular}"]


def _identity(row: dict[str, Any]) -> list[str]:
    return [escape("" if row[key] is None else str(row[key])) for key in ("ablation", "seeds", "scenes")]


def _marked(text: str, mark: str) -> str:
    return MARKED_LATEX[mark] % escape(text)


def markdown(summary: Summary) -> str:
    """The headline columns, best in bold and second best underlined, with the remarks below."""
    table = "\n".join(_markdown_table(summary)) if summary.rows else NOTHING
    remarks = "\n".join(f"- {remark}" for remark in summary.remarks)
    commands = "```\n" + "\n".join(summary.commands) + "\n```\n" if summary.commands else ""
    return f"{table}\n\n{CAPTION}\n\n{remarks}\n\n{commands}".rstrip() + "\n"


def _markdown_table(summary: Summary) -> list[str]:
    shown = columns(summary.rows)
    marked = {column: marks(summary.rows, column) for column in shown}
    lines = [
        _markdown_line(["ablation", "seeds", "scenes", *(f"{group(column)}: {metric(column)}" for column in shown)]),
        _markdown_line(["---", *["---:"] * (2 + len(shown))]),
    ]
    for index, row in enumerate(summary.rows):
        figures = [MARKED_MARKDOWN[marked[column][index]].format(figure(row, column)) for column in shown]
        counts = ["" if row[key] is None else str(row[key]) for key in ("seeds", "scenes")]
        lines.append(_markdown_line([row["ablation"].replace("|", r"\|"), *counts, *figures]))
    return lines


def _markdown_line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


COLUMN = "full_novel_psnr"
AXIS = "PSNR of novel views, all pixels (dB)"
LINES = {"mean_image": "--", "copy_reference": ":"}


def plot_summary(summary: Summary, path: Path) -> None:
    """Write a PNG: a bar for each setting with its deviation over seeds, the naive predictors as upright lines."""
    from matplotlib.figure import Figure

    ours = [row for row in summary.rows if row["seeds"] is not None]
    figure = Figure(figsize=(9, 1.6 + 0.42 * max(len(ours), 2)), layout="constrained")
    axes = figure.subplots()
    if not ours:
        axes.text(0.5, 0.5, NOTHING, ha="center", va="center")
        axes.set_axis_off()
    else:
        _draw(axes, ours, [row for row in summary.rows if row["seeds"] is None])
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw(axes: Any, ours: list[dict[str, Any]], naive: list[dict[str, Any]]) -> None:
    means = [_finite(row, "mean") for row in ours]
    deviations = [_finite(row, "deviation") for row in ours]
    bars = axes.barh(range(len(ours)), means, xerr=deviations, capsize=3, color="C0", height=0.7)
    axes.set_yticks(range(len(ours)), [row["ablation"] for row in ours])
    written = ["" if math.isnan(mean) else f"{mean:.2f}" for mean in means]
    axes.bar_label(bars, written, padding=4)
    for row in naive:
        value = _finite(row, "mean")
        if row["ablation"] in LINES and not math.isnan(value):
            style = LINES[row["ablation"]]
            axes.axvline(
                value, color="black", linestyle=style, label=f"{row['ablation'].replace('_', ' ')}, {value:.2f}"
            )
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


def write_summary(folder: Path) -> Summary:
    """Write `summary.csv` (all metrics), `summary.md`, `summary.tex` and `summary.png` into a sweep's folder."""
    summary = summarize(folder)
    _write_csv(summary, folder / "summary.csv")
    texts: dict[str, Callable[[Summary], str]] = {"md": markdown, "tex": latex}
    for suffix, text in texts.items():
        with atomic_path(folder / f"summary.{suffix}") as temporary:
            temporary.write_text(text(summary), encoding="utf-8")
    plot_summary(summary, folder / "summary.png")
    return summary


def show_summary(summary: Summary) -> None:
    """Print the headline columns, how SSIM was measured, and the remarks."""
    # No markup: a label may hold brackets. Without a terminal, wide enough for all columns.
    console = Console(width=None if Console().is_terminal else 160, markup=False, highlight=False)
    shown = columns(summary.rows)
    headings = [(f"{group(column).replace(', ', chr(10))}\n{metric(column)}", column, ">") for column in shown]
    rows = [row | {column: figure(row, column) for column in shown} for row in summary.rows]
    identity = [("ablation", "ablation", ""), ("seeds", "seeds", ">"), ("scenes", "scenes", ">")]
    console.print(table("Test scenes, mean ± deviation over seeds", [*identity, *headings], rows))
    for remark in (SSIM_NOTE, *summary.remarks):
        console.print(remark)


def _write_csv(summary: Summary, path: Path) -> None:
    header = list(summary.rows[0]) if summary.rows else IDENTITY
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, header)
        writer.writeheader()
        writer.writerows(summary.rows)


# Hydra imports this file for every run, also to print the help: all that is heavy is imported when a job has ended.
log = logging.getLogger(__name__)


class SweepSummary(Callback):
    """Rewrites a sweep's summary after every job and prints it after the last.

    A sweep that is killed, or whose jobs fail, thus has one too; hydra does not call `on_multirun_end` for it. A
    summary that cannot be written is logged as a warning with the reason, and the sweep goes on.
    """

    def on_job_end(self, config: Any, job_return: JobReturn, **kwargs: Any) -> None:
        """Rewrite the summary, whether the job finished or failed; nothing in a run that is no sweep."""
        if config.hydra.mode == RunMode.MULTIRUN:
            _summarize(config, show=False)

    def on_multirun_end(self, config: Any, **kwargs: Any) -> None:
        """Print the summary and where it is; written again, since jobs that end together may miss each other."""
        _summarize(config, show=True)


def _summarize(config: Any, show: bool) -> None:
    try:
        folder = Path(config.hydra.sweep.dir)
        summary = write_summary(folder)
        if show:
            show_summary(summary)
            print(folder / "summary.md")
    except Exception as error:  # whatever it is, the jobs that are still to come matter more
        log.warning("no summary of the sweep: %s: %s", type(error).__name__, error)
