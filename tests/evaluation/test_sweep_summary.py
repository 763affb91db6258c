"""A sweep's summary: rows against the files of the jobs, names, marks, remarks, files, and the hook in a real sweep."""

import json
import math
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import pandas as pd
import pytest
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from readers import put
from support import python

from completesplat.evaluation.provenance import machine
from completesplat.evaluation.records import job_entries
from completesplat.evaluation.score_tables import Entry, score_rows, time_cell
from completesplat.evaluation.sweep_summary import IDENTITY, summarize, write_summary
from completesplat.evaluation.table_writers import as_markdown, escape, show
from completesplat.evaluation.tables import SSIM_NOTE, Notes
from completesplat.files import write_json

FILES = ["summary.csv", "summary.md", "summary.tex"]
PSNR = "full_novel_psnr"


def read_back(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "summary.csv").set_index("ablation")


def remarks(sweep) -> list[str]:
    return summarize(sweep.folder)[1].remarks[1:]


def test_the_same_image_is_called_so_as_in_the_terminal_and_in_the_tables_of_reports(sweep) -> None:
    for seed in range(2):
        job = sweep.scored(f"seed={seed}", psnr=20.0, full_reference_psnr=100.0)
        put("metrics.json", "test.copy_reference.full.reference", {"psnr": 100.0})(job)
    lines = as_markdown(write_summary(sweep.folder)).splitlines()
    (model,), (copied,) = (
        [line for line in lines if line.startswith(f"| {name} |")] for name in ("small", "copy_reference")
    )
    assert "the same image** |" in model
    assert "| the same image |" in copied
    assert "100.00" not in (sweep.folder / "summary.md").read_text()
    assert read_back(sweep.folder).loc["copy_reference", "full_reference_psnr_mean"] == 100


def test_one_seed_has_no_deviation_one_without_a_score_no_mean_and_one_that_diverged_counts_in_the_mean(sweep) -> None:
    sweep.scored("ablation=full", "seed=0", psnr=22.0, full_novel_lpips=0.25)
    for seed, lpips in enumerate(({"full_novel_lpips": 0.5}, {})):
        other = sweep.scored("ablation=m1", f"seed={seed}", psnr=20.0 + seed, **lpips) / "metrics.json"
    other.write_text(other.read_text().replace("15.0", "17.0"))
    write_summary(sweep.folder)
    table = read_back(sweep.folder)
    means = {"m1": 20.5, "full": 22.0, "mean_image": (15 + 15 + 17) / 3, "copy_reference": 12.0}
    assert table[f"{PSNR}_mean"].to_dict() == pytest.approx(means)
    assert table[f"{PSNR}_deviation"].isna().tolist() == [False, True, True, True]
    assert table["full_novel_lpips_mean"].isna().tolist() == [True, False, True, True]
    assert table.loc["full", "full_novel_lpips_mean"] == 0.25
    naive = [(row.seeds, row.steps, row.scenes) for row in summarize(sweep.folder)[0][2:]]
    assert naive == [(None, None, 40)] * 2
    metrics = sweep.scored("ablation=m1", "seed=2", psnr=math.nan) / "metrics.json"
    write_json(metrics, json.loads(metrics.read_text()))
    assert "NaN" not in metrics.read_text()
    write_summary(sweep.folder)
    assert ",nan,nan" in (sweep.folder / "summary.csv").read_text()


def test_a_sweep_without_tests_has_validation_figures_that_no_test_has(sweep) -> None:
    for ablation, psnr in {"full": 22.0, "m1": 20.0}.items():
        for seed in range(2):
            job = sweep.add(f"ablation={ablation}", f"seed={seed}", test={})
            put("metrics.json", "val/psnr_novel", psnr + seed)(job)
    (job / "metrics.json").write_text('{"steps": 9, "val/psnr_novel": null, "not_finite": ["val/psnr_novel: nan"]}')
    head, _, m1, full = as_markdown(write_summary(sweep.folder)).splitlines()[2:6]
    assert [text.strip() for text in head.split("|")[1:-1]][3:] == ["validation, not a test: psnr_novel"]
    assert m1.split("|")[4].strip() == "nan ± nan"
    assert full.split("|")[4].strip() == "22.5 ± 0.71"  # and is not marked as the best
    table = read_back(sweep.folder)
    assert list(table.columns[len(IDENTITY) - 1 :]) == ["val/psnr_novel_mean", "val/psnr_novel_deviation"]
    assert table.loc["full", "val/psnr_novel_mean"] == 22.5
    assert any("no scores of a test" in remark for remark in remarks(sweep))
    assert summarize(sweep.folder)[1].title.startswith("Validation scenes")


