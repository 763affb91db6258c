"""A sweep's summary as files, and on the terminal."""

import csv
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from completesplat.export.atomic import atomic_path
from completesplat.reports.sweeps.chart import plot_summary
from completesplat.reports.sweeps.headline import SSIM_NOTE, columns, figure, group, metric
from completesplat.reports.sweeps.latex import latex
from completesplat.reports.sweeps.markdown import markdown
from completesplat.reports.sweeps.rows import IDENTITY
from completesplat.reports.sweeps.summary import Summary, summarize
from completesplat.reports.tables import table


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
