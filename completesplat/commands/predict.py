"""`completesplat predict`: one photograph to complete scenes."""

from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError


def run(config: Any, out: Path) -> None:
    """Write the samples' files into `out/<name of the photograph>/`."""
    check_settings(config)
    from hydra.utils import instantiate
    from omegaconf import OmegaConf

    from completesplat.autoreconstructor.skips import allowed_skip_weight
    from completesplat.export.prediction import write_prediction
    from completesplat.generation import CompleteSplat

    image = Path(config.image)
    model = CompleteSplat.from_pretrained(config.weights)
    if config.get("sampler") is not None:
        sampler: Any = OmegaConf.to_container(config.sampler)
        model.replace_sampler(sampler)
    photograph = model.read(image, config.fov)
    visible = visible_part(config, model.image_size)
    settings = {name: config[name] for name in ("samples", "guidance_weight", "seed")}
    settings["skip_weight"] = allowed_skip_weight(config.skip_weight, visible)
    settings["steps"] = model.sampler.steps if config.steps is None else config.steps
    scenes = model(photograph, visible, batch=config.batch, **settings)
    write_prediction(
        out / image.stem,
        photograph.image if visible is None else photograph.image * visible,
        scenes,
        model.camera(photograph),
        instantiate(config.rasterizer, _convert_="all"),
        up=model.up,
        frames=config.frames,
        background=config.background,
        settings={
            **settings,
            "sampler": model.architecture["sampler"]["scheduler"]["_target_"].rpartition(".")[2],
            "image": image.name,
            "mask": None if config.mask is None else Path(config.mask).name,
            "box": None if config.box is None else list(config.box),
            "fov_degrees": photograph.fov_degrees,
            "fov_source": photograph.fov_source,
            "depth_range": model.depth_range.tolist(),
        },
        maps=config.maps,
    )


def visible_part(config: Any, size: int) -> Any:
    """[1 size size], 0 where `mask` or `box` hide the photograph; None without them.

    Raises:
        ImageError: the mask is not a readable picture.
        CompleteSplatError: mask and box at once, a box that is none, or a mask that hides nothing.
    """
    from completesplat.data.masking import outside_of_box, outside_of_mask

    if config.mask is not None and config.box is not None:
        raise CompleteSplatError("give mask=FILE or box=[x0,y0,x1,y1], not both")
    if config.mask is not None:
        return outside_of_mask(Path(config.image), Path(config.mask), size)
    if config.box is None:
        return None
    if isinstance(config.box, str | int | float) or not all(isinstance(edge, int | float) for edge in config.box):
        raise CompleteSplatError(f"box={config.box}: give [x0,y0,x1,y1]")
    return outside_of_box(Path(config.image), list(config.box), size)


def check_settings(config: Any) -> None:
    """Refuse settings without a meaning.

    Raises:
        CompleteSplatError: names the setting and its range.
    """
    for name in ("skip_weight", "guidance_weight", "background"):
        if config[name] is not None and not 0 <= config[name] <= 1:
            raise CompleteSplatError(f"{name}={config[name]}: must lie between 0 and 1")
    for name in ("samples", "frames", "batch"):
        if config[name] is not None and config[name] < 1:
            raise CompleteSplatError(f"{name}={config[name]}: must be at least 1")
    if config.steps is not None and not 1 <= config.steps <= 1000:
        raise CompleteSplatError(f"steps={config.steps}: must lie between 1 and 1000")
