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
from omegaconf import OmegaConf
from safetensors import safe_open
from torch import nn

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.autoreconstructor.view_encoders import PlaneSweep
from completesplat.baselines.regressor import SplatterImageUNet
from completesplat.diffusion.conditioning import LearnedConditioning, StableDiffusionConditioning
from completesplat.diffusion.denoiser import Denoiser, TextlessStableDiffusion
from completesplat.diffusion.sampling import Sampler
from completesplat.errors import WeightsError
from completesplat.settings.schema import Entries, Range, Share, hints_of, refused, shown
from completesplat.splatter_image import Parameterization
from completesplat.weights import CONFIG_FILE, RUN_CONFIG_FILE, SCENES, read_small

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
# For each Lightning module of a run: the key of the model in its config and of the tensors in its checkpoints.
STAGES = {
    "completesplat.training.latent_diffusion.LatentDiffusion": "completesplat",
    "completesplat.training.reconstruction.ReconstructionModule": "model",
}
Part = Mapping[str, Any]


class TrainingPictures(TypedDict, total=False):
    """Facts about the training images that are stored with weights; older weights have none.

    `box_masks`: how often parts of an image were hidden. The others: mean and standard deviation of the training
    images' features, see `completesplat.data.images.photograph.image_features`.
    """

    box_masks: Share
    picture_mean: Annotated[Sequence[Share], Entries(8, 8)]
    picture_std: Annotated[Sequence[Annotated[float, Range(1e-6, 1)]], Entries(8, 8)]


class Needed(TypedDict):
    """Settings of `CompleteSplat` that all weights have."""

    autoreconstructor: Part
    conditioning: Part
    denoiser: Part
    sampler: Part
    image_size: Annotated[int, Range(8, 1024)]


class Architecture(Needed, total=False):
    """All settings of `CompleteSplat`."""

    training: TrainingPictures


class NeededOfOneAnswer(TypedDict):
    """Settings of `OneAnswer` that all weights have."""

    network: Part
    image_size: Annotated[int, Range(8, 1024)]


class OneAnswerArchitecture(NeededOfOneAnswer, total=False):
    """All settings of `OneAnswer`."""

    training: TrainingPictures


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


def read_architecture(folder: Path) -> dict[str, Any]:
    """Read the config in a folder of weights.

    Raises:
        WeightsError: the config cannot be read, or `check_architecture` refuses it.
    """
    path = folder / CONFIG_FILE
    try:
        architecture: dict[str, Any] = json.loads(read_small(path))
    except (ValueError, RecursionError) as error:
        raise WeightsError(f"{path}: not readable as JSON ({error})") from error
    try:
        check_architecture(architecture)
    except WeightsError as error:
        raise WeightsError(f"{path}: {error}") from error
    return architecture


def architecture_of_run(checkpoint: Path) -> tuple[dict[str, Any], str]:
    """Return a run's model config, from `config.yaml` beside the checkpoint's folder, and its tensors' prefix.

    Raises:
        WeightsError: the config cannot be read, its model makes no scene from an image, or as `check_architecture`.
    """
    run = checkpoint.absolute().parent.parent
    path = run / RUN_CONFIG_FILE
    if not path.is_file():
        raise WeightsError(f"{checkpoint}: the run's configuration {path} is missing")
    try:
        config: Any = OmegaConf.to_container(OmegaConf.create(read_small(path)), resolve=False)
        model, image_size = config["model"], config["data"]["image_size"]
        target = str(model["_target_"])
    except WeightsError:
        raise
    except Exception as error:  # raised by YAML or OmegaConf, or because it is no mapping
        raise WeightsError(f"{path}: not a run's configuration ({type(error).__name__})") from error
    if target not in STAGES:
        reason = f"a run of {shown(target).rpartition('.')[2]} makes no scene of a photograph"
        fitted = f"; those that it fitted are in {run / SCENES}" if (run / SCENES).is_dir() else ""
        raise WeightsError(f"{path} names {shown(target)}: {reason}{fitted}")
    part = model.get(STAGES[target])
    if STAGES[target] == "model":
        architecture: dict[str, Any] = {"network": untrained(part), "image_size": image_size}
    else:
        settings = part if isinstance(part, Mapping) else {}
        architecture = {name: untrained(x) for name, x in settings.items() if name not in ("_target_", "_recursive_")}
    try:
        check_architecture(architecture)
    except WeightsError as error:
        raise WeightsError(f"{path}: {error}") from error
    return architecture, f"{STAGES[target]}."


