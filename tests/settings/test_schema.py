"""Settings are held against the signature of the function that they start."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, TypedDict

import pytest

from completesplat.errors import CompleteSplatError
from completesplat.quantities import Entries, Natural, Positive, Range
from completesplat.settings.schema import check_settings


class Part(TypedDict):
    size: Positive


def task(
    count: Positive,
    share: Annotated[float, Range(0, 1)],
    flag: bool,
    kind: Literal["a", "b"] | None,
    words: Annotated[Sequence[Literal["x", "y"]], Entries(1)],
    workers: Natural | None,
    by_name: Mapping[str, Sequence[Positive]],
    part: Part | Literal[False],
    anything: Any,
    seed: Natural | Sequence[Natural] = 0,
    background: Annotated[float, Range(0, 1)] | Literal["remove"] | None = None,
) -> None: ...


GOOD: dict[str, Any] = {
    **{"count": 1, "share": 0.5, "flag": True, "kind": "b", "words": ["x"], "workers": None, "by_name": {"a": [1]}},
    **{"part": {"size": 2}, "anything": {"_target_": "x"}, "_target_": "task", "out": 3},
}


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("count", 0, "must be at least 1"),
        ("count", 1.5, "must be a whole number"),
        ("count", True, "must be a whole number"),
        ("count", None, "must be a whole number"),
        ("share", "half", "must be a number"),
        ("share", float("nan"), "must lie between 0 and 1"),
        ("flag", 1, "must be true or false"),
        ("kind", "c", "choose one of a, b, null"),
        ("words", "x", "must be a list, such as words=[x]"),
        ("words", [], "must not be empty"),
        ("words", ["x", "z"], "choose one of x, y"),
        ("workers", -1, "must be at least 0, or null"),
        ("words", None, "must be a list"),
        ("by_name", [1], "must be a mapping"),
        ("seed", "x", "must be a whole number"),
        ("background", "white", "must be a number, or remove, or null"),
        ("background", 2, "must lie between 0 and 1, or remove, or null"),
    ],
)
def test_what_does_not_fit_is_named_with_what_it_may_be(setting, value, message):
    with pytest.raises(CompleteSplatError) as caught:
        check_settings(task, GOOD | {setting: value})
    assert str(caught.value) == f"{setting}={'null' if value is None else value}: {message}"


def test_a_list_with_a_wrong_entry_is_told_of_the_entry():
    with pytest.raises(CompleteSplatError, match=r"seed=\[1, -1\]: must be at least 0"):
        check_settings(task, GOOD | {"seed": [1, -1]})


def test_what_fits_is_accepted_and_what_lies_deeper_is_named_with_its_place():
    for other in ({}, {"workers": 0}, {"part": False}, {"share": 1}, {"by_name": {}}):
        check_settings(task, GOOD | other)
    deeper = {"by_name": {"a": [1], "b": [0]}}, {"part": {"size": 0}}
    for wrong, place in zip(deeper, (r"by_name\.b=\[0\]", "part.size=0"), strict=True):
        with pytest.raises(CompleteSplatError, match=f"^{place}: must be at least 1"):
            check_settings(task, GOOD | wrong)
