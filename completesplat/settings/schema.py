"""Settings of verbs, and checks of settings against annotations, made before any work begins."""

import inspect
import math
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypedDict

from completesplat.errors import CompleteSplatError

MOST_SHOWN = 1e6  # help texts leave out larger bounds
NUMBERS: Mapping[type, type] = {int: Integral, float: Real}  # NumPy's are such, too
KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", NoneType: "null"}


@dataclass(frozen=True)
class Range:
    """Rule for `Annotated`: a finite number between two bounds, both included."""

    least: float
    most: float = math.inf

    def refusal(self, value: float) -> str | None:
        if value == math.inf:
            return "must be finite"
        if self.least <= value <= self.most:
            return None
        if math.isinf(self.most):
            return f"must be at least {self.least:g}"
        return f"must lie between {self.least:g} and {self.most:g}"

    def words(self) -> str:
        return f"at least {self.least:g}" if self.most > MOST_SHOWN else f"{self.least:g} to {self.most:g}"


@dataclass(frozen=True)
class Entries:
    """Rule for `Annotated`: a list with a minimum and a maximum number of entries."""

    least: int = 0
    most: float = math.inf

    def refusal(self, value: Sequence[object]) -> str | None:
        if self.least <= len(value) <= self.most:
            return None
        if math.isinf(self.most):
            return "must not be empty"
        return f"must have {'' if self.least == self.most else 'at most '}{self.most} entries"


Positive = Annotated[int, Range(1)]
Natural = Annotated[int, Range(0)]
Seed = Annotated[int, Range(0, 2**63 - 1)]
Share = Annotated[float, Range(0, 1)]
Side = Annotated[int, Range(8, 4096)]  # of an image, in pixels
Format = Literal["ply", "splat", "glb", "mesh", "spz", "sog", "html"]  # of a scene's files
CameraPath = Literal["orbit", "swipe", "wobble"]  # of a video

# Sizes of networks. Their bounds lie beyond what anyone trains, and protect from configs that strangers wrote.
Width = Annotated[int, Range(1, 8192)]
Widths = Annotated[Sequence[Width], Entries(1), Entries(most=8)]
Levels = Annotated[Sequence[Annotated[int, Range(0, 7)]], Entries(most=8)]
Few = Annotated[int, Range(1, 16)]


Precision = Literal["32-true", "bf16-mixed", "16-mixed", 32, "bf16", 16]
"""Lightning's precisions with weights in float32, which Gaussians and cameras need."""


class TrainerSettings(TypedDict):
    """Settings whose ranges Lightning does not check."""

    precision: Precision
    accumulate_grad_batches: Positive
    val_check_interval: Annotated[float, Range(1e-6)] | str | Mapping[str, int] | None
    check_val_every_n_epoch: Positive | None
    gradient_clip_val: Annotated[float, Range(0)] | None


class EvaluationSettings(TypedDict):
    """Settings of a protocol."""

    precision: Precision


class FitSettings(TypedDict):
    """Settings of `completesplat fit`."""

    trainer: TrainerSettings
    evaluation: EvaluationSettings
    seed: Annotated[int, Range(0, 2**32 - 1)]
    ckpt_path: str | None
    test: bool
    optimized_metric: str | None


class PlanSettings(FitSettings):
    """Settings of `completesplat plan`."""

    timed_steps: Positive


class SceneSettings(TypedDict):
    """Settings that `completesplat predict` and `view` share."""

    weights: str
    trust: bool
    guidance_weight: Share
    color_fits: Annotated[int, Range(0, 100)]
    steps: Annotated[int, Range(1, 1000)] | None
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
    cameras: str | None
    screen_space_dilation: bool
    maps: bool
    formats: Format | Sequence[Format] | Literal[False] | None
    video: CameraPath | Sequence[CameraPath] | Literal[False] | None


class ViewSettings(SceneSettings):
    """Settings of `completesplat view`."""

    samples: Annotated[int, Range(1, 8)]
    skip_weight: Share
    seed: Annotated[int, Range(0, 2**31)]
    port: Annotated[int, Range(1, 65535)]


class ModelSettings(TypedDict):
    """Settings of `completesplat test` and of reports on samples that choose the model."""

    ckpt: str | None
    weights: str | None
    overrides: Sequence[str]
    seed: Annotated[int, Range(0, 2**32 - 1)]
    trust: bool


class TestSettings(ModelSettings, total=False):
    """Settings of `completesplat test`, all of which `TrainedModel` takes."""

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
    for name in [name for name in settings if name in hints]:
        check_value(name, hints[name], settings[name])


def check_value(key: str, annotation: object, value: object) -> None:
    """Raise CompleteSplatError, with the values that are allowed, if a setting does not fit an annotation."""
    for place, part, reason in violations(annotation, value):
        example = f", such as {key}{place}=[{part}]" if reason == "must be a list" and part is not None else ""
        raise CompleteSplatError(f"{key}{place}={'null' if part is None else part}: {reason}{example}")


