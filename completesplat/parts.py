"""What a model is made of: its configuration (`config.json` of weights), held against a list, and only then built.

Anyone can publish weights, and runs. Their configuration names classes of this list with settings of these classes, by
value, and nothing else: nothing is imported or called that it names, and no memory is asked for that the weights' file
does not have.
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
from completesplat.schema import Entries, Range, Share, hints_of, refused, shown
from completesplat.splatter_image import Parameterization
from completesplat.weights import CONFIG_FILE, RUN_CONFIG_FILE, SCENES, read_small

# What each setting that is a part may be.
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
    "scheduler": (
        DDIMScheduler,
        DPMSolverMultistepScheduler,
        FlowMatchEulerDiscreteScheduler,
        UniPCMultistepScheduler,
    ),
}
NETWORKS = ("autoreconstructor", "conditioning", "denoiser", "network")
# Of a run's model: where its configuration has a model's settings, and its checkpoints the tensors.
STAGES = {
    "completesplat.training.latent_diffusion.LatentDiffusion": "completesplat",
    "completesplat.training.reconstruction.ReconstructionModule": "model",
}
Part = Mapping[str, Any]


class TrainingPictures(TypedDict, total=False):
    """What weights say about the pictures that they were trained on; older ones say nothing.

    `box_masks`: how often parts of a picture were hidden. The others: mean and deviation of the training pictures'
    features, see `completesplat.data.pictures.photograph.picture_features`.
    """

    box_masks: Share
    picture_mean: Annotated[Sequence[Share], Entries(8, 8)]
    picture_std: Annotated[Sequence[Annotated[float, Range(1e-6, 1)]], Entries(8, 8)]


class Needed(TypedDict):
    """The settings of `CompleteSplat` that all weights have."""

    autoreconstructor: Part
    conditioning: Part
    denoiser: Part
    sampler: Part
    image_size: Annotated[int, Range(8, 1024)]


class Architecture(Needed, total=False):
    """The settings of `CompleteSplat`."""

    training: TrainingPictures


class NeededOfOneAnswer(TypedDict):
    """What every configuration of `OneAnswer` has."""

    network: Part
    image_size: Annotated[int, Range(8, 1024)]


class OneAnswerArchitecture(NeededOfOneAnswer, total=False):
    """The settings of `OneAnswer`."""

    training: TrainingPictures


class SchedulerSettings(TypedDict, total=False):
    """Settings of diffusers' schedulers, of each those that it has."""

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
    algorithm_type: Literal["dpmsolver", "dpmsolver++"]  # the others draw noise of their own
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
    """The name by which configurations know a class; diffusers gives all of its own at its top."""
    module = "diffusers" if kind.__module__.startswith("diffusers.") else kind.__module__
    return f"{module}.{kind.__name__}"


CLASSES = {name_of(kind): kind for kinds in PARTS.values() for kind in kinds}


def settings_of(kind: Any) -> dict[str, Any]:
    """The settings that a configuration may give to a class, with their annotations."""
    if kind in PARTS["scheduler"]:
        own = inspect.signature(kind).parameters
        return {name: hint for name, hint in hints_of(SchedulerSettings).items() if name in own}
    hints = {name: hint for name, hint in hints_of(kind.__init__).items() if name not in ("return", "sizes")}
    # What training started from is not needed again, and could name any file or address.
    return hints | dict.fromkeys(hints.keys() & {"pretrained"}, NoneType)


def read_architecture(folder: Path) -> dict[str, Any]:
    """The configuration in a folder of weights.

    Raises:
        WeightsError: it cannot be read, or is refused by `check_architecture`.
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
    """The configuration of the model that a run trained, and the prefix of its tensors in the run's checkpoints.

    It is read from the `config.yaml` beside the checkpoint's folder.

    Raises:
        WeightsError: it cannot be read, is of a model that makes no scene of a picture, or as `check_architecture`.
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
    except Exception as error:  # of YAML and of OmegaConf, and where it is no mapping
        raise WeightsError(f"{path}: not a run's configuration ({type(error).__name__})") from error
    if target not in STAGES:
        said = f"a run of {shown(target).rpartition('.')[2]} makes no scene of a photograph"
        fitted = f"; those that it fitted are in {run / SCENES}" if (run / SCENES).is_dir() else ""
        raise WeightsError(f"{path} names {shown(target)}: {said}{fitted}")
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
    """A part's configuration without the weights that its training started from: all are saved together."""
    if not isinstance(part, Mapping):
        return part
    return {key: None if key == "pretrained" else value for key, value in part.items()}


def check_architecture(architecture: Any) -> None:
    """Hold a configuration against `PARTS`, the signatures of these classes, and the bounds in their annotations.

    Raises:
        WeightsError: names the first setting that does not fit.
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
        elif name not in PARTS and (found := refused(hints[name], value)):
            raise WeightsError(f"{key}={shown(value)}: {found[0].reason}")


def _check_part(place: str, part: Any, allowed: Sequence[type]) -> None:
    target = part.get("_target_") if isinstance(part, Mapping) else part
    kinds = [kind for kind in allowed if name_of(kind) == target]
    if not kinds or not isinstance(part, Mapping):
        names = ", ".join(map(name_of, allowed))
        raise WeightsError(f"{place} names {shown(target)}, which is no part of a model; allowed are {names}")
    settings = {name: value for name, value in part.items() if name != "_target_"}
    _check_settings(place, settings_of(kinds[0]), settings)


def build(part: Part) -> Any:
    """A part of a configuration that `check_architecture` has let through, with the parts in it."""
    settings = {name: build(value) if isinstance(value, Mapping) else value for name, value in part.items()}
    return CLASSES[settings.pop("_target_")](**settings)


def check_sizes(architecture: Mapping[str, Any], held: Mapping[str, Sequence[int]], files: tuple[str, str]) -> None:
    """Compare the networks' tensors with the sizes of those that are held.

    Args:
        files: names of the one that holds them, and of the one that the configuration is from.

    Raises:
        WeightsError: one is not there, or has another size.
    """
    with torch.device("meta"):  # which gives tensors sizes and no memory
        networks = nn.ModuleDict({name: build(architecture[name]) for name in NETWORKS if name in architecture})
    for name, value in networks.state_dict().items():
        there = held.get(name)
        if there is None or list(there) != list(value.shape):
            found = "missing" if there is None else list(there)
            raise WeightsError(f"{name} is {found} in {files[0]} and {list(value.shape)} by {files[1]}")


def sizes_in(file: Path) -> dict[str, list[int]]:
    """Of the tensors in a `safetensors` file, of which only the header is read."""
    with safe_open(file, "pt") as tensors:
        return {name: tensors.get_slice(name).get_shape() for name in tensors.keys()}  # noqa: SIM118
