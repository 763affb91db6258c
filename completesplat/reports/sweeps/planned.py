"""The jobs that a sweep means to run, from the command that started it."""

from itertools import product
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from omegaconf import OmegaConf


def planned(folder: Path) -> list[list[str]]:
    """The overrides of all jobs by number, of which hydra's sweeper makes the product.

    They come from the `multirun.yaml` that hydra leaves in the folder when a sweep starts. Empty where there is none,
    or where it takes more than that file to know the jobs: `glob(...)` depends on the files of the configuration.
    """
    path = folder / "multirun.yaml"
    if not path.is_file():
        return []
    given = OmegaConf.to_container(OmegaConf.load(path).hydra.overrides.task)
    assert isinstance(given, list)
    overrides = OverridesParser.create().parse_overrides(given)
    if any(o.is_sweep_override() and o.value_type == ValueType.GLOB_CHOICE_SWEEP for o in overrides):
        return []
    choices = {override.get_key_element(): _choices(override) for override in overrides}
    return [list(job) for job in product(*choices.values())]


def _choices(override: Override) -> list[str]:
    key = override.get_key_element()
    if override.is_discrete_sweep():
        return [f"{key}={value}" for value in override.sweep_string_iterator()]
    return [f"{key}={override.get_value_element_as_str()}"]
