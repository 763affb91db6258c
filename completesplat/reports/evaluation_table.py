"""The scores of several predictors, side by side."""

from typing import Any

from rich.console import Console
from rich.table import Table

from completesplat.reports.sweeps.headline import SSIM_NOTE

COLUMNS = [
    (region, view, metric)
    for region in ("full", "object")
    for view in ("novel", "reference")
    for metric in ("psnr", "ssim")
]
WHERE_MEASURED = ("lpips", "fid", "kid", "swd")
FORMATS = {"psnr": ".2f", "fid": ".1f", "kid": ".4f", "swd": ".1f"}
LABELS = {"full": "all\npixels", "object": "object\npixels", "psnr": "PSNR", "ssim": "SSIM"}


def evaluation_table(results: dict[str, Any]) -> Table:
    """One row for each predictor of `Evaluation.results`, PSNR in dB."""
    first = next(iter(results.values()))
    table = Table(title=f"{first['scenes']} scenes, {first['views']} novel views", caption=SSIM_NOTE)
    table.add_column("predictor", no_wrap=True)
    more = [("full", "novel", metric) for metric in WHERE_MEASURED if metric in first["full"]["novel"]]
    for region, view, metric in [*COLUMNS, *more]:
        label = LABELS.get(metric, metric.upper())
        table.add_column(f"{LABELS[region]}\n{view}\n{label}", justify="right", no_wrap=True)
    for predictor, scores in results.items():
        cells = [(metric, scores[region][view].get(metric)) for region, view, metric in [*COLUMNS, *more]]
        table.add_row(predictor, *("" if x is None else format(x, FORMATS.get(metric, ".3f")) for metric, x in cells))
    return table


def show(table: Table) -> None:
    """Print a table, in full width where the output is no terminal."""
    Console(width=None if Console().is_terminal else 120).print(table)
