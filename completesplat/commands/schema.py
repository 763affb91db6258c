"""Settings are checked against the signature of the function that they start, before anything is done."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints, is_typeddict

from completesplat.errors import CompleteSplatError

KINDS = {int: "a whole number", float: "a number", bool: "true or false"}


@dataclass(frozen=True)
class Range:
    """A rule for `Annotated`: a number lies between two others, both included."""

    least: float
    most: float = math.inf

    def refusal(self, value: Any) -> str | None:
        """Why the value is refused; None if it is not."""
        if self.least <= value <= self.most:
            return None
        if math.isinf(self.most):
            return f"must be at least {self.least:g}"
        return f"must lie between {self.least:g} and {self.most:g}"


@dataclass(frozen=True)
class OneOf:
    """A rule for `Annotated`: a value is one of several."""

    choices: tuple[Any, ...]

    def refusal(self, value: Any) -> str | None:
        """Why the value is refused; None if it is not."""
        return None if value in self.choices else f"choose one of {', '.join(map(str, self.choices))}"


@dataclass(frozen=True)
class Filled:
    """A rule for `Annotated`: a list has at least one entry."""

    def refusal(self, value: Any) -> str | None:
        """Why the value is refused; None if it is not."""
        return None if value else "must not be empty"


Positive = Annotated[int, Range(1)]
Natural = Annotated[int, Range(0)]


class Refused(NamedTuple):
    """A value below a setting: `.key` of its place (empty for the setting itself), and why it is refused."""

    place: str
    value: Any
    reason: str


def check_settings(function: Any, settings: Mapping[str, Any]) -> None:
    """Hold settings against the annotations of the function's arguments of the same names.

    Numbers, choices, lists, mappings and `TypedDict`s are checked, with `Range`, `OneOf` and `Filled`; any other
    annotation accepts everything.

    Raises:
        CompleteSplatError: names the first setting that does not fit, and what it may be.
    """
    hints = get_type_hints(function, include_extras=True)
    for name, value in settings.items():
        found = refused(hints.get(name, Any), value)
        if found is not None:
            key = name + found.place
            example = f", such as {key}=[{found.value}]" if found.reason == "must be a list" else ""
            raise CompleteSplatError(f"{key}={found.value}: {found.reason}{example}")


def refused(annotation: Any, value: Any) -> Refused | None:
    """The part of a value that does not fit an annotation, with the reason; None if all fits."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        kind, *rules = arguments
        reasons = [rule.refusal(value) for rule in rules] if refused(kind, value) is None else []
        return refused(kind, value) or next((Refused("", value, reason) for reason in reasons if reason), None)
    if origin in (Union, UnionType):
        found = [refused(member, value) for member in arguments]
        return None if None in found else found[0]
    if origin is Literal:
        reason = OneOf(arguments).refusal(value)
        return Refused("", value, reason) if reason else None
    if origin is Sequence:
        return _refused_list(arguments[0], value)
    if origin is Mapping or is_typeddict(annotation):
        return _refused_mapping(annotation, value)
    if annotation is NoneType:
        return None if value is None else Refused("", value, "must be null")
    if annotation in KINDS and not _is_a(annotation, value):
        return Refused("", value, f"must be {KINDS[annotation]}")
    return None


def _is_a(kind: type, value: Any) -> bool:
    if kind is bool or isinstance(value, bool):
        return kind is bool and isinstance(value, bool)
    return isinstance(value, int | float if kind is float else kind)


def _refused_list(annotation: Any, value: Any) -> Refused | None:
    """The whole list, where one of its entries does not fit."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        return Refused("", value, "must be a list")
    found = [refused(annotation, entry) for entry in value]
    return next((Refused("", value, one.reason) for one in found if one is not None), None)


def _refused_mapping(annotation: Any, value: Any) -> Refused | None:
    if not isinstance(value, Mapping):
        return Refused("", value, "must be a mapping")
    typed = get_type_hints(annotation, include_extras=True) if is_typeddict(annotation) else {}
    for key, entry in value.items():
        found = refused(typed.get(key, Any) if typed else get_args(annotation)[1], entry)
        if found is not None:
            return found._replace(place=f".{key}{found.place}")
    return None
