"""The hook in a sweep that hydra really runs."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
import pytest
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

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
        if config.seed == config.fails:
            raise ValueError("this job fails")
        if config.seed == config.killed:
            raise KeyboardInterrupt
        test = {"model": {"scenes": 2, "views": 4, "full": {"novel": {"psnr": 20.0 + config.seed}}}}
        (out / "metrics.json").write_text(json.dumps({"steps": 1, "epochs": 1, "test": test}))

    def launch(*arguments: str) -> Path:
        monkeypatch.setattr(sys, "argv", ["completesplat fit", *arguments])
        hydra.main(version_base="1.3", config_path=str(tmp_path / "conf"), config_name="fit")(job)()
        return tmp_path / "swept"

    return launch


def test_a_sweep_ends_with_its_table(launched, capsys) -> None:
    folder = launched("-m", "seed=0,2")
    said = capsys.readouterr().out
    assert "21.00 ± 1.41" in said
    assert "swept/summary.md" in said
    assert "2 of 2 jobs have finished." in (folder / "summary.md").read_text()


def test_a_sweep_with_a_failed_job_has_a_summary_of_the_others(launched) -> None:
    with pytest.raises(ValueError, match="this job fails"):
        launched("-m", "seed=0,1,2", "fails=1")
    text = Path("swept/summary.md").read_text()
    assert "2 of 3 jobs have finished." in text
    assert "Not finished: seed=1." in text


def test_a_sweep_that_is_killed_has_a_summary_of_what_was_done(launched) -> None:
    with pytest.raises(KeyboardInterrupt):
        launched("-m", "seed=0,1,2", "killed=1")
    text = Path("swept/summary.md").read_text()
    assert "1 of 3 jobs have finished." in text
    assert "Not finished: all, seed=1; all, seed=2." in text


def test_a_single_run_has_no_summary(launched, tmp_path) -> None:
    folder = launched("seed=1")
    assert (folder / "metrics.json").is_file()
    assert list(tmp_path.rglob("summary.*")) == []


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
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []
