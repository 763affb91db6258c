"""Weights & Biases when its server, or its own process, is not there."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
from support import SMALL
from wandb_files import offline_runs

from completesplat.errors import CompleteSplatError
from completesplat.training import loggers
from completesplat.training.loggers import ANSWER_SECONDS, START_SECONDS, WandbRun, answers, finished

wandb = pytest.importorskip("wandb")


@contextmanager
def server(status: int) -> Iterator[str]:
    """Something that says no to everything."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_error(status)

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as http:
        threading.Thread(target=http.serve_forever, args=(0.01,), daemon=True).start()
        yield f"http://127.0.0.1:{http.server_port}"
        http.shutdown()


@pytest.fixture
def closed() -> str:
    """A server that is not there."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
    return f"http://127.0.0.1:{port}"


@pytest.fixture
def online(monkeypatch) -> Iterator[None]:
    """A user with a key, whose settings W&B has not read yet."""
    wandb.teardown()
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setenv("WANDB_API_KEY", "0123456789" * 4)
    yield
    wandb.teardown()


def logger(out: Path, mode: str = "online") -> WandbRun:
    return WandbRun(str(out), mode, "some")


@pytest.mark.parametrize(("status", "answered"), [(401, True), (502, False)])
def test_any_answer_counts_unless_a_proxy_gives_it(status, answered):
    with server(status) as url:
        assert answers(url, 5) == answered


def test_a_server_that_is_not_there_or_stays_silent_does_not_answer(closed):
    assert not answers(closed, 5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        assert not answers(f"http://127.0.0.1:{silent.getsockname()[1]}", 0.2)


def test_a_server_delays_the_start_by_ten_seconds_at_most(online, tmp_path, monkeypatch):
    asked = []

    def refuse(**settings):
        asked.append(settings)
        if settings["mode"] == "online":
            raise wandb.errors.CommError("no")
        return start(**settings)

    start = wandb.init
    monkeypatch.setattr(wandb, "init", refuse)
    monkeypatch.setattr(loggers, "answers", lambda url, seconds: asked.append(seconds) or True)
    one = logger(tmp_path)
    one.log_metrics({"a": 1.0}, step=3)
    one.finish(0)
    assert [type(entry) is dict and entry["mode"] for entry in asked] == [False, "online", "offline"]
    assert asked[0] + asked[1]["settings"].init_timeout == ANSWER_SECONDS + START_SECONDS <= 10
    (run,) = offline_runs(tmp_path)
    assert [(row["a"], row["trainer/global_step"]) for row in run.history] == [(1, 3)]


def test_without_a_server_the_run_is_offline(online, closed, tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("WANDB_BASE_URL", closed)
    with finished([one := logger(tmp_path)]):
        one.log_metrics({"a": 1.0})
    (run,) = offline_runs(tmp_path)
    assert run.only("exit").exit_code == 0
    assert f"{closed} does not answer" in caplog.text


@pytest.mark.slow
def test_a_fit_without_a_server_loses_nothing(online, closed, command, pipeline, tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_BASE_URL", closed)
    settings = ["experiment=toy_var", f"data.root={pipeline.toy}", *SMALL, "trainer.log_every_n_steps=1"]
    for name, chosen in (("csv", "csv"), ("both", "wandb")):
        done = command("fit", *settings, f"logger={chosen}", "wandb.mode=online", f"out={tmp_path / name}")
        assert done.status == 0, done.err
    lines = [(tmp_path / name / "metrics.csv").read_text().splitlines() for name in ("csv", "both")]
    assert lines[0][0] == lines[1][0]
    assert len(lines[0]) == len(lines[1])
    (run,) = offline_runs(tmp_path / "both")
    logged = {key for key in run.merged() if not key.startswith("_")}
    assert set(lines[1][0].split(",")) - {"step"} <= logged


def test_training_goes_on_when_the_process_of_wandb_dies(tmp_path, monkeypatch, caplog):
    one = logger(tmp_path, "offline")
    run = one.experiment

    def lost(*_, **__):
        raise ConnectionResetError("Connection lost")

    for name in ("log", "finish"):
        monkeypatch.setattr(run, name, lost)
    with finished([one]):
        one.log_metrics({"a": 1.0})
        one.log_metrics({"a": 2.0})
    assert caplog.text.count("its process ended") == 1
    # What comes next has a process again.
    with finished([other := logger(tmp_path, "offline")]):
        other.log_metrics({"a": 3.0})
    assert offline_runs(tmp_path)[-1].history[0]["a"] == 3


def test_a_run_that_is_stopped_says_so(tmp_path):
    one = logger(tmp_path, "offline")
    one.log_metrics({"a": 1.0})
    with pytest.raises(KeyboardInterrupt), finished([one]):
        raise KeyboardInterrupt
    (run,) = offline_runs(tmp_path)
    assert run.only("exit").exit_code == 1


def test_a_run_that_was_never_begun_is_not_begun_to_be_closed(tmp_path):
    with finished([logger(tmp_path, "offline")]):
        pass
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(CompleteSplatError, match=r"wandb\.mode=onlin: choose one of online"):
        logger(tmp_path, "onlin")
