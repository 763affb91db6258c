"""Hydra's hook: the summary is there as soon as the first job of a sweep has ended."""

import logging
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from hydra.types import RunMode

# Hydra imports this file for every run, also to print the help: all that is heavy is imported when a job has ended.
log = logging.getLogger(__name__)


class SweepSummary(Callback):
    """Rewrites a sweep's summary after every job and prints it after the last.

    A sweep that is killed, or whose jobs fail, thus has one too; hydra does not call `on_multirun_end` for it. A
    summary that cannot be written is logged as a warning with the reason, and the sweep goes on.
    """

    def on_job_end(self, config: Any, job_return: JobReturn, **kwargs: Any) -> None:
        """Rewrite the summary, whether the job finished or failed; nothing in a run that is no sweep."""
        if config.hydra.mode == RunMode.MULTIRUN:
            _summarize(config, show=False)

    def on_multirun_end(self, config: Any, **kwargs: Any) -> None:
        """Print the summary and where it is; written again, since jobs that end together may miss each other."""
        _summarize(config, show=True)


def _summarize(config: Any, show: bool) -> None:
    try:
        from completesplat.reports.sweeps.writing import show_summary, write_summary

        folder = Path(config.hydra.sweep.dir)
        summary = write_summary(folder)
        if show:
            show_summary(summary)
            print(folder / "summary.md")
    except Exception as error:  # whatever it is, the jobs that are still to come matter more
        log.warning("no summary of the sweep: %s: %s", type(error).__name__, error)
