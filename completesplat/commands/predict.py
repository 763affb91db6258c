"""`completesplat predict`: photographs to complete scenes."""

from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError


def run(config: Any, out: Path) -> None:
    """Write each photograph's files into `out/<its name>/`.

    Raises:
        CompleteSplatError: settings without a meaning, or at least one picture of which nothing could be made.
    """
    from completesplat.commands.pictures import find_pictures
    from completesplat.commands.predict_pictures import predict_pictures
    from completesplat.commands.predict_settings import check_settings, wanted_files

    check_settings(config)
    pictures = find_pictures(config.image)
    if config.mask is not None and len(pictures) > 1:
        raise CompleteSplatError("mask=FILE belongs to one picture; box=[x0,y0,x1,y1] goes for several")
    wanted = wanted_files(config)  # before the model runs: is the converter there?
    predict_pictures(config, _model(config), pictures, wanted, out)


def _model(config: Any) -> Any:
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
