"""Opening of models: find the files that `weights` names, and check them before anything is built (SECURITY.md).

The config of weights may name only the parts in `parts`. The config of a run may name all parts of models and data in
`conf/`, and the user's modules if the run is the user's or trusted (`check_names`).
"""

import os
import re
import sysconfig
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.utils import get_object
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from safetensors.torch import load_file
from torch import Tensor
from yaml import YAMLError

from completesplat.baselines.splatter_image.files import find, is_published
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.files import SHORT, printable
from completesplat.opening.parts import check_architecture, check_sizes, read_architecture, untrained
from completesplat.scene_model import camera_tensors
from completesplat.settings.checks import check_image_size, check_optimizer, check_parts
from completesplat.settings.options import conf_folder
from completesplat.settings.schema import check_value
from completesplat.weights import (
    CAMERA,
    CONFIG_FILE,
    RUN_CHECKPOINT,
    RUN_CONFIG_FILE,
    RUN_WEIGHTS,
    SCENES,
    WEIGHTS_FILE,
    check_folder,
    check_name,
    first_line,
    from_hub,
    read_small,
    shipped,
)
from completesplat.weights.checkpoint_reading import read_checkpoint

SECTIONS = ["model", "data"]  # sections of a run's config that are read
ONLY_FOR_TRAINING = (
    "model.autoreconstructor_checkpoint",
    "model.checkpoint",
    "model.model.pretrained",
    "model.completesplat.autoreconstructor.pretrained",
    "model.completesplat.conditioning.pretrained",
    "model.loss.terms.lpips",
    "model.loss.terms.efficientnet",
)
"""Settings of weights that only training reads, for its start or its loss. Checkpoints hold the trained weights."""
GROUPS = {"ablation", "autoreconstructor", "conditioning", "data", "denoiser", "experiment", "loss", "model"}
GROUPS |= {"objective", "optimizer", "posterior", "rasterizer", "regressor", "sampler", "schedule"}
"""Groups of `conf/` that models and data are composed of."""
TARGET = re.compile(r"_target_: *([\w.]+)")
OPTIMIZER = re.compile(r"torch\.optim\.[A-Z]\w*")
# By class of a stage: the key of its model in a run's config, and the prefix of its tensors in checkpoints.
STAGES = {
    "completesplat.training.latent_diffusion.LatentDiffusion": "completesplat",
    "completesplat.training.reconstruction.ReconstructionModule": "model",
}


def locate(weights: Path | str) -> Path:
    """Return the tensor file that `weights` stands for.

    Args:
        weights: a name of shipped weights, a folder of weights or of a run, a checkpoint, an id on the Hugging Face
            hub, or published weights of Splatter Image (`is_published`). A run stands for its final weights or, before
            they exist, for its newest checkpoint, which may not exist yet either.

    Raises:
        WeightsError: there is no such folder, a file is missing, or its checksum differs.
    """
    name, path = str(weights), Path(weights).expanduser()
    if is_published(weights):
        return find(name).weights
    check_name(name)
    if name in shipped():
        path = shipped()[name]
    elif not os.path.exists(path):
        path = from_hub(name)
    elif path.is_file() and path.name != WEIGHTS_FILE:
        return path
    elif path.is_file():
        path = path.parent
    elif not (path / CONFIG_FILE).is_file():
        if (path / RUN_WEIGHTS / CONFIG_FILE).is_file():
            path /= RUN_WEIGHTS
        elif (path / RUN_CONFIG_FILE).is_file():
            return path / RUN_CHECKPOINT
    check_folder(path)
    return path / WEIGHTS_FILE


