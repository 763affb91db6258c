"""`completesplat bench data`: how epochs are timed, and what it writes, prints and refuses."""

from collections.abc import Callable
from types import SimpleNamespace

import pytest
from support import strict_json

from completesplat.benchmarks import data_loading
from completesplat.benchmarks.data_loading import Epoch, rows

QUICK = [
    *("bench", "data", "repeats=1", "workers=[0]", "codecs=[jpeg]"),
    *("objects.write.scenes=3", "objects.write.frames=4", "objects.write.size=24", "objects.write.workers=1"),
    *("objects.data.image_size=16", "objects.data.batch_size=2"),
    "objects.references_per_sequence={raw: 2, prepared: 4}",
]


def test_forms_take_turns_and_the_median_counts_without_the_first_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = {"a": iter([60.0, 10.0, 1.0, 20.0] * 2), "b": iter([90.0, 2.0, 2.5, 50.0] * 2)}
    epochs = []

    def read_from(name: str, number: int) -> Epoch:
        epochs.append((name, number))
        return Epoch(next(seconds[name[0]]), batches=3, scenes=5, images=15)

    def form(name: str) -> Callable[..., SimpleNamespace]:
        return lambda workers: SimpleNamespace(train_dataloader=lambda: f"{name}{workers}")

    monkeypatch.setattr(data_loading, "read_epoch", read_from)
    messages: list[str] = []
    result = rows({"a": form("a"), "b": form("b")}, [0, 2], 3, messages.append)
    assert epochs == [(f"{form}{workers}", number) for workers in (0, 2) for number in range(4) for form in "ab"]
    assert len(messages) == len(epochs)
    keys = [(row["form"], row["workers"], row["epoch_seconds"]) for row in result]
    assert keys == [(form, workers, taken) for workers in (0, 2) for form, taken in (("a", 10.0), ("b", 2.5))]
    slow, fast = result[:2]
    assert (slow["batches_per_second"], slow["scenes_per_second"], slow["images_per_second"]) == (0.3, 0.5, 1.5)
    assert (slow["times_first"], fast["times_first"]) == (1.0, 4.0)


def test_everything_is_measured_written_and_printed(command, tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # starting workers costs more than writing a few files
    finished = command(*QUICK, f"out={tmp_path / 'out'}")
    assert finished.status == 0, finished.err
    results = strict_json(tmp_path / "out/data.json")
    assert [(row["workers"], row["form"]) for row in results["rows"]] == [(0, "raw"), (0, "prepared jpeg")]
    for row in results["rows"]:
        assert row["images_per_second"] == pytest.approx(4 * row["scenes_per_second"])
    for text in ("Training batches", results["machine"]["processor"]):
        assert text in finished.out
    assert finished.out.splitlines()[-1] == str(tmp_path / "out")
    assert not list((tmp_path / "out").glob("bench_data_*"))
