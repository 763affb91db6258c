import threading

import pytest
from support import LIMIT

from completesplat.viewer.page import Worker


@pytest.fixture
def worker():
    failures: list[Exception] = []
    made = Worker(failures.append)
    made.failures = failures
    yield made
    made.close()


def blocked(worker: Worker) -> threading.Event:
    """Keep the worker busy until the event is set."""
    started = threading.Event()
    release = threading.Event()
    worker.submit("block", lambda: (started.set(), release.wait(LIMIT)))
    assert started.wait(LIMIT)
    return release


def test_the_newest_waiting_job_of_a_kind_is_done_in_another_thread(worker):
    done: dict[str, threading.Thread] = {}
    release = blocked(worker)
    for kind, name in (("draw", "first"), ("draw", "second"), ("draw", "third"), ("save", "saved")):
        worker.submit(kind, lambda name=name: done.update({name: threading.current_thread()}))
    release.set()
    assert worker.wait(LIMIT)
    assert set(done) == {"saved", "third"}
    assert done["saved"] is done["third"] is not threading.current_thread()


def test_waiting_jobs_are_dropped_on_close_which_ends_after_the_current_one(worker):
    done = []
    others = set(threading.enumerate())
    release = blocked(worker)
    worker.submit("draw", lambda: done.append(True))
    threading.Timer(0.2, release.set).start()
    worker.close()
    assert release.is_set()
    assert not any("completesplat-viewer" in thread.name for thread in set(threading.enumerate()) - others)
    assert done == []
