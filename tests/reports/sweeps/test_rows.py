"""The numbers of a sweep's summary, against the files of its jobs."""

import json
import math

import numpy as np
import pandas as pd
import pytest

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


def test_the_deviation_is_that_of_a_sample(sweep) -> None:
    for seed, psnr in enumerate((19.0, 21.0)):
        sweep.scored(f"seed={seed}", psnr=psnr)
    row = summarize(sweep.folder).rows[0]
    assert row["full_novel_psnr_mean"] == 20
    assert row["full_novel_psnr_deviation"] == pytest.approx(math.sqrt(2))


def test_one_seed_has_no_deviation(sweep) -> None:
    sweep.scored("seed=0", psnr=20.0)
    write_summary(sweep.folder)
    table = read_back(sweep.folder)
    assert table.loc["small", "full_novel_psnr_mean"] == 20
    assert table["full_novel_psnr_deviation"].isna().all()


def test_what_one_seed_lacks_is_empty_in_its_row_and_no_mean_of_fewer(sweep) -> None:
    sweep.scored("ablation=m1", "seed=0", psnr=20.0, full_novel_lpips=0.5)
    sweep.scored("ablation=m1", "seed=1", psnr=21.0)
    sweep.scored("ablation=full", "seed=0", psnr=22.0, full_novel_lpips=0.25)
    write_summary(sweep.folder)
    table = read_back(sweep.folder)
    assert table["full_novel_lpips_mean"].isna().tolist() == [True, False, True, True]
    assert table.loc["full", "full_novel_lpips_mean"] == 0.25
    assert table.loc["m1", "full_novel_psnr_mean"] == 20.5
    header, first, *_ = (sweep.folder / "summary.csv").read_text().splitlines()
    assert dict(zip(header.split(","), first.split(","), strict=True))["full_novel_lpips_mean"] == ""


def test_a_seed_that_diverged_is_not_left_out_of_the_mean(sweep) -> None:
    sweep.scored("seed=0", psnr=20.0)
    sweep.scored("seed=1", psnr=math.nan)
    write_summary(sweep.folder)
    assert math.isnan(summarize(sweep.folder).rows[0]["full_novel_psnr_mean"])
    assert ",nan,nan" in (sweep.folder / "summary.csv").read_text()


def test_the_naive_predictors_are_below_without_seeds(ablations) -> None:
    *_, mean_image, copy_reference = summarize(ablations.folder).rows
    for row, psnr in ((mean_image, 15.0), (copy_reference, 12.0)):
        assert (row["seeds"], row["steps"], row["scenes"]) == (None, None, 40)
        assert row["full_novel_psnr_mean"] == psnr
        assert row["full_novel_psnr_deviation"] is None
        assert row["object_novel_psnr_mean"] is None


def test_naive_predictors_that_differ_between_jobs_are_averaged_and_said(sweep) -> None:
    sweep.scored("seed=0", psnr=20.0)
    assert not any("mean_image" in said for said in summarize(sweep.folder).remarks)
    other = sweep.scored("seed=1", psnr=20.0) / "metrics.json"
    other.write_text(other.read_text().replace("15.0", "17.0"))
    summary = summarize(sweep.folder)
    assert [row["full_novel_psnr_mean"] for row in summary.rows] == [20, 16, 12]
    (said,) = (said for said in summary.remarks if "mean_image" in said)
    assert "does not score the same in all jobs" in said
    assert not any("copy_reference" in said for said in summary.remarks)


def test_different_numbers_of_scenes_are_not_passed_over(sweep) -> None:
    sweep.scored("ablation=m1", "seed=0", psnr=20.0, scenes=40, steps=9)
    sweep.scored("ablation=m1", "seed=1", psnr=20.0, scenes=38, steps=7)
    sweep.scored("ablation=full", "seed=0", psnr=20.0, scenes=40)
    summary = summarize(sweep.folder)
    assert [row["scenes"] for row in summary.rows[:2]] == ["40/38", 40]
    assert [row["steps"] for row in summary.rows[:2]] == ["9/7", 9]
    assert "m1: its jobs were tested on different scenes (40/38)." in summary.remarks
    assert any("do not compare" in said for said in summary.remarks)


def test_equal_numbers_of_scenes_need_no_remark(ablations) -> None:
    assert not any("scenes" in said for said in summarize(ablations.folder).remarks)


def test_a_job_without_a_test_has_its_row_without_figures(sweep) -> None:
    sweep.add("ablation=m1", test={})
    sweep.scored("ablation=full", psnr=20.0)
    first, second, *_ = summarize(sweep.folder).rows
    assert (first["ablation"], first["scenes"], first["full_novel_psnr_mean"]) == ("m1", None, None)
    assert second["full_novel_psnr_mean"] == 20
