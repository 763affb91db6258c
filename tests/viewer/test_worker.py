import threading

import pytest

from completesplat.viewer.page import Worker


@pytest.fixture
def failures() -> list[Exception]:
    return []


@pytest.fixture
def worker(failures):
    made = Worker(failures.append)
    yield made
    made.close()


def blocked(worker: Worker) -> threading.Event:
    """Keep the worker busy until the event is set."""
    started, release = threading.Event(), threading.Event()
    worker.submit("block", lambda: (started.set(), release.wait(5)))
    assert started.wait(5)
    return release


def test_of_waiting_jobs_of_a_kind_the_newest_is_done_in_another_thread(worker):
    done: list[str] = []
    threads: set[threading.Thread] = set()
    release = blocked(worker)
    for kind, name in (("draw", "first"), ("draw", "second"), ("draw", "third"), ("save", "saved")):
        worker.submit(kind, lambda name=name: done.append(name) or threads.add(threading.current_thread()))
    release.set()
    assert worker.wait(5)
    assert sorted(done) == ["saved", "third"]
    assert len(threads) == 1
    assert threads != {threading.current_thread()}


def test_an_error_is_reported_and_the_next_job_done(worker, failures):
    done = []
    error = ValueError("broken")

    def fail() -> None:
        raise error

    worker.submit("fail", fail)
    worker.submit("draw", lambda: done.append(True))
    assert worker.wait(5)
    assert failures == [error]
    assert done == [True]


def test_what_waits_is_forgotten_when_it_closes(worker):
    done = []
    release = blocked(worker)
    worker.submit("draw", lambda: done.append(True))
    worker.close()
    release.set()
    assert worker.wait(5)
    assert done == []
