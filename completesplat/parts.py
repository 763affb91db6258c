"""Models built from configs (`config.json` of weights), which are first checked against a list of allowed classes.

Anyone can publish weights and runs. Their configs may name only classes of this list, with plain values as settings:
nothing else that they name is imported or called, and a model takes no more memory than its weights file holds.
Weights store a class by its name alone. A path in this package or diffusers stands for the class at its end, so weights
and runs of earlier versions open when a class has moved. Any other path stands for a class of the user's own modules;
`completesplat.run_configs.check_names` decides first whether a file may name it.
"""

import inspect
import re
import sysconfig
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, TypedDict, is_typeddict

import torch
from diffusers import (
    DDIMScheduler,
    DPMSolverMultistepScheduler,
    FlowMatchEulerDiscreteScheduler,
    UniPCMultistepScheduler,
)
from hydra.utils import get_object
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.autoreconstructor.view_encoders import PlaneSweep
from completesplat.baselines.regressor import SplatterImageUNet
from completesplat.diffusion.conditioning import LearnedConditioning, StableDiffusionConditioning
from completesplat.diffusion.denoiser import Denoiser, TextlessStableDiffusion
from completesplat.diffusion.sampling import Sampler
from completesplat.errors import WeightsError
from completesplat.files import SHORT, printable
from completesplat.quantities import Entries, Range, Share
from completesplat.settings.checks import HYDRA_KEYS
from completesplat.settings.schema import hints_of, start_weights, violations
from completesplat.splatter_image import Parameterization

# The classes that each setting may name, for settings that are parts of a model.
CHOICES: dict[str, tuple[type, ...]] = {
    "autoreconstructor": (VariationalAutoReconstructor,),
    "encoder": (Encoder,),
    "reconstructor": (Reconstructor,),
    "parameterization": (Parameterization,),
    "view_encoder": (PlaneSweep,),
    "conditioning": (LearnedConditioning, StableDiffusionConditioning),
    "denoiser": (Denoiser, TextlessStableDiffusion),
    "network": (VariationalAutoReconstructor, SplatterImageUNet),
    "sampler": (Sampler,),
    "scheduler": (DDIMScheduler, DPMSolverMultistepScheduler, FlowMatchEulerDiscreteScheduler, UniPCMultistepScheduler),
}
PARTS: dict[str, type] = {kind.__name__: kind for kinds in CHOICES.values() for kind in kinds}
PATH = re.compile(r"(?:(?:completesplat|diffusers)\.(?:\w+\.)*)?(\w+)")
NETWORKS = ("autoreconstructor", "conditioning", "denoiser", "network")
PartConfig = Mapping[str, object]  # config of a part: `_target_`, and arguments


class TrainingImages(TypedDict, total=False):
    """Facts about the training images that are stored with weights; older weights have none.

    `content`: what they show, in words, for weights in the package. `log_odds`: logarithm of the odds that a photo
    shows this, before it is seen (0: even); low for renders, which are rare, and high for fruit on white. `box_masks`:
    how often parts of an image were hidden. `background`: grey value behind the objects, if images show nothing else.
    `depth_before`: depth range before the centre of an object of the common size. The others: mean
    and standard deviation of the training images' features, see `completesplat.photo.features.image_features`.
    """

    content: str
    log_odds: Annotated[float, Range(-100, 100)]
    box_masks: Share
    background: Share
    depth_before: Annotated[float, Range(0, 1e6)]
    picture_mean: Annotated[Sequence[Share], Entries(8, 8)]
    picture_std: Annotated[Sequence[Annotated[float, Range(1e-6, 1)]], Entries(8, 8)]


# Settings of models: those of `CompleteSplat`, and those of `DeterministicModel`. All but `training` are needed.
COMMON_SETTINGS = {"image_size": Annotated[int, Range(8, 1024)], "training": TrainingImages}
SAMPLING_PARTS = ("autoreconstructor", "conditioning", "denoiser", "sampler")
SAMPLING_SETTINGS = dict.fromkeys(SAMPLING_PARTS, PartConfig) | COMMON_SETTINGS
DETERMINISTIC_SETTINGS = {"network": PartConfig} | COMMON_SETTINGS


