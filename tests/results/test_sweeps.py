"""A sweep's summary: its files, the terminal, the remarks, and the hook in a sweep that hydra really runs."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
import imageio.v3 as imageio
import numpy as np
import pandas as pd
import pytest
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from completesplat.results.machine import machine
from completesplat.results.scores import IDENTITY
from completesplat.results.sweeps import show_summary, summarize, write_summary
from completesplat.results.tables import SSIM_NOTE, escape

FILES = ["summary.csv", "summary.md", "summary.png", "summary.tex"]


def blue(folder) -> np.ndarray:
    """Which pixels of the chart have the colour of bars, matplotlib's C0."""
    return (imageio.imread(folder / "summary.png")[..., :3] == (31, 119, 180)).all(-1)


def longest_run(line: np.ndarray) -> int:
    return max(map(len, re.findall("1+", "".join(map(str, line.astype(int))))), default=0)


def test_four_files_are_written_of_which_markdown_shows_means_deviations_and_marks(ablations, written) -> None:
    before = {path.name for path in ablations.folder.iterdir()}
    lines = written(ablations).splitlines()
    assert sorted({path.name for path in ablations.folder.iterdir()} - before) == FILES
    head, _, m1, no_skips, full, mean_image, copy_reference = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in lines[:7]
    )
    assert head[:4] == ["ablation", "seeds", "scenes", "all pixels, novel views: PSNR ↑"]
    # Offsets 0, 0.25 and 1.25 have the mean 0.5 and the deviation sqrt(0.4375) = 0.66.
    assert m1[:4] == ["m1", "3", "40", "<ins>20.50 ± 0.66</ins>"]
    assert no_skips[3:5] == ["19.00 ± 0.66", "0.685 ± 0.000"]
    assert full[3:6] == ["**22.50 ± 0.66**", "**0.720 ± 0.000**", "**20.50 ± 0.66**"]
    assert mean_image == ["mean_image", "", "40", "15.00", "", "", "", ""]
    assert copy_reference[3] == "12.00"


def test_latex_has_the_same_figures_and_both_files_all_remarks_and_the_command(ablations, written) -> None:
    ablations.add("ablation=no_skips", "seed=7")
    markdown = written(ablations)
    tex = (ablations.folder / "summary.tex").read_text()
    assert r"no\_skips & 3 & 40 & 19.00 $\pm$ 0.66 & " in tex
    assert r"\textbf{22.50 $\pm$ 0.66}" in tex
    assert r"\underline{20.50 $\pm$ 0.66}" in tex
    summary = summarize(ablations.folder)
    assert len(summary.table.remarks) == 4
    for said in (SSIM_NOTE, *summary.table.remarks, *summary.commands):
        assert said in markdown
        assert escape(said) in tex


def test_a_sweep_without_finished_jobs_says_so(sweep, written, capsys) -> None:
    sweep.add("ablation=m1")
    markdown = written(sweep)
    assert markdown.startswith("No job of this sweep has finished.")
    assert "0 of 1 jobs have finished." in markdown
    assert "No job of this sweep has finished." in (sweep.folder / "summary.tex").read_text()
    assert list(pd.read_csv(sweep.folder / "summary.csv").columns) == IDENTITY
    assert not blue(sweep.folder).any()
    show_summary(summarize(sweep.folder))
    assert "Not finished: job=0." in capsys.readouterr().out


def test_the_chart_draws_bars_as_long_as_the_means(sweep) -> None:
    for ablation, psnr in {"full": 24.0, "m1": 12.0, "no_skips": 18.0}.items():
        test = {"model": {"scenes": 2, "views": 4, "full": {"novel": {"psnr": psnr}}}}
        sweep.add(f"ablation={ablation}", test=test)  # no naive predictors: no lines across the bars
    write_summary(sweep.folder)
    bars = [longest_run(line) for line in blue(sweep.folder)]
    lengths = [length for length, before in zip(bars[1:], bars, strict=False) if length > 50 and before == 0]
    np.testing.assert_allclose(np.array(lengths) / lengths[-1], [12 / 24, 18 / 24, 1], atol=0.02)


def test_the_chart_draws_the_mean_image_where_its_score_is(sweep) -> None:
    sweep.scored("ablation=full", psnr=30.0)
    write_summary(sweep.folder)
    image = imageio.imread(sweep.folder / "summary.png")[..., :3]
    bar = blue(sweep.folder)
    columns = np.flatnonzero(bar.sum(0) > 20)
    rows = np.flatnonzero(bar.sum(1) > 100)
    black = (image[rows[0] : rows[-1]].astype(int).sum(-1) < 100).mean(0)
    found = [x for x in range(columns[0] + 5, columns[-1] - 5) if black[x] > 0.2]
    middle = (columns[0] + columns[-1]) / 2  # the mean image scores half of 30
    assert min(abs(x - middle) for x in found) <= 3