def read_saved(file: Path) -> tuple[dict[str, Any], Mapping[str, Tensor]]:
    """Read and check a model's config and its tensors by name; read averaged tensors if a run averages its weights.

    The file comes from `locate` and does not hold published weights of Splatter Image.

    Raises:
        WeightsError: the config or the tensors cannot be read, name parts that weights may not name, or do not belong
            together; or the run's model makes no scene from a photo.
    """
    if file.name == WEIGHTS_FILE:
        architecture, tensors = read_architecture(file.with_name(CONFIG_FILE)), load_file(file)
        check_sizes(architecture, tensors, (WEIGHTS_FILE, CONFIG_FILE))
        return architecture, tensors
    architecture, prefix = architecture_of_run(file)
    contents = read_checkpoint(file)
    one_answer = "network" in architecture
    name = "network." if one_answer else ""
    tensors = {name + k.removeprefix(prefix): x for k, x in contents["state_dict"].items() if k.startswith(prefix)}
    check_sizes(architecture, tensors, (file.name, RUN_CONFIG_FILE))
    return architecture, tensors | camera_tensors(contents.get(CAMERA, {})) if one_answer else tensors


def config_of_run(checkpoint: Path, overrides: list[str], trust: bool = False) -> Any:
    """Return `model` and `data` of the config of a checkpoint's run, with `overrides`, which `fit` must accept.

    The config may come from anyone, so `check_names` limits what it names. The overrides may name anything.

    Raises:
        WeightsError: the checkpoint or its config is missing or unreadable, or `check_names` refuses the config.
        CompleteSplatError: the overrides cannot be read, or `fit` would refuse them, too.
    """
    if not checkpoint.is_file():
        raise WeightsError(f"{checkpoint}: no such checkpoint")
    path, config = _read(checkpoint)
    check_names(_plain(config), path, path.resolve().parent, trust)
    return without_training(_changed(config, overrides))


def architecture_of_run(checkpoint: Path) -> tuple[dict[str, Any], str]:
    """Return a run's model config, and its tensors' prefix in checkpoints; raise WeightsError if it cannot be used."""
    path, config = _read(checkpoint)
    plain = _plain(config)
    model, target = plain["model"], str(plain["model"].get("_target_"))
    if target not in STAGES:
        reason = f"a run of {printable(target, SHORT).rpartition('.')[2]} makes no scene of a photograph"
        fitted = path.parent / SCENES
        advice = f"; those that it fitted are in {fitted}" if fitted.is_dir() else ""
        raise WeightsError(f"{path} names {printable(target, SHORT)}: {reason}{advice}")
    part = model.get(STAGES[target])
    if STAGES[target] == "model":
        architecture = {"network": untrained(part), "image_size": plain["data"].get("image_size")}
    else:
        settings = part if isinstance(part, Mapping) else {}
        architecture = {key: untrained(x) for key, x in settings.items() if key not in ("_target_", "_recursive_")}
    check_architecture(architecture, path)
    return architecture, f"{STAGES[target]}."


def _read(checkpoint: Path) -> tuple[Path, Any]:
    """Return the path of the config of a checkpoint's run, and its sections `model` and `data`."""
    path = checkpoint.absolute().parent.parent / RUN_CONFIG_FILE
    if not path.is_file():
        raise WeightsError(f"{checkpoint}: the run's configuration {path} is missing")
    try:
        config = OmegaConf.masked_copy(OmegaConf.create(read_small(path)), SECTIONS)  # type: ignore[arg-type]
    except WeightsError:
        raise
    except Exception as error:  # YAML and OmegaConf raise errors of many types
        raise WeightsError(f"{path}: not a run's configuration ({type(error).__name__})") from error
    if not all(isinstance(_plain(config).get(section), Mapping) for section in SECTIONS):
        raise WeightsError(f"{path}: not the configuration of a run of fit, which has {' and '.join(SECTIONS)}")
    return path, config


def _plain(config: object) -> dict[str, Any]:
    """Convert a config to plain containers, without resolving its references to other settings."""
    return dict(OmegaConf.to_container(config, resolve=False))  # type: ignore[arg-type]


def _changed(config: Any, overrides: list[str]) -> Any:
    try:
        changes = OmegaConf.from_dotlist(overrides)
        if others := [str(key) for key in changes if key not in SECTIONS]:
            raise CompleteSplatError(f"{others[0]}: no setting of a run's model or data, which overrides= changes")
        changed: Any = OmegaConf.merge(config, changes)
    except (OmegaConfBaseException, YAMLError, ValueError) as error:
        raise CompleteSplatError(f"overrides={overrides}: cannot be applied: {first_line(error)}") from error
    for section in SECTIONS:
        check_value(section, Mapping[str, object], changed[section])
    if overrides:
        check_parts(changed)
        check_image_size(changed)
        check_optimizer(changed.model.get("optimizer"))
    return changed


