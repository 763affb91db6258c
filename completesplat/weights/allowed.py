"""The one list of what files of weights and runs may name (SECURITY.md).

Anyone can publish weights and runs, so nothing that their configs name is imported or called before it is found here.
The list is the package's `conf/`: a run may name what it names for models and data, weights what it names for networks
and samplers. The user's own modules and extensions may be named, too, if the file is the user's or trusted.

Only the last part of a path counts, the name of a class or function: a path in this package or diffusers stands for
what has this name today, so weights and runs of earlier versions open when something has moved. Weights store the name
alone.
"""

import inspect
import os
import re
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, TypedDict, is_typeddict

from huggingface_hub import constants
from hydra.utils import get_object
from omegaconf import OmegaConf

from completesplat.errors import WeightsError
from completesplat.quantities import Entries, Range, Share
from completesplat.settings.checks import HYDRA_KEYS, START_WEIGHTS, unfit_image_size
from completesplat.settings.extensions import extension_of
from completesplat.settings.options import LOADER, conf_folder
from completesplat.settings.schema import hints_of, violations
from completesplat.wording import SHORT, printable

# Groups of `conf/` that weights may name parts of, and those that only runs may name parts of.
GROUPS_OF_WEIGHTS = ("autoreconstructor", "conditioning", "denoiser", "posterior", "regressor", "sampler")
GROUPS_OF_RUNS = ("data", "experiment", "ablation", "loss", "model", "objective", "optimizer", "rasterizer", "schedule")
PATH = re.compile(r"(?:(?:completesplat|diffusers)\.(?:\w+\.)*)?(\w+)")
OPTIMIZER = re.compile(r"torch\.optim\.[A-Z]\w*")
PartConfig = Mapping[str, object]  # config of a part: `_target_`, and arguments


class ListedPart(NamedTuple):
    """A class or function that `conf/` names: its path, and the settings that it may be in weights (none: in runs)."""

    path: str
    settings: set[str]


class TrainingImages(TypedDict, total=False):
    """Facts about the training images that are stored with weights.

    Weights of earlier versions have none.

    Attributes:
        content: what they show, in words, for weights in the package.
        log_odds: logarithm of the odds that a photo shows this, before it is seen (0: even). It is low for renders,
            which are rare.
        feature_odds: what each of the image's features adds to `log_odds` (`notebooks/odds.py`); the sum compares the
            photo with other things on the same background. Without it, the odds are of normal distributions.
        box_masks: how often parts of an image were hidden.
        background: grey value behind the objects, if images show nothing else.
        depth_before, depth_after: depth range before and behind the centre of an object of the common size.
        picture_mean, picture_std: mean and standard deviation of the training images' features, see
            `completesplat.photo.features.image_features`.
    """

    content: str
    log_odds: Annotated[float, Range(-1000, 1000)]
    feature_odds: Annotated[Sequence[Annotated[float, Range(-1000, 1000)]], Entries(8, 8)]
    box_masks: Share
    background: Share
    depth_before: Annotated[float, Range(0, 1e6)]
    depth_after: Annotated[float, Range(0, 1e6)]
    picture_mean: Annotated[Sequence[Share], Entries(8, 8)]
    picture_std: Annotated[Sequence[Annotated[float, Range(1e-6, 1)]], Entries(8, 8)]


# Settings of models: those of `CompleteSplat`, and those of `DeterministicModel`. All but `training` are needed.
COMMON_SETTINGS = {"image_size": Annotated[int, Range(8, 1024)], "training": TrainingImages}
SAMPLING_PARTS = ("autoreconstructor", "conditioning", "denoiser", "sampler")
SAMPLING_SETTINGS = dict.fromkeys(SAMPLING_PARTS, PartConfig) | COMMON_SETTINGS
DETERMINISTIC_SETTINGS = {"network": PartConfig} | COMMON_SETTINGS


class SchedulerSettings(TypedDict, total=False):
    """Settings of diffusers' schedulers, which do not check them. Each scheduler has some of them."""

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


@cache
def listed_parts() -> dict[str, ListedPart]:
    """Return all that the package's `conf/` names for models and data, by name.

    The `conf/` of the working folder adds nothing.
    """
    parts: dict[str, ListedPart] = {}
    for group in (*GROUPS_OF_WEIGHTS, *GROUPS_OF_RUNS):
        for file in (conf_folder() / group).glob("*.yaml"):
            config = LOADER(file.read_text(encoding="utf-8")).get_single_data()
            for setting, path in _named_in(group, config):
                part = parts.setdefault(path.rpartition(".")[2], ListedPart(path, set()))
                if group in GROUPS_OF_WEIGHTS:
                    part.settings.add(setting)
    return parts


