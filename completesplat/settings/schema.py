"""Settings of verbs, and checks of settings against annotations, made before any work begins."""

import inspect
import math
import typing
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, NotRequired, TypedDict

from completesplat.errors import CompleteSplatError
from completesplat.quantities import (
    CameraPath,
    Crop,
    Detail,
    Entries,
    Format,
    NonNegative,
    Positive,
    Range,
    Seed,
    Share,
    Side,
)

NOT_A_LIST = "must be a list"
NUMBERS: Mapping[type, type] = {int: Integral, float: Real}  # which include NumPy's numbers
KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", NoneType: "null"}


Precision = Literal["32-true", "bf16-mixed", "16-mixed", 32, "bf16", 16]
"""Lightning's precisions with weights in float32, which Gaussians and cameras need."""

Elevation = Annotated[float, Range(-85, 85)]
"""Degrees above the horizon."""


class TrainerSettings(TypedDict):
    """Settings whose ranges Lightning does not check."""

    precision: Precision
    accumulate_grad_batches: Positive
    val_check_interval: Annotated[float, Range(1e-6)] | str | Mapping[str, int] | None
    check_val_every_n_epoch: Positive | None
    gradient_clip_val: NonNegative | None


class EvaluationSettings(TypedDict):
    """Settings of a protocol."""

    precision: Precision
    resolution: NotRequired[Side | None]


class FitSettings(TypedDict):
    """Settings of `completesplat fit`."""

    trainer: TrainerSettings
    evaluation: EvaluationSettings
    seed: Annotated[int, Range(0, 2**32 - 1)]
    ckpt_path: str | None
    test: bool
    optimized_metric: str | None
    skip_unchanged: bool


class PlanSettings(FitSettings):
    """Settings of `completesplat plan`."""

    timed_steps: Positive


class SceneSettings(TypedDict):
    """Settings that `completesplat predict` and `view` share."""

    weights: str
    trust: bool
    guidance_weight: Share
    color_fits: Annotated[int, Range(0, 100)]
    detail: Detail
    steps: Annotated[int, Range(1, 1000)] | None
    crop: Crop
    fov: float | None
    frames: Annotated[int, Range(1, 1000)]
    background: Share | Literal["remove"] | None


class PredictSettings(SceneSettings):
    """Settings of `completesplat predict`. All samples of an image, or frames of a video, are in memory at once."""

    shard: Annotated[int, Range(0)]
    shards: Positive
    devices: Positive
    samples: Annotated[int, Range(1, 1000)]
    skip_weight: Share | None
    seed: Seed
    batch: Positive | None
    mask: str | None
    box: Sequence[float] | None
    cameras: str | Sequence[float] | None
    elevation: Elevation | Sequence[Elevation]
    screen_space_dilation: bool
    maps: bool
    spz_version: Literal[3, 4]
    formats: Format | Sequence[Format] | Literal[False] | None
    video: CameraPath | Sequence[CameraPath] | Literal[False] | None


class ViewSettings(SceneSettings):
    """Settings of `completesplat view`."""

    samples: Annotated[int, Range(1, 8)]
    skip_weight: Share
    seed: Annotated[int, Range(0, 2**31)]
    port: Annotated[int, Range(1, 65535)]


class ExportSettings(TypedDict):
    """Settings of `completesplat export`."""

    precision: Literal["float32", "float16"]
    trust: bool
    graphs: bool
    push: str | None
    private: bool
    confirm: bool
    license: str | None
    datasets: Sequence[str]
    pictures: Sequence[str]
    scores: Sequence[str]


class ModelSettings(TypedDict):
    """Settings of `completesplat test` and of reports on samples that choose the model."""

    ckpt: str | None
    weights: str | None
    overrides: Sequence[str]
    typed: NotRequired[Sequence[str]]
    seed: Annotated[int, Range(0, 2**32 - 1)]
    trust: bool


class TestSettings(ModelSettings, total=False):
    """Settings of `completesplat test`, all of which `trained_model` takes."""

    scenes: str | None
    frame: Literal["opencv", "opengl"]
    align: Literal["none", "scale"]
    method: str | None
    data: Mapping[str, object]
    rasterizer: Mapping[str, object]
    sampler: Mapping[str, object]