def test_where_some_jobs_were_tested_validation_stands_apart(sweep) -> None:
    sweep.add("ablation=m1", "seed=0", test={})
    sweep.scored("ablation=full", "seed=0", psnr=22.0)
    rows, table = summarize(sweep.folder)
    assert [row.label for row in rows] == ["m1", "full", "mean_image", "copy_reference"]
    scores = {row.label: set(row.scores) for row in rows}
    assert scores["m1"] == {"val/psnr_novel"}
    assert "val/psnr_novel" not in scores["full"]
    assert [row.cells[-1].text for row in table.rows] == ["20", "", "", ""]
    assert table.title.startswith("Test scenes")


def test_a_seed_of_an_extended_sweep_counts_once(sweep) -> None:
    sweep.scored("ablation=m1", psnr=20.0)  # the config's seed is 0
    for seed in range(2):
        sweep.scored("ablation=m1", f"seed={seed}", psnr=20.0 + seed)
    (row, *_), _ = summarize(sweep.folder)
    assert (row.seeds, row.scores[PSNR]) == (2, 20.5)


def test_different_numbers_of_scenes_have_a_remark(sweep) -> None:
    sweep.scored("ablation=m1", "seed=0", psnr=20.0, scenes=40, steps=9)
    sweep.scored("ablation=m1", "seed=1", psnr=20.0, scenes=38, steps=7)
    sweep.scored("ablation=full", "seed=0", psnr=20.0, scenes=40)
    sweep.add("ablation=untested", test={})
    rows, table = summarize(sweep.folder)
    assert [(row.scenes, row.steps) for row in rows[:3]] == [("40/38", "9/7"), (None, 9), (40, 9)]
    assert any("cannot be compared" in remark for remark in table.remarks)


def test_jobs_that_were_not_tested_alike_are_not_ranked_and_share_no_naive_rows(sweep) -> None:
    for seed in range(2):
        sweep.scored("ablation=m1", f"seed={seed}", psnr=20.0, resolution=32)
        sweep.scored("ablation=full", f"seed={seed}", psnr=25.0)
    rows, table = summarize(sweep.folder)
    assert [row.label for row in rows] == ["m1", "full"]
    assert (
        "Jobs were tested differently (data, resolution, scenes), so their scores cannot be compared." in table.remarks
    )
    assert not any(cell.mark for row in table.rows for cell in row.cells)


def test_a_job_of_another_sweep_or_of_none_in_a_sweeps_folder_is_no_job_of_it(sweep) -> None:
    for seed in range(2):
        sweep.scored("ablation=m1", f"seed={seed}", psnr=20.0)
    put("run.json", "sweep", None)(sweep.add("runs=TABLE"))
    put("run.json", "sweep.folder", "../..")(sweep.add("ablation=full"))
    rows, table = summarize(sweep.folder)
    assert [row.label for row in rows] == ["small", "mean_image", "copy_reference"]
    assert "2 of 2 jobs have finished." in table.remarks


def test_jobs_of_earlier_versions_count_where_they_lie_and_are_named_by_key_and_value(sweep) -> None:
    for ablation in ("m1", "full"):
        job = sweep.scored(f"ablation={ablation}", psnr=20.0)
        record = json.loads((job / "run.json").read_text())
        (job / "run.json").write_text(json.dumps({key: record[key] for key in ("command", "commit", "overrides")}))
    assert named(sweep) == ["ablation=full", "ablation=m1"]


