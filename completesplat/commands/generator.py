"""What `predict` and `view` share: opening the generator, and refusing settings without a meaning."""

from collections.abc import Mapping
from typing import Any

from completesplat.autoreconstructor.skips import allowed_skip_weight
from completesplat.diffusion.guidance import check_guidance_weight
from completesplat.errors import CompleteSplatError
from completesplat.generation import CompleteSplat
from completesplat.weights import in_the_box


def open_generator(config: Any) -> CompleteSplat:
    """The generator of `weights`, with the sampler of the configuration if it names one.

    Prints a line if the weights are the package's own.

    Raises:
        WeightsError: no weights, or not readable.
    """
    from omegaconf import OmegaConf

    if config.weights in in_the_box():
        print(f"weights: {config.weights}, which come with the package: they know procedural scenes, not photographs")
    model = CompleteSplat.from_pretrained(config.weights)
    if config.get("sampler") is not None:
        sampler: Any = OmegaConf.to_container(config.sampler)
        model.replace_sampler(sampler)
    return model


def check_settings(config: Any, ranges: Mapping[str, tuple[float, float | None]]) -> None:
    """Refuse weights of skips and guidance, and other numbers, outside of their ranges.

    Args:
        ranges: smallest and largest value by the name of the setting, None for no largest one. A setting may be null.

    Raises:
        CompleteSplatError: names the setting and its range.
    """
    allowed_skip_weight(config.skip_weight)
    check_guidance_weight(config.guidance_weight)
    for name, (least, most) in ranges.items():
        value = config[name]
        if value is None or (least <= value and (most is None or value <= most)):
            continue
        allowed = f"be at least {least}" if most is None else f"lie between {least} and {most}"
        raise CompleteSplatError(f"{name}={value}: must {allowed}")