class SchedulerSettings(TypedDict, total=False):
    """Settings of diffusers' schedulers; each scheduler has some of them."""

    num_train_timesteps: Annotated[int, Range(1, 10_000)]
    beta_start: Share
    beta_end: Share
    beta_schedule: Literal["linear", "scaled_linear", "squaredcos_cap_v2"]
    trained_betas: Annotated[Sequence[Share], Entries(most=10_000)] | None
    prediction_type: Literal["epsilon", "sample", "v_prediction", "flow_prediction"]
    rescale_betas_zero_snr: bool
    timestep_spacing: Literal["leading", "linspace", "trailing"]
    steps_offset: Annotated[int, Range(0, 10_000)]
    clip_sample: bool
    clip_sample_range: Annotated[float, Range(0, 1e6)]
    set_alpha_to_one: bool
    thresholding: bool
    dynamic_thresholding_ratio: Share
    sample_max_value: Annotated[float, Range(0, 1e6)]
    algorithm_type: Literal["dpmsolver", "dpmsolver++"]  # the other types draw their own noise
    solver_order: Annotated[int, Range(1, 3)]
    solver_type: Literal["midpoint", "heun", "bh1", "bh2"]
    lower_order_final: bool
    euler_at_final: bool
    final_sigmas_type: Literal["zero", "sigma_min"]
    predict_x0: bool
    disable_corrector: Annotated[Sequence[Annotated[int, Range(0, 10_000)]], Entries(most=10_000)]
    use_karras_sigmas: bool
    use_exponential_sigmas: bool
    use_beta_sigmas: bool
    use_lu_lambdas: bool
    shift: Annotated[float, Range(1e-3, 1e3)]


def class_of(part: object) -> Any:
    """Return the class that a part's config names: of `PARTS`, by name or a path of any version, or the user's own."""
    target = part.get("_target_") if isinstance(part, Mapping) else None
    if not isinstance(target, str):
        return None
    path = PATH.fullmatch(target)
    return own_part(target) if path is None else PARTS.get(path[1])


def own_part(target: str) -> Any:
    """Import what a path names, and return it if a module that is neither installed nor this package's defines it."""
    top = target.partition(".")[0]
    try:
        spec = find_spec(top)  # imports nothing, because the name has no dot
    except (ImportError, ValueError):
        return None
    if spec is None or top == "completesplat":
        return None
    places = [spec.origin] if spec.has_location else spec.submodule_search_locations or []
    if not places or any(_is_installed(Path(str(place)).resolve()) for place in places):
        return None
    try:
        part = get_object(target)
    except (ImportError, ValueError) as error:
        raise WeightsError(f"{target}: cannot be imported ({error})") from error
    # A user's module also holds what it imports from others, which may not be named.
    return part if str(getattr(part, "__module__", None)).partition(".")[0] == top else None


