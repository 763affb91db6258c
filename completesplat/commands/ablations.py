"""Ablations that change nothing: jobs whose settings are those of the same job without its ablation."""

from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from completesplat.commands.continuing import differences
from completesplat.commands.earlier_stage import take_architecture
from completesplat.evaluation.sweep_summary import PROPOSED
from completesplat.settings.composition import compose

GROUP = "ablation"
CHOICE = f"choices.{GROUP}"
USED = ("seed", "data", "model", "trainer", "callbacks", "evaluation")
"""Sections of a config that determine a training and its test."""


def idle_ablation(config: DictConfig) -> str | None:
    """Return the name of the ablation that Hydra's job has chosen, if the job is the same without it, else None.

    `full`, the method from which nothing is removed, changes nothing by its meaning.
    """
    hydra_config = HydraConfig.get()
    chosen = hydra_config.runtime.choices.get(GROUP)
    overrides = list(hydra_config.overrides.task)
    # A checkpoint's path may name the choice, and then differs with it.
    if chosen in (None, "null", PROPOSED) or any(CHOICE in override for override in overrides):
        return None
    kept = [override for override in overrides if override.lstrip("+").partition("=")[0] != GROUP]
    without = compose("fit", *kept)
    without.out = config.out
    take_architecture(without)
    return None if differences(_used(without), _used(config)) else str(chosen)


def _used(config: DictConfig) -> dict[str, object]:
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    return {name: resolved.get(name) for name in USED}