def _named_in(setting: str, config: object) -> Iterator[tuple[str, str]]:
    """Yield the setting and the path of each `_target_` in a config."""
    if isinstance(config, list):
        for value in config:
            yield from _named_in(setting, value)
    if isinstance(config, dict):
        for name, value in config.items():
            if name != "_target_":
                yield from _named_in(name, value)
            elif "${" not in value:
                yield setting, value


@cache
def choices(setting: str) -> list[str]:
    """Return the names that weights may give for a setting, such as `encoder`; none if the setting is no part."""
    settings = {"autoreconstructor", "regressor"} if setting == "network" else {setting}
    return sorted(name for name, part in listed_parts().items() if settings & part.settings)


@cache
def names_for_weights() -> list[str]:
    """Return the names of all classes that weights may name."""
    return sorted(name for name, part in listed_parts().items() if part.settings)


def name_of(target: object) -> str | None:
    """Return a `_target_` that is a name or a path in this package or diffusers as a name, whether listed or not."""
    path = PATH.fullmatch(target) if isinstance(target, str) else None
    return None if path is None else path[1]


@dataclass(frozen=True)
class ConfigOrigin:
    """The file that a config comes from.

    Args:
        file: the file.
        folder: the folder of the run, or of weights without a run, with links resolved.
        trust: whether the user trusts who made the file.
    """

    file: Path
    folder: Path
    trust: bool

    def may_name_own_modules(self) -> bool:
        """Whether the file is trusted, or the user owns a run below the working folder, and has so made or brought it.

        The hub's client brings files into its cache without the user. The working folder itself must not be the run's,
        because modules that came with it would pass as the user's.
        """
        downloaded = Path(constants.HF_HUB_CACHE).resolve() in self.folder.parents
        below = Path.cwd() in self.folder.parents
        owners = {self.folder.stat().st_uid, self.file.stat().st_uid}
        return self.trust or (below and not downloaded and owners == {os.getuid()})


def check_names(config: Any, origin: ConfigOrigin, setting: object = "") -> Any:
    """Return a plain config with the present paths of parts that it names by name or old path.

    A config may name what is listed, and optimizers of torch. What extensions and the user's modules define may be
    named if the origin allows it; such modules are imported here.

    Args:
        setting: the setting that has the value `config`.

    Raises:
        WeightsError: the config names something else.
    """
    if isinstance(config, Mapping):
        for name in config:
            check_names(str(name), origin, setting)
        return {name: check_names(value, origin, name) for name, value in config.items()}
    if isinstance(config, list):
        return [check_names(value, origin, setting) for value in config]
    value = str(config)
    # `fit` writes resolved values. References are refused because a resolver can read the environment and more.
    if "${" in value:
        refusal = f"{origin.file}: {printable(value, SHORT)} refers to something else"
        raise WeightsError(f"{refusal}, which a stored configuration does not")
    if setting != "_target_" or OPTIMIZER.fullmatch(value):
        return config
    name = name_of(value)
    if name in listed_parts():
        return listed_parts()[name].path
    refusal = f"{origin.file} names {printable(value, SHORT)}, which is no part of models or data in this package"
    if not origin.may_name_own_modules():
        yours = "a module of your own or of a package that you installed for this"
        raise WeightsError(f"{refusal}; if it is {yours}, and you trust who made the file: trust=true")
    if own_part(value) is None:
        places = "which lies in the working folder, in one of PYTHONPATH or in an installed extension"
        raise WeightsError(f"{refusal}, and not defined in a module of your own, {places} (SECURITY.md)")
    return value


def own_part(target: str) -> Any:
    """Import what a path names, and return it if it is the user's own: None for this package's and other libraries'.

    A module is the user's own if it is not installed, or belongs to an extension, which the user chose to install.
    """
    top = target.partition(".")[0]
    try:
        spec = find_spec(top)  # imports nothing, because the name has no dot
    except (ImportError, ValueError):
        return None
    if spec is None or top == "completesplat":
        return None
    places = [spec.origin] if spec.has_location else spec.submodule_search_locations or []
    installed = not places or any(_is_installed(Path(str(place)).resolve()) for place in places)
    if installed and extension_of(top) is None:
        return None
    try:
        part = get_object(target)
    except (ImportError, ValueError) as error:
        raise WeightsError(f"{target}: cannot be imported ({error})") from error
    # A user's module also holds what it imports from others, which may not be named.
    defining = str(getattr(part, "__module__", None))
    return part if defining.partition(".")[0] == top else None