VERBS: dict[str, type] = {
    "fit": FitSettings,
    "plan": PlanSettings,
    "predict": PredictSettings,
    "view": ViewSettings,
    "export": ExportSettings,
    "test": TestSettings,
}
"""Settings of verbs; the settings of a task are the arguments of its function."""


class Violation(NamedTuple):
    """A refused value: its place inside the setting (`.key`, empty for the setting itself) and the reason."""

    place: str
    value: object
    reason: str


def check_settings(function: object, settings: Mapping[str, object]) -> None:
    """Check settings against the annotations of the same names, of a function's arguments or in a `TypedDict`.

    Numbers, choices, lists, mappings and `TypedDict`s are checked, with `Range` and `Entries`; any
    other annotation accepts everything.

    Raises:
        CompleteSplatError: a setting does not fit. The message names the first one, and the values that it may have.
    """
    hints = hints_of(function)
    for name in settings:
        if name in hints:  # others may be missing in a config
            check_value(name, hints[name], settings[name])


def check_value(key: str, annotation: object, value: object) -> None:
    """Raise CompleteSplatError, with the values that are allowed, if a setting does not fit an annotation."""
    unfit = violations(annotation, value)
    if not unfit:
        return
    place, part, reason = unfit[0]
    written = "null" if part is None else part
    if reason == NOT_A_LIST and part is not None:
        reason = f"{reason}, such as {key}{place}=[{part}]"
    raise CompleteSplatError(f"{key}{place}={written}: {reason}")


def hints_of(function: object) -> dict[str, object]:
    """Return annotations by name, of a function's arguments or a `TypedDict`, with those in `**name: Unpack[...]`."""
    hints = typing.get_type_hints(function, include_extras=True)
    for hint in list(hints.values()):
        if typing.get_origin(hint) is typing.Unpack:
            shared = typing.get_args(hint)[0]
            hints.update(typing.get_type_hints(shared, include_extras=True))
    return hints


def arguments_of(target: Callable[..., object] | type) -> tuple[dict[str, object], bool]:
    """Return annotations of a class's or function's arguments, by name, and whether these are all the arguments.

    If a class passes further settings on to its base class, the arguments of the base class are included.
    """
    functions: list[Callable[..., object]] = [target]
    if isinstance(target, type):
        functions = [vars(kind)["__init__"] for kind in target.__mro__ if "__init__" in vars(kind)]
    annotations: dict[str, object] = {}
    for function in functions:
        try:
            further, passes_on = _named_arguments(function)
        except (NameError, TypeError, ValueError):  # annotations of other packages may name what only checkers import
            return annotations, False
        annotations = further | annotations
        if not passes_on:
            return annotations, True
    return annotations, False


def _named_arguments(function: Callable[..., object]) -> tuple[dict[str, object], bool]:
    """Return annotations of a function's arguments by name, and whether it has a `**` that takes any others."""
    hints = hints_of(function)
    annotations: dict[str, object] = {}
    takes_any = False
    for name, parameter in inspect.signature(function).parameters.items():
        hint = hints.pop(name, object)
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            annotations[name] = hint
        elif parameter.kind is parameter.VAR_KEYWORD and typing.get_origin(hint) is not typing.Unpack:
            takes_any = True
    annotations.update(hints)  # the names in `**name: Unpack[...]`
    annotations.pop("self", None)
    annotations.pop("return", None)
    return annotations, takes_any


def violations(annotation: object, value: object) -> list[Violation]:
    """Return the parts of a value that do not fit an annotation, with the reasons."""
    origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if origin is Annotated:
        return _in_bounds(arguments[0], arguments[1:], value)
    if origin is Literal:
        return _in_choice(arguments, value)
    if origin in (typing.Union, UnionType):
        return _in_union(arguments, value)
    if origin is Sequence:
        return _in_list(arguments[0], value)
    if origin is Mapping or typing.is_typeddict(annotation):
        return _in_mapping(annotation, value)
    if isinstance(annotation, type) and annotation in KINDS:
        return [] if _is_a(annotation, value) else [Violation("", value, f"must be {KINDS[annotation]}")]
    is_part = isinstance(annotation, type) and annotation not in (object, Any)
    if value is None and (is_part or origin is Callable):
        return [Violation("", value, "must not be null; leave it out")]
    return []


