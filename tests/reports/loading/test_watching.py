"""Functions watched from outside: seconds, calls, and what stays in memory."""

import json
from types import SimpleNamespace

import pytest

from completesplat.benchmarks import data
from completesplat.benchmarks.data import DECODERS, Counter, Stopwatch, decoding_share, replaced
from completesplat.data.co3d.module import CO3DDataModule


def test_a_function_is_put_back_also_after_an_error() -> None:
    original = json.dumps

    def use() -> None:
        with replaced("json.dumps", lambda function: lambda value: f"<{function(value)}>"):
            assert json.dumps([1]) == "<[1]>"
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        use()
    assert json.dumps is original


def test_a_stopwatch_adds_up_what_the_functions_take(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data, "time", SimpleNamespace(perf_counter=iter([1.0, 3.0, 10.0, 10.5]).__next__))
    watch = Stopwatch()
    assert watch.wrap(max)(2, 3) == 3
    with pytest.raises(ValueError, match="literal"):
        watch.wrap(int)("x")
    assert watch.seconds == 2.5


def test_what_is_let_go_is_no_longer_in_memory() -> None:
    counter = Counter()
    read = counter.wrap(lambda number: {"number": number})
    for number in range(4):
        assert read(number) == {"number": number}
    assert (counter.calls, counter.most) == (4, 1)


def test_what_is_held_counts_with_the_one_that_is_being_made() -> None:
    counter = Counter()
    read = counter.wrap(lambda number: {"number": number})
    held = [read(0), read(1)]
    del held[0]
    held += [read(2), read(3)]
    assert (counter.calls, counter.most) == (4, 3)


@pytest.mark.parametrize("path", DECODERS)
def test_the_decoders_are_there(path: str) -> None:
    found = []
    with replaced(path, lambda function: found.append(function) or function):
        assert len(found) == 1
    assert callable(found[0])


def test_decoding_is_part_of_reading(toy_root) -> None:
    data = CO3DDataModule(str(toy_root), "toy_objects", "fewview_train", image_size=16, batch_size=2)
    assert 0 < decoding_share(data.train_dataloader()) < 1
