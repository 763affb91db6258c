"""Weights & Biases when its server or its process is missing."""

import socket
import time
from collections.abc import Iterator
from unittest.mock import Mock

import pytest
from omegaconf import OmegaConf
from wandb_files import offline_runs

from completesplat.training.loggers import START_SECONDS, WandbRun, wandb_runs

wandb = pytest.importorskip("wandb")
pytestmark = pytest.mark.processes


@pytest.fixture
def online(monkeypatch) -> Iterator[None]:
    """A user with a key, whose settings W&B has not read yet."""
    wandb.teardown()
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setenv("WANDB_API_KEY", "0123456789" * 4)
    yield
    wandb.teardown()


@pytest.mark.parametrize("listens", [False, True])
def test_without_an_answer_the_run_is_soon_offline(online, tmp_path, monkeypatch, caplog, listens):
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"http://127.0.0.1:{server.getsockname()[1]}"
        if not listens:
            server.close()
        monkeypatch.setenv("WANDB_BASE_URL", url)
        begun = time.monotonic()
        with wandb_runs([run_logger := WandbRun(str(tmp_path), "online", "some")], OmegaConf.create({}), tmp_path):
            run_logger.log_metrics({"a": 1.0}, step=3)
            assert time.monotonic() - begun < 10 * START_SECONDS  # on a busy machine
    (run,) = offline_runs(tmp_path)
    assert (run.only("exit").exit_code, run.history[0]["a"], run.history[0]["trainer/global_step"]) == (0, 1, 3)
    assert f"{url}/graphql" in caplog.text
    assert "the run is kept offline" in caplog.text


def test_training_goes_on_when_the_process_of_wandb_dies(tmp_path, monkeypatch, caplog):
    one, other = (WandbRun(str(tmp_path), "offline", "some") for _ in range(2))
    for name in ("log", "finish"):
        monkeypatch.setattr(one.experiment, name, Mock(side_effect=ConnectionResetError("Connection lost")))
    with wandb_runs([one], OmegaConf.create({}), tmp_path):
        one.log_metrics({"a": 1.0})
        one.log_metrics({"a": 2.0})
    assert caplog.text.count("its process ended") == 1
    with wandb_runs([other], OmegaConf.create({}), tmp_path):  # What comes next has a process again.
        other.log_metrics({"a": 3.0})
    assert offline_runs(tmp_path)[-1].history[0]["a"] == 3


def test_a_run_that_is_stopped_says_so(tmp_path):
    one = WandbRun(str(tmp_path), "offline", "some")
    one.log_metrics({"a": 1.0})
    with pytest.raises(KeyboardInterrupt), wandb_runs([one], OmegaConf.create({}), tmp_path):
        raise KeyboardInterrupt
    (run,) = offline_runs(tmp_path)
    assert run.only("exit").exit_code == 1


@pytest.mark.parametrize("agent", [{}, {"WANDB_SWEEP_ID": "sweep", "WANDB_RUN_ID": "of_the_agent"}])
def test_the_recorded_id_is_the_runs_also_under_a_sweeps_agent(tmp_path, monkeypatch, agent):
    wandb.teardown()
    for name, value in agent.items():
        monkeypatch.setenv(name, value)
    with wandb_runs([run_logger := WandbRun(str(tmp_path), "offline", "some")], OmegaConf.create({}), tmp_path):
        run_logger.log_metrics({"a": 1.0})
    wandb.teardown()
    (run,) = offline_runs(tmp_path)
    assert (tmp_path / "wandb_id").read_text() == f"{run.only('run').run_id}\n"
    assert run.only("run").run_id == agent.get("WANDB_RUN_ID", run.only("run").run_id)
