import hashlib
import json
import logging
import pickle
from pathlib import Path
from typing import Any

import pytest
from packed_sequences import SIZE, ListedSource, contents, pack

from completesplat.data.packed.manifest import read_manifest
from completesplat.data.packed.source import PackedSource
from completesplat.data.tolerance import ErrorTolerance
from completesplat.errors import BadImage, CompleteSplatError, DataError, TooFewFrames

SETTINGS = {"image_size": SIZE, "category": "chair", "crop": None}
NAMES = [f"s{number}" for number in range(8)]


def make(source: ListedSource, out: Path, **options: Any) -> Path:
    return pack(source, out, settings=SETTINGS, **options)


def failing(*names: str) -> dict[str, BaseException]:
    return {name: TooFewFrames("1 frame", f"{name}.txt") for name in names}


@pytest.mark.slow
def test_the_same_input_gives_the_same_bytes_in_one_process_and_in_two(tmp_path: Path) -> None:
    one = make(ListedSource(NAMES[:4]), tmp_path / "one")
    two = make(ListedSource(NAMES[:4]), tmp_path / "two", workers=2)
    assert len(contents(one)) == 2 + 2 * 2
    assert contents(one) == contents(two)


def test_an_interrupted_run_continues_with_the_shards_that_are_missing(tmp_path: Path) -> None:
    out = tmp_path / "store"
    # Two shards are whole, the third has one of its two.
    with pytest.raises(KeyboardInterrupt):
        make(ListedSource(NAMES, failing={"s5": KeyboardInterrupt()}), out)
    assert not (out / "manifest.json").exists()
    assert not any(path.name.endswith(".unfinished") for path in out.iterdir())
    before = {path.name: path.stat().st_mtime_ns for path in out.glob("*.arrow")}
    assert len(before) == 2
    (out / "train-00002-of-00003.arrow.unfinished").write_bytes(b"left by a process that was killed")

    again = ListedSource(NAMES)
    make(again, out)
    assert set(again.was_read) == set(NAMES[4:])
    assert {name: (out / name).stat().st_mtime_ns for name in before} == before
    assert contents(out) == contents(make(ListedSource(NAMES), tmp_path / "at once"))


def test_an_interrupted_run_is_not_continued_with_other_data_or_settings(tmp_path: Path) -> None:
    out = tmp_path / "store"
    with pytest.raises(KeyboardInterrupt):
        make(ListedSource(NAMES, failing={"s3": KeyboardInterrupt()}), out)
    with pytest.raises(DataError, match=r"image_size=16 \(asked for: 32\).*another folder"):
        pack(ListedSource(NAMES), out, settings=SETTINGS | {"image_size": 32})
    for source, options in [
        (ListedSource(NAMES, content="b"), {}),
        (ListedSource(NAMES), {"codec": "jpeg"}),
        (ListedSource(NAMES), {"sequences_per_shard": 3}),
    ]:
        with pytest.raises(DataError, match="another folder"):
            make(source, out, **options)
        assert source.was_read == []


def test_a_complete_store_is_left_as_it_is_and_missing_or_shorter_shards_are_made_again(tmp_path: Path, caplog) -> None:
    out = make(ListedSource(NAMES), tmp_path / "store")
    assert json.loads((out / "plan.json").read_text())["settings"] == read_manifest(out).settings == SETTINGS
    shards = read_manifest(out).splits["train"].shards
    arrow = {path.name for path in out.glob("*.arrow")}
    assert {shard.file for shard in shards} == arrow == {f"train-{number:05d}-of-00004.arrow" for number in range(4)}
    for shard in shards:
        content = (out / shard.file).read_bytes()
        assert (shard.sha256, shard.bytes) == (hashlib.sha256(content).hexdigest(), len(content))
        assert shard.frames == 8
    before, times = contents(out), {path: path.stat().st_mtime_ns for path in out.iterdir()}
    again = ListedSource(NAMES)
    with caplog.at_level(logging.INFO):
        make(again, out)
    assert "already holds" in caplog.text
    assert again.was_read == []
    assert {path: path.stat().st_mtime_ns for path in out.iterdir()} == times
    _, missing, shorter, _ = sorted(out.glob("*.arrow"))
    missing.unlink()
    shorter.write_bytes(shorter.read_bytes()[:-1])
    make(again, out)
    assert set(again.was_read) == {"s2", "s3", "s4", "s5"}
    assert contents(out) == before


