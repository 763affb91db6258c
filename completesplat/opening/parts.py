"""Models built from configs (`config.json` of weights), which are first checked against a list of allowed classes.

Anyone can publish weights and runs. Their configs may name only classes of this list, with plain values as settings:
nothing else that they name is imported or called, and a model takes no more memory than its weights file holds.
"""

import inspect
import json
from collections.abc import Mapping, Sequence
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
from completesplat.settings.schema import Entries, Range, Share, hints_of, refused
from completesplat.splatter_image import Parameterization
from completesplat.weights import read_small

# The classes that each setting may name, for settings that are parts of a model.
PARTS: dict[str, tuple[type, ...]] = {
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
NETWORKS = ("autoreconstructor", "conditioning", "denoiser", "network")
PartConfig = Mapping[str, object]  # config of a part: `_target_`, and arguments


class TrainingImages(TypedDict, total=False):
    """Facts about the training images that are stored with weights; older weights have none.

    `content`: what they show, in words, for weights in the package. `box_masks`: how often parts of an image were
    hidden. `background`: grey value behind the objects, if images show nothing else. The others: mean and standard
    deviation of the training images' features, see `completesplat.data.images.photograph.image_features`.
    """

    content: str
    box_masks: Share
    background: Share
    picture_mean: Annotated[Sequence[Share], Entries(8, 8)]
    picture_std: Annotated[Sequence[Annotated[float, Range(1e-6, 1)]], Entries(8, 8)]


# Settings of models: those of `CompleteSplat`, and those of `OneAnswer`. All but `training` are needed.
COMMON = {"image_size": Annotated[int, Range(8, 1024)], "training": TrainingImages}
DRAWING = dict.fromkeys(("autoreconstructor", "conditioning", "denoiser", "sampler"), PartConfig) | COMMON
ONE_ANSWER = {"network": PartConfig} | COMMON


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


def name_of(kind: type) -> str:
    """Return the name of a class in configs; diffusers exports all of its classes from its top level."""
    module = "diffusers" if kind.__module__.startswith("diffusers.") else kind.__module__
    return f"{module}.{kind.__name__}"


CLASSES = {name_of(kind): kind for kinds in PARTS.values() for kind in kinds}


def settings_of(kind: Any) -> dict[str, Any]:
    """Return the settings that a config may give to a class, with their annotations."""
    if kind in PARTS["scheduler"]:
        parameters = inspect.signature(kind).parameters
        return {name: hint for name, hint in hints_of(SchedulerSettings).items() if name in parameters}
    hints = {name: hint for name, hint in hints_of(kind.__init__).items() if name not in ("return", "sizes")}
    # The weights that training started from are not needed again, and could name any file or address.
    return hints | dict.fromkeys(hints.keys() & {"pretrained"}, NoneType)


def read_architecture(path: Path) -> dict[str, Any]:
    """Read the `config.json` of weights; raise WeightsError if this fails or `check_architecture` refuses it."""
    try:
        architecture = json.loads(read_small(path))
    except (ValueError, RecursionError) as error:
        raise WeightsError(f"{path}: not readable as JSON ({error})") from error
    check_architecture(architecture, path)
    return dict(architecture)


def untrained(part: Any) -> Any:
    """Return a part's config without the weights that training started from, because a checkpoint holds all weights."""
    if not isinstance(part, Mapping):
        return part
    return {key: None if key == "pretrained" else value for key, value in part.items()}


def check_architecture(architecture: object, file: Path | None = None) -> None:
    """Raise WeightsError, naming `file`, for the first setting that `PARTS` or the signatures of its classes refuse."""
    settings = architecture if isinstance(architecture, Mapping) else {}
    hints = ONE_ANSWER if "network" in settings else DRAWING
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
        if name in PARTS and (value is not None or name != "view_encoder"):
            _check_part(key, value, PARTS[name])
        elif isinstance(hint, type) and is_typeddict(hint) and isinstance(value, Mapping):
            _check_settings(key, hints_of(hint), value)
        elif name not in PARTS and (refusals := refused(hint, value)):
            raise WeightsError(f"{key}={printable(value, SHORT)}: {refusals[0].reason}")


def _check_part(place: str, part: object, allowed: Sequence[type]) -> None:
    target = part.get("_target_") if isinstance(part, Mapping) else part
    kinds = [kind for kind in allowed if name_of(kind) == target]
    if not kinds or not isinstance(part, Mapping):
        names = ", ".join(map(name_of, allowed))
        raise WeightsError(
            f"{place} names {printable(target, SHORT)}, which is no part of a model; allowed are {names}"
        )
    settings = {name: value for name, value in part.items() if name != "_target_"}
    _check_settings(place, settings_of(kinds[0]), settings)


def build(part: PartConfig) -> Any:
    """Build a part, and the parts in it, from a config that `check_architecture` has accepted."""
    settings = {name: build(value) if isinstance(value, Mapping) else value for name, value in part.items()}
    return CLASSES[str(settings.pop("_target_"))](**settings)


def check_sizes(architecture: Mapping[str, PartConfig], tensors: Mapping[str, Tensor], files: tuple[str, str]) -> None:
    """Raise WeightsError if a tensor is missing or has another size; `files` names the tensors' and the config's."""
    with torch.device("meta"):  # tensors with sizes but without memory
        networks = nn.ModuleDict({name: build(architecture[name]) for name in NETWORKS if name in architecture})
    for name, value in networks.state_dict().items():
        actual = list(tensors[name].shape) if name in tensors else "missing"
        if actual != list(value.shape):
            raise WeightsError(f"{name} is {actual} in {files[0]} and {list(value.shape)} by {files[1]}")
