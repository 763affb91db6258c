"""The one thread that computes, so that the page answers meanwhile."""

import logging
import threading
from collections.abc import Callable

Job = Callable[[], None]

log = logging.getLogger(__name__)


class Worker:
    """Does one job after the other, in a thread of its own.

    Of the waiting jobs of one kind only the newest is done: a moving slider submits more than can be computed.

    Args:
        failed: called with every exception that a job raises; the thread goes on.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._waiting: dict[str, Job] = {}
        self._changed = threading.Condition()
        self._busy = self._closed = False
        self._thread = threading.Thread(target=self._run, name="completesplat-viewer", daemon=True)
        self._thread.start()

    def submit(self, kind: str, job: Job) -> None:
        """Do this after what waits already, in the place of a waiting job of the same kind."""
        with self._changed:
            self._waiting[kind] = job
            self._changed.notify_all()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until no job is left, at most `timeout` seconds; returns whether none is left."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._busy and not self._waiting, timeout)

    def close(self) -> None:
        """Forget what waits, and end with the job in progress."""
        with self._changed:
            self._waiting.clear()
            self._closed = True
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: bool(self._waiting) or self._closed)
                if self._closed:
                    return
                job = self._waiting.pop(next(iter(self._waiting)))
                self._busy = True
            try:
                job()
            except Exception as error:
                try:
                    self._failed(error)
                except Exception:
                    log.exception("the viewer could not say what failed")