def untrained(part: Any) -> Any:
    """Return a part's config without the weights that training started from, because a checkpoint holds all weights."""
    if not isinstance(part, Mapping):
        return part
    return {key: None if key == "pretrained" else value for key, value in part.items()}


def check_architecture(architecture: Any) -> None:
    """Check a config against `PARTS`, the signatures of these classes, and the bounds in their annotations.

    Raises:
        WeightsError: a setting does not fit; the message names the first one.
    """
    one_answer = isinstance(architecture, Mapping) and "network" in architecture
    hints = hints_of(OneAnswerArchitecture if one_answer else Architecture)
    needed = (NeededOfOneAnswer if one_answer else Needed).__required_keys__
    if not isinstance(architecture, Mapping) or not needed <= architecture.keys() <= hints.keys():
        raise WeightsError(f"a model's settings are {', '.join(hints)}")
    _check_settings("", hints, architecture)


def _check_settings(place: str, hints: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    for name, value in settings.items():
        key = f"{place}.{name}".lstrip(".")
        if name not in hints:
            raise WeightsError(f"{shown(key)}: there is no such setting, but {', '.join(hints)}")
        if name in PARTS and (value is not None or name != "view_encoder"):
            _check_part(key, value, PARTS[name])
        elif is_typeddict(hints[name]) and isinstance(value, Mapping):
            _check_settings(key, hints_of(hints[name]), value)
        elif name not in PARTS and (refusals := refused(hints[name], value)):
            raise WeightsError(f"{key}={shown(value)}: {refusals[0].reason}")


def _check_part(place: str, part: Any, allowed: Sequence[type]) -> None:
    target = part.get("_target_") if isinstance(part, Mapping) else part
    kinds = [kind for kind in allowed if name_of(kind) == target]
    if not kinds or not isinstance(part, Mapping):
        names = ", ".join(map(name_of, allowed))
        raise WeightsError(f"{place} names {shown(target)}, which is no part of a model; allowed are {names}")
    settings = {name: value for name, value in part.items() if name != "_target_"}
    _check_settings(place, settings_of(kinds[0]), settings)


def build(part: Part) -> Any:
    """Build a part, and the parts in it, from a config that `check_architecture` has accepted."""
    settings = {name: build(value) if isinstance(value, Mapping) else value for name, value in part.items()}
    return CLASSES[settings.pop("_target_")](**settings)


def check_sizes(architecture: Mapping[str, Any], held: Mapping[str, Sequence[int]], files: tuple[str, str]) -> None:
    """Compare the networks' tensors with the sizes `held`; `files` names the tensors' file and the config's.

    Raises:
        WeightsError: a tensor is missing, or has another size.
    """
    with torch.device("meta"):  # tensors with sizes but without memory
        networks = nn.ModuleDict({name: build(architecture[name]) for name in NETWORKS if name in architecture})
    for name, value in networks.state_dict().items():
        stored = held.get(name)
        if stored is None or list(stored) != list(value.shape):
            actual = "missing" if stored is None else list(stored)
            raise WeightsError(f"{name} is {actual} in {files[0]} and {list(value.shape)} by {files[1]}")


def sizes_in(file: Path) -> dict[str, list[int]]:
    """Return the sizes of the tensors in a `safetensors` file, of which only the header is read."""
    with safe_open(file, "pt") as tensors:
        return {name: tensors.get_slice(name).get_shape() for name in tensors.keys()}  # noqa: SIM118
