"""`completesplat bench data`: what it writes, says and refuses."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from support import strict_json

from completesplat.data.toy import rooms

QUICK = [
    *("bench", "data", "repeats=1"),
    *("objects.write.scenes=3", "objects.write.frames=4", "objects.write.size=24", "objects.write.workers=1"),
    *(
        "objects.data.image_size=16",
        "objects.data.batch_size=2",
        "objects.references_per_sequence={raw: 2, prepared: 4}",
    ),
    *("rooms.write.scenes=14", "rooms.write.frames=3", "rooms.write.size=16", "rooms.write.workers=1"),
    *("rooms.data.image_size=16", "rooms.data.references_per_sequence=2"),
]
RATES = ("batches_per_second", "scenes_per_second", "images_per_second")


@dataclass(frozen=True)
class Benchmark:
    """A finished run: what it wrote and printed."""

    out: Path
    printed: str

    @property
    def results(self) -> dict[str, Any]:
        return strict_json(self.out / "data.json")


@pytest.fixture
def quick(command, tmp_path, monkeypatch):
    # Twelve clips that are not for testing, one of which is for validation, in three chunks.
    monkeypatch.setattr(rooms, "CLIPS_PER_CHUNK", 4)
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # so few files are sooner written by this process alone

    def run(*arguments: str) -> Benchmark:
        finished = command(*QUICK, *arguments, f"out={tmp_path / 'out'}")
        assert finished.status == 0, finished.err
        assert finished.out.splitlines()[-1] == str(tmp_path / "out")
        return Benchmark(tmp_path / "out", finished.out)

    return run


@pytest.mark.slow
def test_everything_is_measured_written_and_shown(quick):
    benchmark = quick("opening.sequences=7", "opening.epochs=2")
    results = benchmark.results
    assert set(results) == {"machine", "not_measured", "rows", "opening", "clips", "chunks"}
    assert results["not_measured"] == {}
    prepared = ["prepared bmp", "prepared png", "prepared jpeg"]
    for rows, forms in [(results["rows"], ["raw", *prepared]), (results["clips"], ["chunks", "text", *prepared])]:
        assert [(row["workers"], row["form"]) for row in rows] == [(n, form) for n in (0, 2) for form in forms]
        for row in rows:
            first = next(r for r in rows if r["workers"] == row["workers"])
            assert all(row[rate] > 0 for rate in RATES)
            assert row["images_per_second"] == pytest.approx(4 * row["scenes_per_second"])
            assert row["times_first"] == pytest.approx(row["scenes_per_second"] / first["scenes_per_second"])
    assert all(0 < row["decoding_share"] < 1 for row in results["rows"] if row["workers"] == 0)
    assert not any("decoding_share" in row for row in results["rows"] if row["workers"] == 2)
    opening = results["opening"]
    assert (opening["sequences"], opening["scenes"]) == (7, 6)  # one is for validation
    assert [step["after"] for step in opening["steps"]] == ["imports", "opening", "epoch 1", "epoch 2"]
    chunks = results["chunks"]
    assert (chunks["files"], chunks["read_in_an_epoch"], chunks["most_in_memory"]) == (3, 3, 2)
    for title in ("Training batches", "A packed store of 7 sequences", "Training batches of clips", "3 chunks"):
        assert title in benchmark.printed
    assert results["machine"]["processor"] in benchmark.printed
    assert not list(benchmark.out.glob("bench_data_*"))


def test_parts_can_be_left_out_and_files_kept(quick):
    benchmark = quick("opening=false", "rooms=false", "workers=[0]", "codecs=[jpeg]", "keep=true")
    assert set(benchmark.results) == {"machine", "not_measured", "rows"}
    assert [row["form"] for row in benchmark.results["rows"]] == ["raw", "prepared jpeg"]
    (kept,) = benchmark.out.glob("bench_data_*")
    assert len(list(kept.glob("objects/*/*/images/*.jpg"))) == 12
    assert strict_json(kept / "prepared objects/jpeg/manifest.json")["codec"] == "jpeg"


def test_nothing_is_left_behind_when_writing_fails(command, tmp_path):
    finished = command(*QUICK, "objects.write.frames=1", f"out={tmp_path / 'out'}")
    assert finished.status == 2
    assert "frames >= 2" in finished.err
    assert not list((tmp_path / "out").glob("bench_data_*"))


def test_a_refusal_is_one_line_and_status_two(command, tmp_path):
    finished = command(*QUICK, "codecs=[png,webp]", f"out={tmp_path / 'out'}")
    assert finished.status == 2
    assert finished.err == "error: codecs=['png', 'webp']: choose one of png, jpeg, bmp\n"
    assert not list((tmp_path / "out").glob("*data*"))
