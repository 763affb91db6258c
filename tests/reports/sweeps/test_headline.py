"""What readers see of a sweep, and what is marked as best."""

from typing import Any

import pytest

from completesplat.results.tables import ALWAYS, BEST, SECOND, UNMARKED, columns, figure, marks, metric

PSNR = "full_novel_psnr"


def rows(means: list[Any], column: str = PSNR, naive: int = 0) -> list[dict[str, Any]]:
    """One row for each mean; the last `naive` of them without seeds."""
    competing = len(means) - naive
    return [
        {"seeds": 2 if i < competing else None, "upper_bound": False, f"{column}_mean": mean}
        for i, mean in enumerate(means)
    ]


@pytest.mark.parametrize(
    ("column", "means", "expected"),
    [
        (PSNR, [20.0, 22.0, 21.0, 19.0], ["", "best", "second", ""]),
        ("full_novel_ssim", [0.8, 0.9, 0.7], ["second", "best", ""]),
        ("full_novel_lpips", [0.2, 0.3, 0.1], ["second", "", "best"]),
        ("full_novel_fid", [12.0, 11.0], ["second", "best"]),
        ("full_novel_kid", [0.02, 0.01], ["second", "best"]),
        (PSNR, [22.0, 22.0, 21.0, 21.0, 20.0], ["best", "best", "second", "second", ""]),
        (PSNR, [21.996, 22.001, 21.98], ["best", "best", "second"]),  # as written: 22.00, 22.00, 21.98
        (PSNR, [None, 22.0, float("nan"), 21.0], ["", "best", "", "second"]),
        (PSNR, [float("inf"), 30.0], ["best", "second"]),
        (PSNR, [float("nan")], [""]),
        (PSNR, [None, None], ["", ""]),
        (PSNR, [20.0], ["best"]),
    ],
)
def test_best_and_second_best_follow_the_metrics_direction(column, means, expected) -> None:
    assert marks(rows(means, column), column) == expected


def test_naive_predictors_do_not_compete() -> None:
    assert marks(rows([20.0, 21.0, 25.0, 21.0], naive=2), PSNR) == ["second", "best", "", ""]


@pytest.mark.parametrize(
    ("name", "arrow"),
    [("psnr", "PSNR ↑"), ("ssim", "SSIM ↑"), ("lpips", "LPIPS ↓"), ("fid", "FID ↓"), ("kid", "KID ↓")],
)
def test_the_heading_says_which_direction_is_better(name, arrow) -> None:
    assert metric(f"full_novel_{name}") == arrow


def test_metrics_that_few_sweeps_measure_are_shown_where_they_were() -> None:
    assert columns(rows([20.0])) == ALWAYS
    assert columns([*rows([20.0]), *rows([0.1], "full_novel_lpips")]) == [*ALWAYS, "full_novel_lpips"]


@pytest.mark.parametrize(
    ("mean", "deviation", "text"),
    [(21.344, 0.126, "21.34 ± 0.13"), (21.344, None, "21.34"), (None, None, ""), (21.0, 0.0, "21.00 ± 0.00")],
)
def test_a_figure_is_mean_and_deviation_equally_precise(mean, deviation, text) -> None:
    assert figure({f"{PSNR}_mean": mean, f"{PSNR}_deviation": deviation}, PSNR) == text


def test_upper_bounds_do_not_compete():
    rows = [
        {"seeds": 1, "upper_bound": bound, "full_novel_psnr_mean": mean}
        for bound, mean in ((True, 30.0), (False, 18.0), (False, 17.0))
    ]
    assert marks(rows, "full_novel_psnr") == [UNMARKED, BEST, SECOND]
