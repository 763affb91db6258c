"""`completesplat predict`: one photograph to complete scenes."""

from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError


def run(config: Any, out: Path) -> None:
    """Write the samples' files into `out/<name of the photograph>/`."""
    check_settings(config)
    from hydra.utils import instantiate

    from completesplat.export.prediction import write_prediction
    from completesplat.generation import CompleteSplat

    image = Path(config.image)
    model = CompleteSplat.from_pretrained(config.weights)
    photograph = model.read(image, config.fov)
    settings = {name: config[name] for name in ("samples", "skip_weight", "guidance_weight", "steps", "seed")}
    scenes = model(photograph, **settings)
    write_prediction(
        out / image.stem,
        photograph.image,
        scenes,
        model.camera(photograph),
        instantiate(config.rasterizer, _convert_="all"),
        up=model.up,
        frames=config.frames,
        background=config.background,
        settings={
            **settings,
            "image": image.name,
            "fov_degrees": photograph.fov_degrees,
            "fov_source": photograph.fov_source,
            "depth_range": model.depth_range.tolist(),
        },
    )


def check_settings(config: Any) -> None:
    """Refuse settings without a meaning.

    Raises:
        CompleteSplatError: names the setting and its range.
    """
    for name in ("skip_weight", "guidance_weight", "background"):
        if not 0 <= config[name] <= 1:
            raise CompleteSplatError(f"{name}={config[name]}: must lie between 0 and 1")
    for name in ("samples", "frames"):
        if config[name] < 1:
            raise CompleteSplatError(f"{name}={config[name]}: must be at least 1")
    if config.steps is not None and not 1 <= config.steps <= 1000:
        raise CompleteSplatError(f"steps={config.steps}: must lie between 1 and 1000")