def test_a_sweep_of_tests_has_their_scores(sweep) -> None:
    for k in (1, 2):
        metrics = sweep.scored(f"evaluation.samples={k}", psnr=20.0 + k) / "metrics.json"
        metrics.write_text(json.dumps(json.loads(metrics.read_text())["test"]))
    rows, _ = summarize(sweep.folder)
    scores = {row.label: row.scores[PSNR] for row in rows if row.seeds is not None}
    assert scores == {"evaluation.samples=1": 21.0, "evaluation.samples=2": 22.0}


def named(sweep) -> list[str]:
    return [row.label for row in summarize(sweep.folder)[0] if row.seeds is not None]


@pytest.mark.parametrize(
    ("varied", "names"),
    [
        (["batch=2", "batch=10"], ["batch=10", "batch=2"]),  # no group, though without a dot
        (["data/source=a", "data/source=b"], ["a", "b"]),
        (["+data.seed=0", "+data.seed=1"], ["data.seed=0", "data.seed=1"]),
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
    row = summarize(sweep.folder)[0][0]
    assert (row.label, row.seeds) == ("small", 4)
    for run in sweep.folder.glob("*/run.json"):
        run.write_text(run.read_text().replace('"experiment=small", ', ""))
    assert named(sweep) == ["all"]


def scored(means: list[Any], column: str = PSNR, naive: int = 0, **changes: Any) -> list[Entry]:
    """One entry for each mean; the last `naive` of them are of a naive predictor."""
    scores = [{} if mean is None else {column: mean} for mean in means]
    kinds = ["model"] * (len(means) - naive) + ["mean_image"] * naive
    return [Entry("x", each, 9, kind, **changes) for each, kind in zip(scores, kinds, strict=True)]


def marks_of(rows: list[Entry], column: str = PSNR) -> list[str]:
    return [row.cells[0].mark for row in score_rows(rows, [], [(column, None)], Notes(), marked=True)]


@pytest.mark.parametrize(
    ("column", "means", "expected"),
    [
        ("full_novel_ssim", [0.8, 0.9, 0.7], ["second", "best", ""]),
        ("full_novel_lpips", [0.2, 0.3, 0.1], ["second", "", "best"]),
        ("full_novel_sharpness", [0.5, 1.0, 1.5], ["", "", ""]),  # a blur and noise are both worse than the truth's 1
        (PSNR, [21.996, 22.001, 21.98, 21.98, 20.0], ["best", "best", "second", "second", ""]),  # as written
        (PSNR, [None, 22.0, float("nan"), 21.0], ["", "best", "", "second"]),
        (PSNR, [float("inf"), 30.0], ["best", "second"]),
    ],
)
def test_best_and_second_best_follow_the_metrics_direction(column, means, expected) -> None:
    assert marks_of(scored(means, column), column) == expected


def test_naive_predictors_and_upper_bounds_do_not_compete() -> None:
    rows = [*scored([30.0], upper_bound=True), *scored([20.0, 21.0, 25.0, 21.0], naive=2)]
    assert marks_of(rows) == ["", "second", "best", "", ""]


def test_times_are_in_the_units_of_the_paper() -> None:
    texts = [time_cell(seconds).text for seconds in (0.0157, 54, 246.0, None)]
    assert texts == ["15.7 ms", "54.0 sec", "4.1 min", "-"]


def test_all_files_have_means_deviations_marks_and_remarks(ablations) -> None:
    ablations.add("ablation=no_skips", "seed=7")
    before = {path.name for path in ablations.folder.iterdir()}
    table = write_summary(ablations.folder)
    assert sorted({path.name for path in ablations.folder.iterdir()} - before) == FILES
    markdown, tex = ((ablations.folder / name).read_text() for name in FILES[1:])
    head, _, m1, no_skips, full, mean_image, copy_reference = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in markdown.splitlines()[2:9]
    )
    assert head[:4] == ["ablation", "seeds", "scenes", "all pixels, novel views: PSNR ↑"]
    # Offsets 0, 0.25 and 1.25 have the mean 0.5 and the deviation sqrt(0.4375) = 0.66.
    assert m1[:4] == ["m1", "3", "40", "<ins>20.50 ± 0.66</ins>"]
    assert no_skips[3:5] == ["19.00 ± 0.66", "0.685 ± 0.000"]
    assert full[3:6] == ["**22.50 ± 0.66**", "**0.720 ± 0.000**", "**20.50 ± 0.66**"]
    assert mean_image == ["mean_image", "", "40", "15.00", "", ""]
    assert copy_reference[3] == "12.00"
    assert r"no\_skips & 3 & 40 & 19.00 $\pm$ 0.66 & " in tex
    assert r"\textbf{22.50 $\pm$ 0.66}" in tex
    assert len(table.remarks) == 6
    for remark in table.remarks:
        assert remark in markdown
        assert escape(remark) in tex
    assert any(SSIM_NOTE in remark for remark in table.remarks)
    read = read_back(ablations.folder)
    assert list(read.columns[: len(IDENTITY) - 1]) == IDENTITY[1:]
    names = (PSNR, "full_novel_ssim", "object_novel_psnr")
    assert set(read.columns[len(IDENTITY) - 1 :]) == {
        f"{name}_{kind}" for name in names for kind in ("mean", "deviation")
    }
    assert list(read.index) == ["m1", "no_skips", "full", "mean_image", "copy_reference"]
    assert list(read.loc["full"][:3]) == [3, 40, 9]
    for ablation, psnr in {"full": 22.0, "no_skips": 18.5, "m1": 20.0}.items():
        means = [psnr + 0.5, 0.5 + psnr / 100, psnr - 1.5]
        np.testing.assert_allclose(read.loc[ablation, [f"{name}_mean" for name in names]].tolist(), means, rtol=1e-12)
        deviations = read.loc[ablation, [f"{name}_deviation" for name in names]].tolist()
        np.testing.assert_allclose(deviations, [math.sqrt(0.4375), 0, math.sqrt(0.4375)], atol=1e-12)


def test_a_metric_of_the_users_own_is_shown_and_marked_as_its_results_say(sweep) -> None:
    style = {"heading": "bias", "better": "↓", "decimals": 1}
    for ablation, bias in {"full": 0.25, "m1": 0.75}.items():
        job = sweep.scored(f"ablation={ablation}", psnr=20.0)
        put("metrics.json", "test.protocol", {"metrics": {"my_bias": {"_target_": "mine.Bias", "style": style}}})(job)
        put("metrics.json", "test.model.full.novel.my_bias", bias)(job)
    head, _, m1, full, *_ = as_markdown(write_summary(sweep.folder)).splitlines()[2:]
    assert head.endswith("| all pixels, novel views: bias ↓ |")
    assert (m1.split("|")[5].strip(), full.split("|")[5].strip()) == ("<ins>0.8</ins>", "**0.2**")
    assert read_back(sweep.folder).loc["m1", "full_novel_my_bias_mean"] == 0.75


def test_a_sweep_without_finished_jobs_says_so(sweep) -> None:
    sweep.add("ablation=m1")
    (sweep.folder / ".submitit").mkdir()
    write_summary(sweep.folder)
    assert "No job of this sweep has finished." in (sweep.folder / "summary.md").read_text()
    assert remarks(sweep)[:2] == ["0 of 1 jobs have finished.", "Not finished: job=0."]
    assert list(pd.read_csv(sweep.folder / "summary.csv").columns) == IDENTITY


def test_the_terminal_shows_the_headline_and_names_the_jobs_that_have_not_finished(ablations, capsys) -> None:
    ablations.add("ablation=no_skips", "seed=7")
    broken = ablations.add("ablation=m1", "seed=8")
    (broken / "metrics.json").write_text('{"steps": 9, "te')
    ablations.scored("ablation=x[red]", psnr=1.0)
    rows, table = summarize(ablations.folder)
    assert table.remarks[1] == "10 of 12 jobs have finished."
    assert set(re.findall(r"job=\d+", table.remarks[2])) == {"job=9", "job=10"}
    assert [row.seeds for row in rows[:4]] == [3, 3, 1, 3]
    show(table, width=160)
    printed = capsys.readouterr().out
    assert all(text in printed for text in ("22.50 ± 0.66", "x[red]", "Not finished: job="))
    assert "…" not in printed


def test_jobs_in_nested_folders_are_found(sweep) -> None:
    """As `hydra.sweep.subdir='x/${seed}'` puts them."""
    (sweep.folder / "x/y").mkdir(parents=True)
    for seed, (place, above) in enumerate({"x/0": "../..", "x/y/1": "../../.."}.items()):
        job = sweep.scored(f"seed={seed}", psnr=20.0 + seed)
        put("run.json", "sweep.folder", above)(job)
        job.rename(sweep.folder / place)
    job = sweep.add("seed=2")
    put("run.json", "sweep.folder", "../..")(job)
    job.rename(sweep.folder / "x/2")
    rows, _ = summarize(sweep.folder)
    assert (rows[0].seeds, rows[0].scores[PSNR]) == (2, 20.5)
    assert remarks(sweep)[:2] == ["2 of 3 jobs have finished.", "Not finished: x/2."]


@pytest.mark.parametrize("file", ["job=1/config.yaml", "job=1/run.json"])
@pytest.mark.parametrize("content", ["", "{}", "[]", "[", "hydra:\n", "hydra: {overrides: {task: }}", None])
def test_a_sweep_with_a_damaged_file_has_a_summary(sweep, file, content) -> None:
    sweep.scored("seed=1", psnr=20.0)
    sweep.scored("seed=0", psnr=21.0)
    damaged = sweep.folder / file
    damaged.unlink()
    if content is not None:
        damaged.write_text(content)
    rows, _ = summarize(sweep.folder)
    assert rows[0].scores[PSNR] in (20.0, 20.5)


def test_remarks_name_known_commits_machine_date_and_commands(sweep) -> None:
    sweep.add("seed=9", commit=None)
    assert not any("ommit" in line for line in remarks(sweep))
    for seed, commit in enumerate(("c0ffee", "decade-dirty", "c0ffee")):
        sweep.add(f"seed={seed}", commit=commit)
    *_, commits, made, command = remarks(sweep)
    assert commits == "Commits unknown, c0ffee, decade-dirty."
    assert machine()["processor"] in made
    assert time.strftime("%Y-") in made
    assert command.startswith("Command: completesplat fit -m experiment=small ablation=full,no_skips data.root=")


CONFIG = """
seed: 0
fails: null
killed: null
hydra:
  sweep: {dir: swept, subdir: "seed=${seed}"}
  run: {dir: swept}
  output_subdir: null
  callbacks: {summary: {_target_: completesplat.evaluation.sweep_summary.SweepSummary}}
"""


@pytest.fixture
def launched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Runs jobs that score 20 dB plus their seed; the jobs with the seeds `fails` and `killed` do not."""
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf/fit.yaml").write_text(CONFIG)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")

    def job(config: Any) -> None:
        out = Path(HydraConfig.get().runtime.output_dir)
        OmegaConf.save(config, out / "config.yaml")
        record = {"commit": None, **job_entries("fit", sys.argv[1:], out)}
        (out / "run.json").write_text(json.dumps(record))
        if config.seed in (config.fails, config.killed):
            raise ValueError if config.seed == config.fails else KeyboardInterrupt
        test = {"model": {"scenes": 2, "views": 4, "full": {"novel": {"psnr": 20.0 + config.seed}}}}
        (out / "metrics.json").write_text(json.dumps({"steps": 1, "epochs": 1, "test": test}))

    def launch(*arguments: str) -> Path:
        monkeypatch.setattr(sys, "argv", ["completesplat fit", *arguments])
        hydra.main(version_base="1.3", config_path=str(tmp_path / "conf"), config_name="fit")(job)()
        return tmp_path / "swept"

    return launch


def test_a_sweep_ends_with_its_table_and_a_single_run_has_none(launched, tmp_path, capsys) -> None:
    assert (launched("seed=1") / "metrics.json").is_file()
    assert list(tmp_path.rglob("summary.*")) == []
    folder = launched("-m", "seed=0,2", "hydra.sweep.subdir=x/${seed}")
    assert (folder / "x/2/metrics.json").is_file()
    printed = capsys.readouterr().out
    assert "21.00 ± 1.41" in printed
    assert "swept/summary.md" in printed
    assert "2 of 2 jobs have finished." in (folder / "summary.md").read_text()


@pytest.mark.parametrize(
    ("override", "error", "finished"),
    [("fails=1", ValueError, "2 of 3"), ("killed=1", KeyboardInterrupt, "1 of 3")],
)
def test_a_sweep_that_fails_or_is_killed_has_a_summary(launched, override, error, finished) -> None:
    with pytest.raises(error):
        launched("-m", "seed=0,1,2", override)
    assert Path("swept/summary.md").is_file()
    write_summary(Path("swept"))
    text = Path("swept/summary.md").read_text()
    assert f"{finished} jobs have finished." in text
    assert "Not finished: seed=1." in text
    assert ("Not started: seed=2." in text) == (error is KeyboardInterrupt)


def test_rows_say_what_has_bad_steps_or_changes_nothing_and_jobs_that_diverged_are_named(sweep) -> None:
    put("metrics.json", "train/bad_steps", 12.0)(sweep.scored("ablation=m1", psnr=20.0))
    put("run.json", "unchanged", True)(sweep.scored("ablation=no_lpips", psnr=22.0))
    sweep.scored("ablation=full", psnr=22.0)
    put("run.json", "diverged", "the weights are not finite")(sweep.add("ablation=no_ssim"))
    table = write_summary(sweep.folder)
    labels = [row.cells[0].text for row in table.rows]
    assert labels[:3] == ["m1 (12 bad steps)", "no_lpips (changes nothing)", "full"]
    assert "Diverged: job=3." in table.remarks
    assert read_back(sweep.folder).loc["m1", "bad_steps"] == 12


def test_a_summary_that_cannot_be_written_is_logged_and_stops_nothing(launched, tmp_path, capsys) -> None:
    (tmp_path / "swept/summary.csv").mkdir(parents=True)
    folder = launched("-m", "seed=0,2")
    assert (folder / "seed=2/metrics.json").is_file()
    printed = capsys.readouterr().out  # where hydra's handlers log by default
    assert printed.count("no summary of the sweep: IsADirectoryError") == 3  # after each job and after the last


@pytest.mark.processes
def test_the_hook_is_loaded_without_the_heavy_libraries() -> None:
    heavy = ["torch", "pandas", "numpy", "rich", "matplotlib"]
    code = f"import sys, completesplat.evaluation.sweep_summary; print(*(sys.modules.keys() & {heavy}))"
    assert python(code).split() == []


def test_jobs_on_several_machines_make_one_summary(sweep, tmp_path, command) -> None:
    """Their data lie elsewhere; a job that both have counts once, with the most progress."""
    other = type(sweep)(tmp_path / "other")
    for machine_of, seeds in ((sweep, "01"), (other, "12")):
        for seed in seeds:
            for ablation, psnr in {"full": 22.0, "m1": 20.0}.items():
                machine_of.scored(f"ablation={ablation}", f"seed={seed}", psnr=psnr + int(seed))
    sweep.add("ablation=m1", "seed=3")
    other.add("ablation=m1", "seed=4")
    other.scored("ablation=m1", "seed=3", psnr=23.0)
    for record in other.folder.glob("*/run.json"):
        record.write_text(record.read_text().replace("/home/someone/data/set", "/scratch/data"))
    done = command.succeeds("report", "summary", f"sweeps=[{sweep.folder},{other.folder}]", "out=ALL")
    table = read_back(Path("ALL"))
    assert table.loc[["full", "m1"], "seeds"].tolist() == [3, 4]
    assert table.loc["full", f"{PSNR}_mean"] == 23.0
    assert "7 of 8 jobs have finished." in done.out
    assert sorted(path.name for path in Path("ALL").glob("summary.*")) == FILES
    refused = command.refuses("report", "summary", f"sweeps=[{sweep.folder},nowhere]", "out=NONE")
    assert refused == "sweeps=nowhere: no such folder"
