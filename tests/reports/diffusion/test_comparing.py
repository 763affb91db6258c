"""Two ways side by side: what is counted, in which order."""

from types import SimpleNamespace

import torch

from completesplat.benchmarks import diffusion
from completesplat.benchmarks.diffusion import WARM_UP, Comparison, measured


def test_the_ways_take_turns_and_the_medians_of_the_later_calls_count(monkeypatch):
    now, calls = [0.0], []
    monkeypatch.setattr(diffusion, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    # Seconds of each call; those of the warm-up are long.
    seconds = {"a": [9.0] * WARM_UP + [1.0, 2.0, 6.0], "b": [90.0] * WARM_UP + [40.0, 8.0, 1.0]}

    def work(key: str) -> None:
        calls.append(key)
        now[0] += seconds[key].pop(0)

    comparison = Comparison("x", ("this", lambda: work("a")), ("that", lambda: work("b")))
    row = measured(comparison, 3, torch.device("cpu"))
    assert row == {"name": "x", "a": "this", "b": "that", "a_ms": 2000.0, "b_ms": 8000.0, "ratio": 4.0}
    assert calls == ["a", "b"] * (WARM_UP + 3)
