"""One picture after the other through the model: what fails is told and does not stop the rest."""

import logging
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from rich.console import Console
from rich.progress import Progress

from completesplat.autoreconstructor.skips import allowed_skip_weight
from completesplat.commands.field_of_view import unusual_field_of_view
from completesplat.commands.pictures import folder_names
from completesplat.commands.predict_settings import visible_part
from completesplat.errors import CompleteSplatError
from completesplat.export.prediction import Wanted, write_prediction
from completesplat.generation import CompleteSplat

log = logging.getLogger(__name__)


def predict_pictures(config: Any, model: CompleteSplat, pictures: Sequence[Path], wanted: Wanted, out: Path) -> None:
    """Write each picture's files into a folder of its own below `out`.

    A bar shows how many samples are done; where nobody watches (no terminal), a line is printed for every picture.

    Raises:
        CompleteSplatError: what is wrong with the only picture, or how many of several failed, and which.
    """
    console, failed = Console(), []
    rasterizer = instantiate(config.rasterizer, _convert_="all")
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=len(pictures) * config.samples)
        for index, (picture, name) in enumerate(zip(pictures, folder_names(pictures), strict=True)):
            bar.update(task, description=picture.name, completed=index * config.samples)
            start = time.perf_counter()
            try:
                _predict(config, model, picture, rasterizer, wanted, out / name, lambda: bar.advance(task))
            except (CompleteSplatError, OSError) as error:
                if len(pictures) == 1:
                    raise CompleteSplatError(_one_line(picture, error)) from error
                failed.append(picture.name)
                print(f"error: {_one_line(picture, error)}", file=sys.stderr, flush=True)
                continue
            if not console.is_terminal:
                seconds = time.perf_counter() - start
                print(f"{index + 1}/{len(pictures)} {picture.name}: {out / name} ({seconds:.0f} s)", flush=True)
    if failed:
        share = f"{len(failed)} of {len(pictures)} pictures failed ({', '.join(failed)})"
        raise CompleteSplatError(f"{share}; the others are in {out}" if len(failed) < len(pictures) else share)


def _predict(
    config: Any,
    model: CompleteSplat,
    image: Path,
    rasterizer: Any,
    wanted: Wanted,
    folder: Path,
    on_sample: Callable[[], None],
) -> None:
    photograph = model.read(image, config.fov)
    warning = unusual_field_of_view(photograph, model.fov_degrees.item())
    if warning is not None:
        log.warning("%s: %s", image.name, warning)
    visible = visible_part(config, image, model.image_size)
    settings = {name: config[name] for name in ("samples", "guidance_weight", "seed")}
    settings["skip_weight"] = allowed_skip_weight(config.skip_weight, visible)
    settings["steps"] = model.sampler.steps if config.steps is None else config.steps
    scenes = model(photograph, visible, batch=config.batch, **settings)
    recorded = {
        **settings,
        "sampler": model.architecture["sampler"]["scheduler"]["_target_"].rpartition(".")[2],
        "image": image.name,
        "widened": config.widen,
        "mask": None if config.mask is None else Path(config.mask).name,
        "box": None if config.box is None else list(config.box),
        "fov_degrees": photograph.fov_degrees,
        "fov_source": photograph.fov_source,
        "depth_range": model.depth_range.tolist(),
    }
    shown = photograph.image if visible is None else photograph.image * visible
    camera = model.camera(photograph)
    write_prediction(folder, shown, scenes, camera, rasterizer, model.up, wanted, recorded, on_sample)


def _one_line(picture: Path, error: Exception) -> str:
    message = " ".join(str(error).split())
    return message if picture.name in message else f"{picture}: {message}"
