import re
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf
from small_runs import rows

import completesplat.training
from completesplat.training.loggers import ContinuedCSVLogger, WandbRun


def numbers(folder: Path) -> list[dict[str, float]]:
    return [{k: float(v) for k, v in row.items() if v} for row in rows(folder)]


def log(folder: Path, *entries: dict[str, float]) -> None:
    logger = ContinuedCSVLogger(str(folder))
    for entry in entries:
        logger.log_metrics({k: v for k, v in entry.items() if k != "step"}, step=int(entry["step"]))


OLD = [{"a": 1.0, "step": 0}, {"a": 2.0, "step": 5}, {"b": 9.0, "step": 5}, {"a": 3.0, "step": 10}]


def test_rows_before_the_first_new_step_stay_and_the_others_are_replaced(tmp_path):
    log(tmp_path, *OLD)
    new = [{"a": -1.0, "step": 5}, {"a": -2.0, "step": 7}]
    log(tmp_path, *new)
    assert numbers(tmp_path) == [OLD[0], *new]


def test_the_old_file_stays_until_the_first_row_which_is_written_at_once(tmp_path):
    log(tmp_path, *OLD)
    logger = ContinuedCSVLogger(str(tmp_path))
    logger.save()
    logger.finalize("success")
    assert numbers(tmp_path) == OLD
    for count in (1, 2):
        logger.log_metrics({"a": 1.0}, step=10 + count)
        assert len(numbers(tmp_path)) == len(OLD) + count


@pytest.mark.parametrize("new", [{"c": 1.0}, {"a": 1.0, "b": 2.0, "c": 3.0}])
def test_columns_are_those_of_old_and_new_rows(tmp_path, new):
    log(tmp_path, *OLD)
    log(tmp_path, new | {"step": 11}, {"d": 4.0, "step": 12}, {"a": 5.0, "step": 13})
    assert numbers(tmp_path) == [*OLD, new | {"step": 11}, {"d": 4.0, "step": 12}, {"a": 5.0, "step": 13}]
    assert set(rows(tmp_path)[0]) == {"a", "b", "d", "step", *new}


def test_a_line_that_was_cut_off_is_left_out(tmp_path):
    log(tmp_path, *OLD)
    path = tmp_path / "metrics.csv"
    path.write_bytes(path.read_bytes()[:-3])
    log(tmp_path, {"a": 4.0, "step": 15})
    assert numbers(tmp_path) == [*OLD[:-1], {"a": 4.0, "step": 15}]


def test_jobs_of_a_sweep_are_a_group_of_wandb_in_nested_folders_too(tmp_path):
    pytest.importorskip("wandb")
    (tmp_path / "sweep/x/0").mkdir(parents=True)
    (tmp_path / "sweep/multirun.yaml").touch()
    (tmp_path / "alone").mkdir()
    for folder, group in (("sweep/x/0", "sweep"), ("sweep/0", "sweep"), ("alone", None)):
        assert WandbRun(str(tmp_path / folder), "offline", "some")._wandb_init["group"] == group


def test_the_sweep_of_wandb_in_the_readme_gives_settings_that_there_are():
    text = (Path(completesplat.training.__file__).parent / "README.md").read_text()
    (written,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    sweep = yaml.safe_load(written)
    program, verb, *given, last = sweep["command"]
    assert (program, last) == ("completesplat", "${args_no_hyphens}")
    values = {name: values.get("min", 0.5) for name, values in sweep["parameters"].items()}
    config = completesplat.compose(verb, *given, *(f"{name}={value}" for name, value in values.items()))
    assert {name: OmegaConf.select(config, name) for name in values} == values