def test_the_terminal_shows_the_headline_and_names_what_has_not_finished(ablations, capsys) -> None:
    ablations.add("ablation=no_skips", "seed=7")
    broken = ablations.add("ablation=m1", "seed=8")
    (broken / "metrics.json").write_text('{"steps": 9, "te')
    ablations.scored("ablation=x[red]", psnr=1.0)
    (ablations.folder / "silent").mkdir()  # ended before it could say what it was
    (ablations.folder / ".submitit").mkdir()
    summary = summarize(ablations.folder)
    assert summary.table.remarks[:2] == ["10 of 13 jobs have finished.", "Not finished: job=9; job=10; silent."]
    assert [row["seeds"] for row in summary.rows[:4]] == [3, 3, 1, 3]
    show_summary(summary)
    said = capsys.readouterr().out
    assert all(text in said for text in ("22.50 ± 0.66", "x[red]", "Not finished: job=9;"))
    assert "…" not in said


def test_jobs_that_never_started_are_named_too(sweep) -> None:
    given = ["experiment=small", "ablation=m1,full", "seed=range(2)", "data.root=/home/someone/data/set"]
    sweep.plan([*given, "out=written/in/another/way"])
    sweep.scored("ablation=m1", "seed=0", psnr=20.0)
    sweep.add("ablation=full", "seed=0")
    remarks = summarize(sweep.folder).table.remarks
    assert remarks[:2] == ["1 of 4 jobs have finished.", "Not finished: job=1; m1, seed=1; full, seed=1."]


def test_jobs_that_say_nothing_are_counted_once_and_a_plan_that_depends_on_files_is_not_guessed(sweep) -> None:
    sweep.plan(["ablation=m1,full"])
    (sweep.folder / "ablation=full").mkdir()
    remarks = summarize(sweep.folder).table.remarks
    assert remarks[:2] == ["0 of 2 jobs have finished.", "Not finished: m1; full."]
    (sweep.folder / "ablation=full").rmdir()
    sweep.plan(["ablation=glob(*)", "seed=0,1"])
    sweep.scored("ablation=m1", "seed=0", psnr=20.0)
    assert summarize(sweep.folder).table.remarks[0] == "1 of 1 jobs have finished."


def test_commits_machine_date_and_the_command_without_the_folders_of_a_machine_are_told(sweep) -> None:
    for seed, commit in enumerate(("c0ffee", "decade-dirty", "c0ffee")):
        sweep.add(f"seed={seed}", commit=commit)
    summary = summarize(sweep.folder)
    assert "Commits c0ffee, decade-dirty." in summary.table.remarks
    assert machine()["processor"] in summary.table.remarks[-1]
    assert time.strftime("%Y-") in summary.table.remarks[-1]
    assert summary.commands == ["completesplat fit -m experiment=small ablation=full,no_skips data.root=.../set"]


CONFIG = """
seed: 0
fails: null
killed: null
hydra:
  sweep: {dir: swept, subdir: "seed=${seed}"}
  run: {dir: swept}
  output_subdir: null
  callbacks: {summary: {_target_: completesplat.results.sweeps.SweepSummary}}
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
        record = {"command": sys.argv, "commit": None, "overrides": list(HydraConfig.get().overrides.task)}
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
    folder = launched("-m", "seed=0,2")
    said = capsys.readouterr().out
    assert "21.00 ± 1.41" in said
    assert "swept/summary.md" in said
    assert "of 2 jobs have finished." in (folder / "summary.md").read_text()


@pytest.mark.parametrize(
    ("override", "error", "finished", "missing"),
    [("fails=1", ValueError, 2, "seed=1"), ("killed=1", KeyboardInterrupt, 1, "all, seed=1; all, seed=2")],
)
def test_a_sweep_that_fails_or_is_killed_has_a_summary_of_what_was_done(
    launched, override, error, finished, missing
) -> None:
    with pytest.raises(error):
        launched("-m", "seed=0,1,2", override)
    text = Path("swept/summary.md").read_text()
    assert f"{finished} of 3 jobs have finished." in text
    assert f"Not finished: {missing}." in text


def test_a_summary_that_cannot_be_written_is_logged_and_stops_nothing(launched, tmp_path, capsys) -> None:
    (tmp_path / "swept/summary.csv").mkdir(parents=True)
    folder = launched("-m", "seed=0,2")
    assert (folder / "seed=2/metrics.json").is_file()
    said = capsys.readouterr().out  # where hydra's handlers log by default
    assert said.count("no summary of the sweep: IsADirectoryError") == 3  # after each job and after the last


def test_the_hook_is_loaded_without_the_heavy_libraries() -> None:
    code = (
        "import sys, completesplat.results.sweeps; "
        "print(*sorted({'torch', 'pandas', 'numpy', 'rich', 'matplotlib'} & {n.split('.')[0] for n in sys.modules}))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []


def test_jobs_on_several_machines_make_one_summary(sweep, tmp_path, command) -> None:
    """Their data lie elsewhere; a job that both have counts once, as far as it came."""
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
    done = command("report", "summary", f"sweeps=[{sweep.folder},{other.folder}]", "out=ALL")
    assert done.status == 0, done.err
    found = pd.read_csv("ALL/summary.csv").set_index("ablation")
    assert found.loc[["full", "m1"], "seeds"].tolist() == [3, 4]
    assert found.loc["full", "full_novel_psnr_mean"] == 23.0
    assert "7 of 8 jobs have finished." in done.out
    assert sorted(path.name for path in Path("ALL").glob("summary.*")) == FILES
    refused = command("report", "summary", f"sweeps=[{sweep.folder},nowhere]", "out=NONE")
    assert (refused.status, refused.err) == (2, "error: sweeps=nowhere: no such folder\n")