def hints_of(function: object) -> dict[str, object]:
    """Return annotations by name, of a function's arguments or a `TypedDict`; expand `**name: Unpack[...]`."""
    hints = typing.get_type_hints(function, include_extras=True)
    for shared in [typing.get_args(hint)[0] for hint in hints.values() if typing.get_origin(hint) is typing.Unpack]:
        hints |= typing.get_type_hints(shared, include_extras=True)
    return hints


def arguments_of(target: Callable[..., object] | type) -> tuple[dict[str, object], bool]:
    """Return annotations of a class's or function's arguments, by name, and whether these are all the arguments.

    If a class passes further settings on to its base class, the arguments of the base class are included.
    """
    kinds = target.__mro__ if isinstance(target, type) else ()
    functions = [vars(kind)["__init__"] for kind in kinds if "__init__" in vars(kind)] or [target]
    annotations: dict[str, object] = {}
    for function in functions:
        try:
            further, passes_on = _named_arguments(function)
        except (NameError, TypeError, ValueError):  # other packages: names only under TYPE_CHECKING
            return annotations, False
        annotations = further | annotations
        if not passes_on:
            return annotations, True
    return annotations, False


def _named_arguments(function: Callable[..., object]) -> tuple[dict[str, object], bool]:
    """Return annotations of a function's arguments by name, and whether it has a `**` that takes any others."""
    hints = hints_of(function)
    parameters = inspect.signature(function).parameters.values()
    named = {param.name for param in parameters if param.kind in (param.POSITIONAL_OR_KEYWORD, param.KEYWORD_ONLY)}
    unpacked = hints.keys() - {param.name for param in parameters} - {"return"}
    others = [hints.get(param.name) for param in parameters if param.kind is param.VAR_KEYWORD]
    annotations = {name: hints.get(name, object) for name in (named | unpacked) - {"self"}}
    return annotations, any(typing.get_origin(hint) is not typing.Unpack for hint in others)


def start_weights(kind: object) -> Mapping[str, str]:
    """Return the settings of weights that training starts from, with examples, as a part's class declares them."""
    return getattr(kind, "start_weights", {})


def violations(annotation: object, value: object) -> list[Violation]:
    """Return the parts of a value that do not fit an annotation, with the reasons."""
    origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if origin is Annotated:
        kind, *rules = arguments
        return violations(kind, value) or [Violation("", value, x) for rule in rules if (x := rule.refusal(value))]
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


def _in_choice(choices: Sequence[object], value: object) -> list[Violation]:
    written = ", ".join("null" if choice is None else str(choice) for choice in choices)
    return [] if value in choices else [Violation("", value, f"choose one of {written}")]


def _in_union(members: Sequence[object], value: object) -> list[Violation]:
    if all(typing.get_origin(member) is Literal or member is NoneType for member in members):
        return _in_choice([choice for member in members for choice in typing.get_args(member) or (None,)], value)
    # Of `float | Tensor` only float counts, because no setting is a tensor. Classes without numbers accept everything.
    if {int, float} & set(members) and isinstance(value, str | int | float | Sequence):
        members = [member for member in members if not isinstance(member, type) or member in KINDS]
    if isinstance(value, Sequence) and not isinstance(value, str):  # for the reason that its entries do not fit
        members = [*(member for member in members if typing.get_origin(member) is Sequence), *members]
    attempts = [violations(member, value) for member in members]
    if [] in attempts:
        return []
    others = [described(x) or "null" for x in members if x is NoneType or typing.get_origin(x) is Literal]
    return [unfit._replace(reason=", or ".join([unfit.reason, *others])) for unfit in attempts[0]]


def _in_list(kind: object, value: object) -> list[Violation]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        return [Violation("", value, "must be a list")]
    # If an entry does not fit, the whole list is reported.
    return [Violation("", value, unfit.reason) for entry in value for unfit in violations(kind, entry)]


def _in_mapping(annotation: object, value: object) -> list[Violation]:
    if not isinstance(value, Mapping):
        return [Violation("", value, "must be a mapping")]
    hints = typing.get_type_hints(annotation, include_extras=True) if typing.is_typeddict(annotation) else None
    result = []
    for key, part in value.items():
        kind = typing.get_args(annotation)[1] if hints is None else hints.get(key, object)
        result += [unfit._replace(place=f".{key}{unfit.place}") for unfit in violations(kind, part)]
    return result


def described(annotation: object) -> str:
    """Describe the values that an annotation allows in a few words; return an empty text if unknown."""
    origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if origin is Annotated:
        kind, *rules = arguments
        ranges = [rule.words() for rule in rules if isinstance(rule, Range)]
        return ", ".join(filter(None, [described(kind), *ranges]))
    if origin in (typing.Union, UnionType):
        return " or ".join(dict.fromkeys(filter(None, map(described, arguments))))
    if origin is Literal:
        return ", ".join(map(str, arguments))
    if origin is Sequence:
        return "list"
    if origin is Mapping or typing.is_typeddict(annotation):
        return "mapping"
    return KINDS.get(annotation, "").removeprefix("a ") if isinstance(annotation, type) else ""


def _is_a(kind: type, value: object) -> bool:
    if kind is bool or isinstance(value, bool):
        return kind is bool and isinstance(value, bool)
    return isinstance(value, NUMBERS.get(kind, kind))
