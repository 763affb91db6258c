"""The columns that a reader sees, how their figures are written, and which are best."""

from collections.abc import Sequence
from typing import Any

ALWAYS = ["full_novel_psnr", "full_novel_ssim", "object_novel_psnr", "object_novel_ssim", "full_reference_psnr"]
WHERE_MEASURED = ["full_novel_lpips", "full_novel_fid", "full_novel_kid"]
GROUPS = {
    "full_novel": "all pixels, novel views",
    "object_novel": "object pixels, novel views",
    "full_reference": "reference view",
}
METRICS = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS", "fid": "FID", "kid": "KID", "swd": "SWD"}
FORMATS = {"psnr": ".2f", "ssim": ".3f", "lpips": ".3f", "fid": ".1f", "kid": ".4f", "swd": ".2f"}
LOWER_IS_BETTER = {"lpips", "fid", "kid", "swd"}
SSIM_NOTE = (
    "SSIM: mean over all pixels, the picture mirrored at its border (skimage leaves 5 pixels out on every side)."
)
"""For tables with SSIM: the border is 37 % of the pixels of a picture of 48 x 48, 15 % of one of 128 x 128."""
BEST, SECOND, UNMARKED = "best", "second", ""


def columns(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The metrics to show."""
    return [*ALWAYS, *(name for name in WHERE_MEASURED if any(row.get(f"{name}_mean") is not None for row in rows))]


def group(column: str) -> str:
    """Which pixels of which views."""
    return GROUPS[column.rpartition("_")[0]]


def metric(column: str) -> str:
    """The metric's name with the direction that is better."""
    name = column.rpartition("_")[2]
    return f"{METRICS[name]} {'↓' if name in LOWER_IS_BETTER else '↑'}"


def figure(row: dict[str, Any], column: str) -> str:
    """`21.34 ± 0.12`; without a deviation where there is one seed only, empty where nothing was measured."""
    mean, deviation = row.get(f"{column}_mean"), row.get(f"{column}_deviation")
    form = FORMATS[column.rpartition("_")[2]]
    if mean is None:
        return ""
    return format(mean, form) if deviation is None else f"{mean:{form}} ± {deviation:{form}}"


def marks(rows: Sequence[dict[str, Any]], column: str) -> list[str]:
    """For each row, whether its mean is the best, the second best, or unmarked.

    Means are compared as they are written, so that rows which look equal share a mark. Rows without seeds, the naive
    predictors, and upper bounds do not compete.
    """
    name = column.rpartition("_")[2]
    sign = 1 if name in LOWER_IS_BETTER else -1
    competing = [row["seeds"] is not None and not row["upper_bound"] for row in rows]
    means = [row.get(f"{column}_mean") if competes else None for row, competes in zip(rows, competing, strict=True)]
    written = [None if mean is None else sign * float(format(mean, FORMATS[name])) for mean in means]
    ranked = sorted({value for value in written if value is not None and value == value})  # not-a-number is no rank
    given = dict(zip(ranked, (BEST, SECOND), strict=False))
    return [UNMARKED if value is None else given.get(value, UNMARKED) for value in written]
