import resource
from functools import partial
from pathlib import Path

import pytest
import torch
from packed_sequences import ListedSource
from support import strict_json
from torch import Tensor

from completesplat.data.validation.audit import AuditReport, check, show_findings
from completesplat.data.validation.processes import map_in_processes
from completesplat.errors import BadAnnotation, ChangedFile, MissingFile
from completesplat.files import write_json


def check_quietly(**sources: ListedSource) -> AuditReport:
    return check(sources, workers=1, progress=False)


def places(findings: AuditReport) -> set[tuple[str, str | None, int | None]]:
    return {(error.kind, error.sequence, error.frame) for error in findings.refused}


def damaged() -> dict[str, ListedSource]:
    """Two splits that share a sequence; planted: 8 faults, of which 1 is seen through both."""
    train = ListedSource(
        {"a": (1, 2, 3), "b": (10, 20, 30), "c": (5, 6), "d": (7, 8), "e": (9,)},
        bad_frames={"a": [1], "c": [1]},
        failing={"d": BadAnnotation("no camera", "d.json")},
        refused=[MissingFile("no such file", "shared.txt")],
        left_out={"score below 0.5": ["x", "y"]},
        group_size=2,
    )
    val = ListedSource(
        {"b": (20, 30, 40, 50), "f": (1, 2)},
        bad_frames={"b": [3]},
        refused=[MissingFile("no such file", "shared.txt")],
        changed=[ChangedFile("not its SHA-256", "shard-0")],
    )
    return {"train": train, "val": val}


PLANTED = {
    ("missing file", None, None),
    ("left out", "x", None),
    ("left out", "y", None),
    ("changed file", None, None),
    ("unusable image", "a", 2),
    ("unusable image", "c", 6),
    ("malformed annotation", "d", None),
    ("too few frames", "e", None),
    ("unusable image", "b", 50),
}


def test_every_planted_fault_is_found_once_written_and_shown(tmp_path: Path, capsys) -> None:
    """`a` keeps 1 and 3, `b` 10 to 40, `f` both; `c` and `e` keep one frame, `d` none."""
    findings = check_quietly(**damaged())
    assert places(findings) == PLANTED
    assert len(findings.refused) == len(PLANTED)
    assert findings.splits == {"train": {"sequences": 2, "frames": 2 + 3}, "val": {"sequences": 2, "frames": 3 + 2}}
    write_json(tmp_path / "check.json", findings.json())
    written = strict_json(tmp_path / "check.json")
    assert written == findings.json()
    assert written["shared"] == {"train and val": ["b"]}
    assert written["usable"] == {"sequences": 3, "frames": 2 + 4 + 2}
    assert {"sequence": "a", "frame": 2, "file": "a/1.jpg", "reason": "cannot be decoded"} in written["refused"]
    assert {"sequence": "x", "frame": None, "file": None, "reason": "score below 0.5"} in written["refused"]
    others = dict.fromkeys(("missing file", "changed file", "malformed annotation", "too few frames"), 1)
    assert written["counts"] == {"unusable image": 3, "left out: score below 0.5": 2, **others}
    show_findings(findings)
    shown = capsys.readouterr().out
    assert "1 sequences are in both train and val: b\n" in shown
    for text in ("left out: score below 0.5", "unusable image", "a/1.jpg, a, frame 2: cannot be decoded"):
        assert text in shown
    assert shown.splitlines()[-1] == "usable sequences: 3, their usable frames: 8 (train 2 and 5, val 2 and 5)"


def test_images_in_several_splits_are_read_once() -> None:
    read: list[tuple[str, int]] = []
    train = ListedSource({"a": (1, 2, 3), "b": (1, 2)}, bad_frames={"a": [2]}, images_read=read)
    findings = check_quietly(train=train, val=ListedSource({"a": (2, 3, 4)}, bad_frames={"a": [1]}, images_read=read))
    assert sorted(read) == [("a", 0), ("a", 1), ("a", 2), ("a", 2), ("b", 0), ("b", 1)]  # frames 1, 2, 3 and 4 of a
    assert places(findings) == {("unusable image", "a", 3)}
    assert (findings.frames, findings.splits["val"]) == (5, {"sequences": 1, "frames": 2})


def test_splits_are_read_by_themselves_and_too_few_frames_reported_only_where_nothing_else_explains_them() -> None:
    failing = {"a": BadAnnotation("no camera", "a.json")}
    findings = check_quietly(train=ListedSource({"a": (1, 2)}, failing=failing), val=ListedSource({"a": (3, 4)}))
    assert places(findings) == {("malformed annotation", "a", None)}
    assert findings.splits == {"train": {"sequences": 0, "frames": 0}, "val": {"sequences": 1, "frames": 2}}
    findings = check_quietly(train=ListedSource({"a": (1, 2), "b": (1,)}, bad_frames={"a": [0]}))
    assert places(findings) == {("unusable image", "a", 1), ("too few frames", "b", None)}
    assert (findings.sequences, findings.frames) == (0, 0)
    with pytest.raises(ZeroDivisionError, match="a mistake in the reader"):
        check_quietly(train=ListedSource("abcd", failing={"c": ZeroDivisionError("a mistake in the reader")}))


@pytest.mark.processes
def test_two_processes_find_the_same_in_the_same_order() -> None:
    sources = damaged()
    sources["train"].listed_names |= {f"more {i}": (1, 2, 3) for i in range(40)}
    sources["train"].group_size = 17
    alone, together = (check(sources, workers=workers, progress=False) for workers in (1, 2))
    assert together.json() == alone.json()
    assert [type(error) for error in together.refused] == [type(error) for error in alone.refused]
    assert together.sequences == 43


def test_sound_data_show_no_table_and_strange_names_are_shown_whole(capsys: pytest.CaptureFixture[str]) -> None:
    """Neither markup nor control characters nor undecodable bytes in a name change how the table looks."""
    show_findings(check_quietly(train=ListedSource({"a": (1, 2)}), val=ListedSource([])))
    assert capsys.readouterr().out == "usable sequences: 1, their usable frames: 2 (train 1 and 2, val 0 and 0)\n"
    name = "[bold]" + "long/" * 50 + "\x1b[31m\n\udc80"
    show_findings(check_quietly(train=ListedSource({"a": (1, 2)}, refused=[MissingFile("no such file", name)])))
    printed = capsys.readouterr().out.splitlines()
    assert max(map(len, printed)) <= 120
    cell = "".join(line.split("│")[3].strip() for line in printed if "│" in line)
    # Lines may end at a space, which is then not printed.
    assert "[bold]" + "long/" * 50 + r"\x1b[31m\n\udc80:nosuchfile" in cell.replace(" ", "")


def _total(tensors: list[Tensor], place: int) -> float:
    return float(tensors[place].sum())


@pytest.mark.processes
def test_the_function_for_processes_may_hold_more_tensors_than_a_process_may_open_files():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    total = partial(_total, [torch.full((3,), float(value)) for value in range(300)])
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        assert list(map_in_processes(total, [0, 150, 299], workers=2)) == pytest.approx([0, 450, 897])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
