"""The scores of several predictors, side by side."""

from typing import Any

from rich.console import Console
from rich.table import Table

COLUMNS = [
    (region, view, metric)
    for region in ("full", "object")
    for view in ("novel", "reference")
    for metric in ("psnr", "ssim")
]
LABELS = {"full": "all\npixels", "object": "object\npixels", "psnr": "PSNR", "ssim": "SSIM"}


def evaluation_table(results: dict[str, Any]) -> Table:
    """One row for each predictor of `Evaluation.results`, PSNR in dB."""
    first = next(iter(results.values()))
    table = Table(title=f"{first['scenes']} scenes, {first['views']} novel views")
    table.add_column("predictor", no_wrap=True)
    for region, view, metric in COLUMNS:
        table.add_column(f"{LABELS[region]}\n{view}\n{LABELS[metric]}", justify="right", no_wrap=True)
    for predictor, scores in results.items():
        cells = [scores[region][view][metric] for region, view, metric in COLUMNS]
        formats = [".2f" if metric == "psnr" else ".3f" for _, _, metric in COLUMNS]
        table.add_row(predictor, *(format(cell, f) for cell, f in zip(cells, formats, strict=True)))
    return table


def show(table: Table) -> None:
    """Print a table, in full width where the output is no terminal."""
    Console(width=None if Console().is_terminal else 120).print(table)
