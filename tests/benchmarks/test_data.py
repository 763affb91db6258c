"""`completesplat bench data`: what it writes, says and refuses."""

from pathlib import Path
from typing import Any

import pytest
from support import strict_json

from completesplat.data.toy import writing

QUICK = [
    *("bench", "data", "repeats=1"),
    *("objects.write.scenes=3", "objects.write.frames=4", "objects.write.size=24", "objects.write.workers=1"),
    *("objects.data.image_size=16", "objects.data.batch_size=2"),
    "objects.references_per_sequence={raw: 2, prepared: 4}",
    *("rooms.write.scenes=14", "rooms.write.frames=4", "rooms.write.size=16", "rooms.write.workers=1"),
    *("rooms.data.image_size=16", "rooms.data.references_per_sequence=2"),
]


@pytest.fixture
def quick(command, tmp_path, monkeypatch):
    """Runs the benchmark; gives its results, what it printed and its folder."""
    # Twelve clips that are not for testing, one of which is for validation, in three chunks.
    monkeypatch.setattr(writing, "CLIPS_PER_CHUNK", 4)
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # so few files are sooner written by this process alone

    def run(*arguments: str) -> tuple[dict[str, Any], str, Path]:
        finished = command(*QUICK, *arguments, f"out={tmp_path / 'out'}")
        assert finished.status == 0, finished.err
        assert finished.out.splitlines()[-1] == str(tmp_path / "out")
        return strict_json(tmp_path / "out/data.json"), finished.out, tmp_path / "out"

    return run


@pytest.mark.slow
def test_everything_is_measured_written_and_shown(quick):
    results, printed, out = quick("opening.sequences=7", "opening.epochs=2")
    assert set(results) == {"machine", "not_measured", "rows", "opening", "clips", "chunks"}
    assert results["not_measured"] == {}
    prepared = ["prepared bmp", "prepared png", "prepared jpeg"]
    for rows, forms in [(results["rows"], ["raw", *prepared]), (results["clips"], ["chunks", "text", *prepared])]:
        assert [(row["workers"], row["form"]) for row in rows] == [(n, form) for n in (0, 2) for form in forms]
        for row in rows:
            first = next(r for r in rows if r["workers"] == row["workers"])
            assert all(row[f"{of}_per_second"] > 0 for of in ("batches", "scenes", "images"))
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
        assert title in printed
    assert results["machine"]["processor"] in printed
    assert not list(out.glob("bench_data_*"))


def test_parts_can_be_left_out_and_files_kept(quick):
    results, _, out = quick("opening=false", "rooms=false", "workers=[0]", "codecs=[jpeg]", "keep=true")
    assert set(results) == {"machine", "not_measured", "rows"}
    assert [row["form"] for row in results["rows"]] == ["raw", "prepared jpeg"]
    (kept,) = out.glob("bench_data_*")
    assert len(list(kept.glob("objects/*/*/images/*.jpg"))) == 12
    assert strict_json(kept / "prepared objects/jpeg/manifest.json")["codec"] == "jpeg"


def test_nothing_is_left_behind_when_it_fails(command, tmp_path):
    codecs = ("codecs=[png,webp]", "error: codecs=['png', 'webp']: choose one of png, jpeg, bmp\n")
    for setting, said in (("objects.write.frames=1", "toy_objects: frames=1: must lie between 2 and 1000"), codecs):
        finished = command(*QUICK, setting, f"out={tmp_path / 'out'}")
        assert finished.status == 2
        assert said in finished.err
        assert not list((tmp_path / "out").glob("*data*"))