def test_a_folder_with_other_shards_in_it_is_left_alone_and_another_codec_refused(tmp_path: Path) -> None:
    (tmp_path / "train-00000-of-00001.arrow").write_text("mine")
    with pytest.raises(DataError, match="other prepared sequences"):
        make(ListedSource(NAMES), tmp_path)
    assert list(contents(tmp_path)) == ["train-00000-of-00001.arrow"]
    with pytest.raises(CompleteSplatError, match="png, jpeg"):
        make(ListedSource(NAMES), tmp_path / "store", codec="webp")


def test_bad_frames_and_sequences_are_left_out_and_recorded(tmp_path: Path) -> None:
    source = ListedSource(
        NAMES,
        bad_frames={"s1": [2], "s4": [0, 1, 3]},
        failing=failing("s6"),
        left_out={"too short": ["a", "b"]},
        refused=[DataError("no annotations", "x.json", "s9")],
    )
    split = read_manifest(make(source, tmp_path / "store", tolerance=ErrorTolerance("skip", 0.5))).splits["train"]
    assert split.names == ("s0", "s1", "s2", "s3", "s5", "s7")
    assert split.left_out == {"too short": 2}
    results = [(entry.kind, entry.file, entry.sequence, entry.frame) for entry in split.refused]
    assert results == [
        ("not as expected", "x.json", "s9", None),
        (BadImage.kind, "s1/2.jpg", "s1", 16),
        *[(BadImage.kind, f"s4/{index}.jpg", "s4", 10 + 3 * index) for index in (0, 1, 3)],
        (TooFewFrames.kind, None, "s4", None),
        (TooFewFrames.kind, "s6.txt", "s6", None),
    ]
    assert PackedSource(tmp_path / "store", "train").read("s1").frames == (10, 13, 19)


def test_a_bad_frame_is_raised_with_its_place_if_that_is_asked_for_even_after_it_was_skipped(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="are bad"):
        make(ListedSource(NAMES[:4], bad_frames={"s1": [2]}), tmp_path / "store", tolerance=ErrorTolerance("skip", 0))
    with pytest.raises(BadImage) as caught:
        make(ListedSource(NAMES[:4], bad_frames={"s1": [2]}), tmp_path / "store", tolerance=ErrorTolerance("raise", 0))
    # Worker processes send their refusals as pickles.
    for error in (caught.value, pickle.loads(pickle.dumps(caught.value))):
        assert (error.file, error.sequence, error.frame) == ("s1/2.jpg", "s1", 16)
    assert not (tmp_path / "store" / "manifest.json").exists()


@pytest.mark.parametrize(
    "bad", [{"bad_frames": {name: [1] for name in NAMES[:4]}}, {"failing": failing("s3")}], ids=["frames", "sequences"]
)
def test_more_than_the_allowed_share_of_bad_input_is_an_error(bad: dict, tmp_path: Path) -> None:
    # 4 of 32 frames, or 1 of 8 sequences.
    with pytest.raises(DataError, match=r"12\.5% of the data are bad"):
        make(ListedSource(NAMES, **bad), tmp_path / "store", tolerance=ErrorTolerance("skip", 0.12))
    assert not (tmp_path / "store" / "manifest.json").exists()
    make(ListedSource(NAMES, **bad), tmp_path / "store", tolerance=ErrorTolerance("skip", 0.13))
    assert (tmp_path / "store" / "manifest.json").exists()
    with pytest.raises(DataError, match="not one sequence"):
        make(ListedSource(NAMES, failing=failing(*NAMES)), tmp_path / "none", tolerance=ErrorTolerance("skip", 1))


@pytest.mark.parametrize(("chunk", "most", "lengths"), [(3, 4, [3, 3, 2]), (8, 3, [3, 2, 3])])
def test_sequences_of_one_chunk_stay_together_and_a_large_one_is_cut_evenly(chunk, most, lengths, tmp_path):
    store = make(ListedSource(NAMES, group_size=chunk), tmp_path / "store", sequences_per_shard=most)
    shards = [shard.sequences for shard in read_manifest(store).splits["train"].shards]
    assert sum(shards, ()) == tuple(NAMES)
    assert [len(shard) for shard in shards] == lengths
