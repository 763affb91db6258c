"""A run that is killed at any moment and continued leaves the rows and figures of one that was not."""

import itertools
import os
from functools import partial

import pytest
import torch
from small_runs import STEPS, fit, rows

from completesplat.training.loggers import MetricsFile


class Killed(BaseException): ...


def test_a_run_killed_before_every_change_of_a_file_leaves_all_rows(tmp_path, monkeypatch):
    fit(tmp_path / "whole")
    expected = rows(tmp_path / "whole")
    assert [row["val/loss"] != "" for row in expected].count(True) == 6  # five validations and the final row
    places = ((torch, "save"), (os, "link"), (os, "replace"), (MetricsFile, "save"))
    for survived in itertools.count(1, 8):  # in turn at every kind of change
        changes = itertools.count()

        def counted(change, *arguments, changes=changes, survived=survived):
            if next(changes) >= survived:
                raise Killed  # and nothing tidies up behind a killed process
            return change(*arguments)

        folder = tmp_path / str(survived)
        with monkeypatch.context() as patch:
            for place, name in places:
                whole = getattr(place, name)
                made = partial(counted, whole) if place is not MetricsFile else None
                patch.setattr(place, name, made or (lambda self, whole=whole, counted=counted: counted(whole, self)))
            try:
                fit(folder)
            except Killed:
                pass
            else:
                break
        fit(folder)
        assert rows(folder) == expected, survived
    assert survived > 3 * STEPS


@pytest.mark.parametrize("steps", [6, 7, 12])
def test_a_run_that_ended_and_is_made_longer_is_one_that_was_as_long(tmp_path, steps):
    fit(tmp_path / "long")
    fit(tmp_path / "short", steps)
    fit(tmp_path / "short")
    assert rows(tmp_path / "short") == rows(tmp_path / "long")