def _is_installed(path: Path) -> bool:
    libraries = {Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    if "site-packages" in path.parts or "dist-packages" in path.parts:
        return True
    return any(library in path.parents for library in libraries)


def class_of(part: object) -> Any:
    """Return the class that a part's config names, which is listed or the user's own; None if it may not be named."""
    target = part.get("_target_") if isinstance(part, Mapping) else None
    if not isinstance(target, str):
        return None
    name = name_of(target)
    if name is None:
        return own_part(target)
    return get_object(listed_parts()[name].path) if name in names_for_weights() else None


def stored_config(part: Any) -> Any:
    """Return a part's config as weights store it: by the classes' names, without weights that training started from."""
    if not isinstance(part, Mapping):
        return part
    settings = {name: stored_config(value) for name, value in part.items()}
    if "_target_" in settings:
        settings |= dict.fromkeys(settings.keys() & START_WEIGHTS)
        name = name_of(settings["_target_"])
        if name in names_for_weights():
            settings["_target_"] = name
    return settings


def check_architecture(architecture: object, file: Path | None = None) -> None:
    """Raise WeightsError, naming `file`, for the first part that `choices` or value that a signature refuses."""
    settings = architecture if isinstance(architecture, Mapping) else {}
    hints = DETERMINISTIC_SETTINGS if "network" in settings else SAMPLING_SETTINGS
    try:
        if not hints.keys() - {"training"} <= settings.keys() <= hints.keys():
            raise WeightsError(f"a model's settings are {', '.join(hints)}")
        _check_settings("", hints, settings)
        reason = unfit_image_size(settings["image_size"], OmegaConf.create({**settings}))
        if reason is not None:
            raise WeightsError(f"image_size={settings['image_size']}: {reason}")
    except WeightsError as error:
        raise (error if file is None else WeightsError(f"{file}: {error}")) from None


def settings_of(kind: Any) -> dict[str, Any]:
    """Return the settings that a config may give to a listed class, with their annotations."""
    if kind.__name__ in choices("scheduler"):
        parameters = inspect.signature(kind).parameters
        return {name: hint for name, hint in hints_of(SchedulerSettings).items() if name in parameters}
    hints = {name: hint for name, hint in hints_of(kind.__init__).items() if name not in ("return", "sizes")}
    # The weights that training started from are not needed again, and could name any file or address.
    return hints | dict.fromkeys(hints.keys() & START_WEIGHTS, NoneType)


def _check_settings(place: str, hints: Mapping[str, Any], settings: Mapping[str, object]) -> None:
    for name, value in settings.items():
        key = f"{place}.{name}".lstrip(".")
        if name not in hints:
            raise WeightsError(f"{printable(key, SHORT)}: there is no such setting, but {', '.join(hints)}")
        hint = hints[name]
        refusals = violations(hint, value)
        if choices(name) and (value is not None or refusals):
            _check_part(key, value, choices(name))
        elif is_typeddict(hint) and isinstance(value, Mapping):
            _check_settings(key, hints_of(hint), value)
        elif refusals:
            raise WeightsError(f"{key}={printable(value, SHORT)}: {refusals[0].reason}")


def _check_part(place: str, part: object, allowed: Sequence[str]) -> None:
    target = part.get("_target_") if isinstance(part, Mapping) else part
    name = name_of(target)
    kind = class_of(part)
    if not isinstance(part, Mapping) or kind is None or (name is not None and name not in allowed):
        names = ", ".join([*allowed, "classes of your own modules"])
        reason = f"names {printable(target, SHORT)}, which is no part of a model; allowed are {names}"
        raise WeightsError(f"{place} {reason}")
    settings = {key: value for key, value in part.items() if key != "_target_"}
    if name is None:
        _check_parts_in(place, settings)
    else:
        _check_settings(place, settings_of(kind), settings)


def _check_parts_in(place: str, value: object) -> None:
    """Check the parts in the settings of a user's own class, which may have any settings but Hydra's."""
    if isinstance(value, list):
        for index, entry in enumerate(value):
            _check_parts_in(f"{place}.{index}", entry)
    elif isinstance(value, Mapping) and "_target_" in value:
        _check_part(place, value, names_for_weights())
    elif isinstance(value, Mapping):
        for name, part in value.items():
            if name in HYDRA_KEYS:
                raise WeightsError(f"{place}.{name}: weights cannot store this setting")
            _check_parts_in(f"{place}.{name}", part)