def _in_bounds(kind: object, rules: Sequence[object], value: Any) -> list[Violation]:
    unfit = violations(kind, value)
    if unfit:
        return unfit
    for rule in rules:
        reason = None
        if isinstance(rule, Range):
            reason = _range_reason(rule, value)
        elif isinstance(rule, Entries):
            reason = _entries_reason(rule, len(value))
        if reason is not None:
            unfit.append(Violation("", value, reason))
    return unfit


def _range_reason(allowed: Range, value: float) -> str | None:
    """Return why a number lies outside of a range, or None."""
    if value == math.inf:
        return "must be finite"
    if allowed.least <= value <= allowed.most:
        return None
    if math.isinf(allowed.most):
        return f"must be at least {allowed.least:g}"
    return f"must lie between {allowed.least:g} and {allowed.most:g}"


def _entries_reason(allowed: Entries, count: int) -> str | None:
    """Return why a list has too few or too many entries, or None."""
    if allowed.least <= count <= allowed.most:
        return None
    if math.isinf(allowed.most):
        return "must not be empty"
    if allowed.least == allowed.most:
        return f"must have {allowed.most} entries"
    return f"must have at most {allowed.most} entries"


def _in_choice(choices: Sequence[object], value: object) -> list[Violation]:
    if value in choices:
        return []
    written = ", ".join("null" if choice is None else str(choice) for choice in choices)
    return [Violation("", value, f"choose one of {written}")]


def _in_union(members: Sequence[object], value: object) -> list[Violation]:
    choices = _choices(members)
    if choices is not None:
        return _in_choice(choices, value)
    members = _likely_first(members, value)
    attempts = [violations(member, value) for member in members]
    if [] in attempts:
        return []
    alternatives: list[str] = []
    for member in members:
        if member is NoneType:
            alternatives.append("null")
        elif typing.get_origin(member) is Literal:
            alternatives.append(", ".join(map(str, typing.get_args(member))))
    return [unfit._replace(reason=", or ".join([unfit.reason, *alternatives])) for unfit in attempts[0]]


def _choices(members: Sequence[object]) -> list[object] | None:
    """Return the values that a union allows if it has nothing but choices and null, else None."""
    choices: list[object] = []
    for member in members:
        if member is NoneType:
            choices.append(None)
        elif typing.get_origin(member) is Literal:
            choices.extend(typing.get_args(member))
        else:
            return None
    return choices


def _likely_first(members: Sequence[object], value: object) -> list[object]:
    """Return the members of a union that a value is compared with, the one whose reason the message gives first.

    Of `float | Tensor` only float counts, because no setting is a tensor. Classes without numbers accept everything.
    """
    counted = list(members)
    if {int, float} & set(counted) and isinstance(value, str | int | float | Sequence):
        counted = [member for member in counted if not isinstance(member, type) or member in KINDS]
    if isinstance(value, str) or not isinstance(value, Sequence):
        return counted
    lists = [member for member in counted if typing.get_origin(member) is Sequence]
    return lists + [member for member in counted if member not in lists]


def _in_list(kind: object, value: object) -> list[Violation]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        return [Violation("", value, NOT_A_LIST)]
    # If an entry does not fit, the whole list is reported.
    return [Violation("", value, unfit.reason) for entry in value for unfit in violations(kind, entry)]


def _in_mapping(annotation: object, value: object) -> list[Violation]:
    if not isinstance(value, Mapping):
        return [Violation("", value, "must be a mapping")]
    hints: Mapping[str, object] = {}
    default: object = object
    if typing.is_typeddict(annotation):
        hints = typing.get_type_hints(annotation, include_extras=True)
    else:
        default = typing.get_args(annotation)[1]
    result = []
    for key, part in value.items():
        for unfit in violations(hints.get(key, default), part):
            result.append(unfit._replace(place=f".{key}{unfit.place}"))
    return result


def _is_a(kind: type, value: object) -> bool:
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, NUMBERS.get(kind, kind))
