"""Settings are held against the signature of the function that they start."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, TypedDict

import pytest

from completesplat.commands.schema import Filled, Natural, OneOf, Positive, Range, check_settings
from completesplat.errors import CompleteSplatError


class Part(TypedDict):
    size: Positive


def task(
    count: Positive,
    share: Annotated[float, Range(0, 1)],
    flag: bool,
    kind: Literal["a", "b"],
    words: Annotated[Sequence[Annotated[str, OneOf(("x", "y"))]], Filled()],
    numbers: Sequence[Natural],
    workers: Natural | None,
    by_name: Mapping[str, Sequence[Positive]],
    part: Part | Literal[False],
    anything: Any,
) -> None: ...


GOOD: dict[str, Any] = {
    **{"count": 1, "share": 0.5, "flag": True, "kind": "b", "words": ["x"], "numbers": [], "workers": None},
    **{"by_name": {"a": [1]}, "part": {"size": 2}, "anything": {"_target_": "x"}, "_target_": "task", "out": 3},
}


def test_what_fits_is_accepted():
    for other in ({}, {"workers": 0}, {"part": False}, {"share": 1}, {"by_name": {}}):
        check_settings(task, GOOD | other)


@pytest.mark.parametrize(
    ("setting", "value", "said"),
    [
        ("count", 0, "count=0: must be at least 1"),
        ("count", 1.5, "count=1.5: must be a whole number"),
        ("count", True, "count=True: must be a whole number"),
        ("count", "many", "count=many: must be a whole number"),
        ("count", None, "count=None: must be a whole number"),
        ("share", 1.5, "share=1.5: must lie between 0 and 1"),
        ("share", "half", "share=half: must be a number"),
        ("share", float("nan"), "share=nan: must lie between 0 and 1"),
        ("flag", 1, "flag=1: must be true or false"),
        ("kind", "c", "kind=c: choose one of a, b"),
        ("words", "x", "words=x: must be a list, such as words=[x]"),
        ("words", [], "words=[]: must not be empty"),
        ("words", ["x", "z"], "words=['x', 'z']: choose one of x, y"),
        ("numbers", [0, -1], "numbers=[0, -1]: must be at least 0"),
        ("workers", -1, "workers=-1: must be at least 0"),
        ("by_name", {"a": [1], "b": [0]}, "by_name.b=[0]: must be at least 1"),
        ("by_name", [1], "by_name=[1]: must be a mapping"),
        ("part", {"size": 0}, "part.size=0: must be at least 1"),
    ],
)
def test_what_does_not_fit_is_named_with_what_it_may_be(setting, value, said):
    with pytest.raises(CompleteSplatError) as caught:
        check_settings(task, GOOD | {setting: value})
    assert str(caught.value) == said
