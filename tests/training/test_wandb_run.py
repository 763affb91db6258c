"""Weights & Biases when its server, or its own process, is not there."""

import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from unittest.mock import Mock

import pytest
from support import LIMIT
from wandb_files import offline_runs

from completesplat.errors import CompleteSplatError
from completesplat.training import loggers
from completesplat.training.loggers import ANSWER_SECONDS, START_SECONDS, WandbRun, answers, finished

wandb = pytest.importorskip("wandb")


@pytest.fixture
def online(monkeypatch) -> Iterator[None]:
    """A user with a key, whose settings W&B has not read yet."""
    wandb.teardown()
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setenv("WANDB_API_KEY", "0123456789" * 4)
    yield
    wandb.teardown()


@pytest.mark.parametrize(("status", "answered"), [(401, True), (502, False)])
def test_any_answer_counts_unless_a_proxy_gives_it(status, answered):
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_error(status)

    with HTTPServer(("127.0.0.1", 0), Handler) as http:
        threading.Thread(target=http.handle_request, daemon=True).start()
        assert answers(f"http://127.0.0.1:{http.server_port}", LIMIT) == answered


def test_a_server_that_stays_silent_does_not_answer():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        assert not answers(f"http://127.0.0.1:{silent.getsockname()[1]}", 0.2)


def test_a_server_delays_the_start_by_ten_seconds_at_most(online, tmp_path, monkeypatch):
    asked, start = [], wandb.init

    def refuse(**settings):
        asked.append(settings)
        if settings["mode"] == "online":
            raise wandb.errors.CommError("no")
        return start(**settings)

    monkeypatch.setattr(wandb, "init", refuse)
    monkeypatch.setattr(loggers, "answers", lambda url, seconds: asked.append(seconds) or True)
    one = WandbRun(str(tmp_path), "online", "some")
    one.log_metrics({"a": 1.0}, step=3)
    one.finish(0)
    assert [settings["mode"] for settings in asked[1:]] == ["online", "offline"]
    assert asked[0] + asked[1]["settings"].init_timeout == ANSWER_SECONDS + START_SECONDS <= 10
    (run,) = offline_runs(tmp_path)
    assert [(row["a"], row["trainer/global_step"]) for row in run.history] == [(1, 3)]


def test_without_a_server_the_run_is_offline(online, tmp_path, monkeypatch, caplog):
    with socket.create_server(("127.0.0.1", 0)) as listening:
        closed = f"http://127.0.0.1:{listening.getsockname()[1]}"
    monkeypatch.setenv("WANDB_BASE_URL", closed)
    with finished([one := WandbRun(str(tmp_path), "online", "some")]):
        one.log_metrics({"a": 1.0})
    (run,) = offline_runs(tmp_path)
    assert (run.only("exit").exit_code, run.history[0]["a"]) == (0, 1)
    assert f"{closed} does not answer" in caplog.text


def test_training_goes_on_when_the_process_of_wandb_dies(tmp_path, monkeypatch, caplog):
    one, other = (WandbRun(str(tmp_path), "offline", "some") for _ in range(2))
    for name in ("log", "finish"):
        monkeypatch.setattr(one.experiment, name, Mock(side_effect=ConnectionResetError("Connection lost")))
    with finished([one]):
        one.log_metrics({"a": 1.0})
        one.log_metrics({"a": 2.0})
    assert caplog.text.count("its process ended") == 1
    with finished([other]):  # What comes next has a process again.
        other.log_metrics({"a": 3.0})
    assert offline_runs(tmp_path)[-1].history[0]["a"] == 3


def test_a_run_that_is_stopped_says_so(tmp_path):
    one = WandbRun(str(tmp_path), "offline", "some")
    one.log_metrics({"a": 1.0})
    with pytest.raises(KeyboardInterrupt), finished([one]):
        raise KeyboardInterrupt
    (run,) = offline_runs(tmp_path)
    assert run.only("exit").exit_code == 1


def test_a_run_that_was_never_begun_is_not_begun_to_be_closed(tmp_path):
    with finished([WandbRun(str(tmp_path), "offline", "some")]):
        pass
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(CompleteSplatError, match=r"wandb\.mode=onlin: choose one of online"):
        WandbRun(str(tmp_path), "onlin", "some")
