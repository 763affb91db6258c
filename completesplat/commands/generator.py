"""The model that `predict` and `view` draw with."""

from typing import Any


def open_generator(config: Any) -> Any:
    """The generator of `weights`, with the sampler that is wanted; says so if they are the package's own.

    Raises:
        WeightsError: no weights, or not readable.
    """
    from omegaconf import OmegaConf

    from completesplat.generation import CompleteSplat
    from completesplat.weights import in_the_box

    if config.weights in in_the_box():
        print(f"weights: {config.weights}, which come with the package: they know procedural scenes, not photographs")
    model = CompleteSplat.from_pretrained(config.weights)
    if config.get("sampler") is not None:
        sampler: Any = OmegaConf.to_container(config.sampler)
        model.replace_sampler(sampler)
    return model
