"""Scores of jobs as rows: their numbers against the files of the jobs, how they are named, which are marked."""

import json
import math
from typing import Any

import numpy as np
import pandas as pd
import pytest

from completesplat.results.runs import collect
from completesplat.results.scores import ALWAYS, figures, headline, time_cell
from completesplat.results.sweeps import summarize, write_summary


def read_back(folder) -> pd.DataFrame:
    return pd.read_csv(folder / "summary.csv").set_index("ablation")


def test_the_summary_agrees_with_the_files_of_the_jobs(ablations) -> None:
    write_summary(ablations.folder)
    found: dict[tuple[str, str], list[float]] = {}
    for path in ablations.folder.glob("*/metrics.json"):
        overrides = json.loads(path.with_name("run.json").read_text())["overrides"]
        (ablation,) = (o.removeprefix("ablation=") for o in overrides if o.startswith("ablation="))
        for region, views in json.loads(path.read_text())["test"]["model"].items():
            if region in ("full", "object"):
                for view, metrics in views.items():
                    for metric, value in metrics.items():
                        found.setdefault((ablation, f"{region}_{view}_{metric}"), []).append(value)
    table = read_back(ablations.folder)
    assert len(found) == 9
    for (ablation, name), values in found.items():
        assert len(values) == 3
        np.testing.assert_allclose(table.loc[ablation, f"{name}_mean"], sum(values) / 3, rtol=1e-12)
        np.testing.assert_allclose(table.loc[ablation, f"{name}_deviation"], np.std(values, ddof=1), atol=1e-12)
    assert list(table.columns[:4]) == ["seeds", "scenes", "steps", "upper_bound"]
    assert set(table.columns[4:]) == {f"{name}_{kind}" for _, name in found for kind in ("mean", "deviation")}
    assert list(table.index) == ["m1", "no_skips", "full", "mean_image", "copy_reference"]
    assert list(table.loc["full"][:3]) == [3, 40, 9]


def test_one_seed_has_no_deviation_and_one_that_diverged_is_not_left_out_of_the_mean(sweep) -> None:
    sweep.scored("seed=0", psnr=20.0)
    write_summary(sweep.folder)
    table = read_back(sweep.folder)
    assert table.loc["small", "full_novel_psnr_mean"] == 20
    assert table["full_novel_psnr_deviation"].isna().all()
    sweep.scored("seed=1", psnr=math.nan)
    write_summary(sweep.folder)
    assert math.isnan(summarize(sweep.folder).rows[0]["full_novel_psnr_mean"])
    assert ",nan,nan" in (sweep.folder / "summary.csv").read_text()


def test_what_one_seed_lacks_is_empty_in_its_row_and_no_mean_of_fewer(sweep) -> None:
    sweep.scored("ablation=m1", "seed=0", psnr=20.0, full_novel_lpips=0.5)
    sweep.scored("ablation=m1", "seed=1", psnr=21.0)
    sweep.scored("ablation=full", "seed=0", psnr=22.0, full_novel_lpips=0.25)
    write_summary(sweep.folder)
    table = read_back(sweep.folder)
    assert table["full_novel_lpips_mean"].isna().tolist() == [True, False, True, True]
    assert table.loc["full", "full_novel_lpips_mean"] == 0.25
    assert table.loc["m1", "full_novel_psnr_mean"] == 20.5


def test_naive_predictors_are_below_without_seeds_and_averaged_with_a_remark_where_jobs_differ(sweep) -> None:
    sweep.scored("seed=0", psnr=20.0)
    summary = summarize(sweep.folder)
    assert not any("mean_image" in said for said in summary.table.remarks)
    for row, psnr in zip(summary.rows[1:], (15.0, 12.0), strict=True):
        assert (row["seeds"], row["steps"], row["scenes"]) == (None, None, 40)
        assert (row["full_novel_psnr_mean"], row["full_novel_psnr_deviation"]) == (psnr, None)
    other = sweep.scored("seed=1", psnr=20.0) / "metrics.json"
    other.write_text(other.read_text().replace("15.0", "17.0"))
    summary = summarize(sweep.folder)
    assert [row["full_novel_psnr_mean"] for row in summary.rows] == [20, 16, 12]
    (said,) = (said for said in summary.table.remarks if "does not score the same in all jobs" in said)
    assert "mean_image" in said


def test_different_numbers_of_scenes_are_not_passed_over(sweep) -> None:
    sweep.scored("ablation=m1", "seed=0", psnr=20.0, scenes=40, steps=9)
    sweep.scored("ablation=m1", "seed=1", psnr=20.0, scenes=38, steps=7)
    sweep.scored("ablation=full", "seed=0", psnr=20.0, scenes=40)
    sweep.add("ablation=untested", test={})
    summary = summarize(sweep.folder)
    assert [(row["scenes"], row["steps"]) for row in summary.rows[:3]] == [("40/38", "9/7"), (None, 9), (40, 9)]
    assert "m1: its jobs were tested on different scenes (40/38)." in summary.table.remarks
    assert any("do not compare" in said for said in summary.table.remarks)