def without_training(config: Any) -> Any:
    """Remove from a config what only training needs: other weights (`ONLY_FOR_TRAINING`), and a GPU.

    `rasterizer=cuda` becomes `auto`, which is the same where there is a GPU.
    """
    for key in ONLY_FOR_TRAINING:
        parent, _, name = key.rpartition(".")
        if name in list(OmegaConf.select(config, parent) or ()):  # also where its value is missing
            OmegaConf.update(config, key, None)
    if OmegaConf.select(config, "model.rasterizer._target_") == "completesplat.rasterizers.selection.cuda":
        OmegaConf.update(config, "model.rasterizer._target_", "completesplat.rasterizers.selection.auto")
    return config


def check_names(config: object, source: Path, run: Path, trust: bool) -> None:
    """Refuse a config from the file `source` that names anything but parts of models and data.

    A config may name what `conf/` names for models and data, and optimizers of torch. If the run is trusted or belongs
    to the user, the config may also name the user's modules, such as those in the working folder.

    Args:
        run: the run's folder, with links resolved. It belongs to the user who owns it and `source`, if it lies below
            the working folder.

    Raises:
        WeightsError: the config names something else.
    """
    for name, value in _strings(config):
        # `fit` writes resolved values. References are refused because a resolver can read the environment and more.
        if "${" in value:
            refusal = f"{source}: {printable(value, SHORT)} refers to something else"
            raise WeightsError(f"{refusal}, which a run's configuration does not")
        if name != "_target_" or value in _known_names() or OPTIMIZER.fullmatch(value):
            continue
        refusal = f"{source} names {printable(value, SHORT)}, which is no part of models or data in this package"
        if not trust and not _belongs_to_user(source, run):
            raise WeightsError(f"{refusal}; if it is a module of your own, and you trust who made the run: trust=true")
        if not _is_users_module(value):
            raise WeightsError(f"{refusal}, and not defined in a module of your own (SECURITY.md)")


@cache
def _known_names() -> set[str]:
    """Return the names of all parts of models and data in `conf/`."""
    files = [file for group in GROUPS for file in (conf_folder() / group).glob("*.yaml")]
    return {name for file in files for name in TARGET.findall(file.read_text())}


def _strings(config: object, name: object = "") -> Iterator[tuple[object, str]]:
    """Yield all keys and values as text, each with the name of the setting that it belongs to."""
    if isinstance(config, Mapping):
        for key, value in config.items():
            yield name, str(key)
            yield from _strings(value, key)
    elif isinstance(config, list):
        for value in config:
            yield from _strings(value, name)
    else:
        yield name, str(config)


def _belongs_to_user(file: Path, run: Path) -> bool:
    """Whether the user owns a run below the working folder, and has therefore made it or brought it there.

    The working folder itself must not be the run's, because modules that came with it would pass as the user's.
    """
    return Path.cwd() in run.parents and {run.stat().st_uid, file.stat().st_uid} == {os.getuid()}


def _is_users_module(target: str) -> bool:
    """Whether the module that defines the target is neither part of this package nor installed with Python."""
    top = target.partition(".")[0]
    try:
        spec = find_spec(top)  # imports nothing, because the name has no dot
    except (ImportError, ValueError):
        return False
    if spec is None or top == "completesplat":
        return False
    places = [spec.origin] if spec.has_location else spec.submodule_search_locations or []
    if not places or any(_is_installed(Path(str(place)).resolve()) for place in places):
        return False
    try:
        part = get_object(target)
    except (ImportError, ValueError) as error:
        raise WeightsError(f"{target}: cannot be imported ({error})") from error
    # A user's module also holds what it imports from others, which may not be named.
    return str(getattr(part, "__module__", None)).partition(".")[0] == top


def _is_installed(path: Path) -> bool:
    libraries = {Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    return not {"site-packages", "dist-packages"}.isdisjoint(path.parts) or not libraries.isdisjoint(path.parents)
