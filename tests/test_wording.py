"""Whatever an image is called, its folder lies in `out`, and what is shown is one line."""

import os
from pathlib import Path

from hypothesis import example, given, settings
from hypothesis import strategies as st

from completesplat import wording

# What a file system may hold (any bytes but NUL and the slash), and what only a program may hand over.
FILES = st.binary(min_size=1, max_size=300).map(os.fsdecode)
ODD = st.text(st.sampled_from("./\\\0\n\r\t\x1b\x7f\x85\u2028\udc80\ud800aÄß \u00e9e\u0301:*?"), max_size=300)
STEMS = st.one_of(FILES, ODD, st.text(st.characters(), max_size=300))


@settings(max_examples=150, deadline=None)
@given(st.lists(STEMS, max_size=8))
@example(["..", ".", "...", "", "/", "\\", "../../x", "\0", "\udcff", "\ud800"])
@example(["ä" * 255, "ä" * 254, "Ä" * 255, "a" * 255, "a" * 99 + "é"])
@example(["é", "e\u0301", "É", "a", "a_2", "A", "a", "a_2"])
@example(["x" * 100] * 12)
def test_every_name_stays_in_the_folder_and_is_its_own(stems):
    out = Path("/out")
    names = wording.folder_names(stems)
    assert len(names) == len(stems)
    for name in names:
        assert Path(os.path.normpath(out / name)).parent == out
        assert Path(os.path.normpath(out / name)).name == name
        assert not name.startswith(".")
        assert "\\" not in name
        assert 0 < len(name.encode()) <= wording.LONGEST
        assert wording.printable(name) == name
    assert len({name.casefold() for name in names}) == len(names)


@settings(max_examples=100, deadline=None)
@given(STEMS)
def test_what_is_shown_is_one_line_and_can_be_written(text):
    shown = wording.printable(text)
    assert shown.encode().decode() == shown
    assert len(shown.splitlines()) <= 1
    assert wording.printable(shown) == shown
    assert "\x1b" not in shown
    assert len(wording.printable(text * 10)) <= wording.MOST_SHOWN


def test_plain_names_stay_as_they_are():
    for name in ("a", "c.tar", "Bär 3", "雪", "👩‍🚀", "a:b", "x" * 100, "a\u202fb"):
        assert wording.safe_name(name) == wording.printable(name) == name
    assert [wording.safe_name(dots) for dots in (".", "..", ".a", "..a.b")] == ["unnamed", "unnamed", "a", "a.b"]
    assert wording.printable("a\n\udcff\x1b[31m") == "a\\n\\udcff\\x1b[31m"


def test_paths_are_sorted_by_the_values_of_their_numbers() -> None:
    paths = [Path(name) for name in ("a/r_0", "a/r_02", "a/r_2", "a/r_3", "a/r_010", "a/r_11", "b")]
    shuffled = paths[::-1]
    shuffled.sort(key=wording.by_numbers)
    assert shuffled == paths