def test_neither_the_protocol_nor_seconds_are_scores(sweep) -> None:
    model = {"scenes": 4, "views": 8, "seconds": {"inference": 2.0}, "full": {"novel": {"psnr": 20.0}}}
    sweep.add("seed=0", test={"protocol": {"scenes": 4}, "model": model, "mean_image": model})
    sweep.add("seed=1")
    first, second = collect(sweep.folder)
    assert list(first.test) == ["model", "mean_image"]
    assert (first.protocol, second.protocol) == ({"scenes": 4}, {})
    own, naive = summarize(sweep.folder).rows
    assert (own["ablation"], naive["ablation"]) == ("small", "mean_image")
    assert [name for name in own if name.endswith("_mean")] == ["full_novel_psnr_mean"]


def named(sweep) -> list[str]:
    return [row["ablation"] for row in summarize(sweep.folder).rows if row["seeds"] is not None]


@pytest.mark.parametrize(
    ("varied", "names"),
    [
        (["optimizer.lr=0.1", "optimizer.lr=0.2"], ["optimizer.lr=0.1", "optimizer.lr=0.2"]),
        (["+loss.kl.weight=1", "+loss.kl.weight=2"], ["loss.kl.weight=1", "loss.kl.weight=2"]),
        (["batch=2", "batch=10"], ["batch=10", "batch=2"]),  # no group, though without a dot
        (["data/source=a", "data/source=b"], ["a", "b"]),
        (["a.b=[0,1]", "a.b=[0]"], ["a.b=[0,1]", "a.b=[0]"]),
        (["data.seed=0", "data.seed=1"], ["data.seed=0", "data.seed=1"]),
        (["model=b ablation=full", "model=a ablation=full", "model=b ablation=m1"], ["a, full", "b, m1", "b, full"]),
        (["ablation=no_skips", "model=splatter_image", ""], ["no_skips", "small", "splatter_image"]),
    ],
)  # fmt: skip
def test_groups_are_named_by_their_choice_and_settings_with_their_key(sweep, varied, names) -> None:
    for overrides in varied:
        sweep.scored(*overrides.split(), "seed=3", psnr=20.0)
    assert named(sweep) == names


def test_jobs_that_differ_in_seed_or_order_alone_make_one_row_with_the_name_of_the_experiment(sweep) -> None:
    for seed in range(2):
        sweep.scored("ablation=m1", "model=var", f"seed={seed}", psnr=20.0)
        sweep.scored("model=var", f"seed={2 + seed}", "ablation=m1", psnr=20.0)
    row = summarize(sweep.folder).rows[0]
    assert (row["ablation"], row["seeds"]) == ("small", 4)
    for run in sweep.folder.glob("*/run.json"):
        run.write_text(run.read_text().replace('"experiment=small", ', ""))
    assert named(sweep) == ["all"]


PSNR = "full_novel_psnr"


def scored(means: list[Any], column: str = PSNR, naive: int = 0) -> list[dict[str, Any]]:
    """One row for each mean; the last `naive` of them without seeds."""
    competing = len(means) - naive
    return [
        {"seeds": 2 if i < competing else None, "upper_bound": False, f"{column}_mean": mean}
        for i, mean in enumerate(means)
    ]


def marked(rows: list[dict[str, Any]], column: str = PSNR) -> list[str]:
    return [cells[0].mark for cells in figures(rows, [column])]


@pytest.mark.parametrize(
    ("column", "means", "expected"),
    [
        ("full_novel_ssim", [0.8, 0.9, 0.7], ["second", "best", ""]),
        ("full_novel_lpips", [0.2, 0.3, 0.1], ["second", "", "best"]),
        (PSNR, [22.0, 22.0, 21.0, 21.0, 20.0], ["best", "best", "second", "second", ""]),
        (PSNR, [21.996, 22.001, 21.98], ["best", "best", "second"]),  # as written: 22.00, 22.00, 21.98
        (PSNR, [None, 22.0, float("nan"), 21.0], ["", "best", "", "second"]),
        (PSNR, [float("inf"), 30.0], ["best", "second"]),
        (PSNR, [float("nan")], [""]),
    ],
)
def test_best_and_second_best_follow_the_metrics_direction(column, means, expected) -> None:
    assert marked(scored(means, column), column) == expected


def test_naive_predictors_and_upper_bounds_do_not_compete() -> None:
    first, *others = scored([30.0, 20.0, 21.0, 25.0, 21.0], naive=2)
    assert marked([first | {"upper_bound": True}, *others]) == ["", "second", "best", "", ""]


def test_metrics_that_few_sweeps_measure_are_shown_where_they_were() -> None:
    assert headline(scored([20.0])) == ALWAYS
    assert headline([*scored([20.0]), *scored([0.1], "full_novel_lpips")]) == [*ALWAYS, "full_novel_lpips"]


@pytest.mark.parametrize(("deviation", "text"), [(0.126, "21.34 ± 0.13"), (None, "21.34"), (0.0, "21.34 ± 0.00")])
def test_a_figure_is_mean_and_deviation_equally_precise(deviation, text) -> None:
    row = {"seeds": 2, "upper_bound": False, f"{PSNR}_mean": 21.344, f"{PSNR}_deviation": deviation}
    assert figures([row], [PSNR])[0][0].text == text


def test_times_are_in_the_units_of_the_paper() -> None:
    found = [time_cell(seconds).text for seconds in (0.0157, 54, 246.0, None)]
    assert found == ["15.7 ms", "54.0 sec", "4.1 min", "-"]