def _is_installed(path: Path) -> bool:
    libraries = {Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    return not {"site-packages", "dist-packages"}.isdisjoint(path.parts) or not libraries.isdisjoint(path.parents)


def settings_of(kind: Any) -> dict[str, Any]:
    """Return the settings that a config may give to a class, with their annotations."""
    if kind in CHOICES["scheduler"]:
        parameters = inspect.signature(kind).parameters
        return {name: hint for name, hint in hints_of(SchedulerSettings).items() if name in parameters}
    hints = {name: hint for name, hint in hints_of(kind.__init__).items() if name not in ("return", "sizes")}
    # The weights that training started from are not needed again, and could name any file or address.
    return hints | dict.fromkeys(hints.keys() & start_weights(kind), NoneType)


def stored_config(part: Any) -> Any:
    """Return a part's config as weights store it: by the classes' names, without weights that training started from."""
    if not isinstance(part, Mapping):
        return part
    kind = class_of(part)
    settings = {name: None if name in start_weights(kind) else stored_config(value) for name, value in part.items()}
    return settings | {"_target_": kind.__name__} if kind in PARTS.values() else settings


def check_architecture(architecture: object, file: Path | None = None) -> None:
    """Raise WeightsError, naming `file`, for the first setting that `CHOICES` or a signature refuses."""
    settings = architecture if isinstance(architecture, Mapping) else {}
    hints = DETERMINISTIC_SETTINGS if "network" in settings else SAMPLING_SETTINGS
    try:
        if not hints.keys() - {"training"} <= settings.keys() <= hints.keys():
            raise WeightsError(f"a model's settings are {', '.join(hints)}")
        _check_settings("", hints, settings)
    except WeightsError as error:
        raise (error if file is None else WeightsError(f"{file}: {error}")) from None


def _check_settings(place: str, hints: Mapping[str, Any], settings: Mapping[str, object]) -> None:
    for name, value in settings.items():
        key = f"{place}.{name}".lstrip(".")
        if name not in hints:
            raise WeightsError(f"{printable(key, SHORT)}: there is no such setting, but {', '.join(hints)}")
        hint = hints[name]
        if name in CHOICES and (value is not None or name != "view_encoder"):
            _check_part(key, value, CHOICES[name])
        elif isinstance(hint, type) and is_typeddict(hint) and isinstance(value, Mapping):
            _check_settings(key, hints_of(hint), value)
        elif name not in CHOICES and (refusals := violations(hint, value)):
            raise WeightsError(f"{key}={printable(value, SHORT)}: {refusals[0].reason}")


def _check_part(place: str, part: object, allowed: Sequence[type]) -> None:
    kind = class_of(part)
    is_custom = kind is not None and kind not in PARTS.values()
    if not isinstance(part, Mapping) or not (is_custom or kind in allowed):
        target = part.get("_target_") if isinstance(part, Mapping) else part
        names = ", ".join([*(kind.__name__ for kind in allowed), "classes of your own modules"])
        reason = f"names {printable(target, SHORT)}, which is no part of a model; allowed are {names}"
        raise WeightsError(f"{place} {reason}")
    settings = {name: value for name, value in part.items() if name != "_target_"}
    if is_custom:
        return _check_parts_in(place, settings)
    _check_settings(place, settings_of(kind), settings)


def _check_parts_in(place: str, value: object) -> None:
    """Check the parts in the settings of a user's own class, which may have any settings but Hydra's."""
    if isinstance(value, Mapping) and "_target_" in value:
        return _check_part(place, value, tuple(PARTS.values()))
    settings = dict(enumerate(value)) if isinstance(value, list) else value
    for name, part in settings.items() if isinstance(settings, Mapping) else ():
        if name in HYDRA_KEYS:
            raise WeightsError(f"{place}.{name}: weights cannot store this setting")
        _check_parts_in(f"{place}.{name}", part)


def build(part: Any) -> Any:
    """Build a part, and the parts in it, from a config that `check_architecture` has accepted."""
    if isinstance(part, list):
        return [build(value) for value in part]
    if not isinstance(part, Mapping):
        return part
    settings = {name: build(value) for name, value in part.items() if name != "_target_"}
    return class_of(part)(**settings) if "_target_" in part else settings


def check_sizes(architecture: Mapping[str, PartConfig], tensors: Mapping[str, Tensor], files: tuple[str, str]) -> None:
    """Raise WeightsError if a tensor is missing or has another size; `files` names the tensors' and the config's."""
    with torch.device("meta"):  # tensors with sizes but without memory
        networks = nn.ModuleDict({name: build(architecture[name]) for name in NETWORKS if name in architecture})
    for name, value in networks.state_dict().items():
        actual = list(tensors[name].shape) if name in tensors else "missing"
        if actual != list(value.shape):
            raise WeightsError(f"{name} is {actual} in {files[0]} and {list(value.shape)} by {files[1]}")
