"""`completesplat predict`: complete scenes, each from one photo, or one scene from several photos."""

import logging
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from jaxtyping import Float
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from torch import Tensor

from completesplat.commands.trained import open_generator
from completesplat.data.images.photograph import Photograph, outside_of_box, outside_of_mask
from completesplat.diffusion.guidance import allowed_skip_weight
from completesplat.errors import CompleteSplatError, DiskError
from completesplat.export.formats import CONVERTED, FORMATS
from completesplat.export.prediction import Wanted, write_prediction
from completesplat.export.splat_transform import find_splat_transform
from completesplat.files import folder_names, printable, safe_name
from completesplat.generator import CompleteSplat
from completesplat.geometry.trajectories import PATHS
from completesplat.rasterizers import Rasterizer
from completesplat.scene_model import SceneModel
from completesplat.settings.checks import REMOVE

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".avif", ".jp2", ".bmp", ".gif", ".ppm", ".pgm", ".pnm")
FAR = 1.5
"""Ratio of tan(fov / 2), photo to training, from which a warning is given."""
UNLIKE = 2.0
"""Distance from the training images (`SceneModel.distance`) from which a warning is given."""

log = logging.getLogger(__name__)


def run(config: Any, out: Path) -> None:
    """Write each photo's files into `out/<its name>/`."""
    pictures = find_pictures(config.image)
    if config.mask is not None and len(pictures) > 1:
        raise CompleteSplatError("mask=FILE belongs to one picture; box=[x0,y0,x1,y1] goes for several")
    wanted = wanted_files(config)  # before the model runs, because the converter may be missing
    if config.cameras is not None:
        predict_from_views(config, pictures, wanted, out)
    else:
        predict_pictures(config, open_generator(config), pictures, wanted, out)


def find_pictures(image: Any) -> list[Path]:
    """Return the files of `image=FILE`, `image=FOLDER` or a list of both; of a folder its images, by suffix, sorted.

    Files that are named one by one are not checked here, even missing ones, because reading them reports the fault.

    Raises:
        CompleteSplatError: a folder has no image or cannot be read, the list is empty, or an entry is no name.
    """
    entries = image if isinstance(image, Sequence) and not isinstance(image, str) else [image]
    if not entries:
        raise CompleteSplatError("image=[]: name at least one picture")
    paths: list[Path] = []
    for entry in entries:
        if entry == "" or isinstance(entry, bool) or not isinstance(entry, str | int):
            raise CompleteSplatError(f"image={image}: give a picture, a folder, or a list of them")
        paths += _pictures_of(Path(str(entry)))
    return paths


def _pictures_of(path: Path) -> list[Path]:
    # `os.path`, because the methods of `Path` raise an error if a name is too long.
    if not os.path.isdir(path):
        return [path]
    try:
        images = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    except OSError as error:
        raise CompleteSplatError(f"{path}: {error.strerror}") from error
    pictures = [file for file in images if os.path.isfile(file)]
    if left_out := [printable(file.name) for file in images if not os.path.isfile(file)]:
        log.warning("%s: left out, because they are no files: %s", printable(str(path)), ", ".join(left_out))
    if not pictures:
        raise CompleteSplatError(f"{path}: no picture in this folder ({', '.join(SUFFIXES)})")
    return pictures


def wanted_files(config: Any) -> Wanted:
    """Return the outputs to write for each image.

    Raises:
        CompleteSplatError: no such format or camera path, no format at all, or no converter for one that needs it.
    """
    formats = _chosen("formats", config.formats, FORMATS)
    if not formats:
        raise CompleteSplatError(f"formats=[]: choose from {', '.join(FORMATS)}")
    return Wanted(
        formats=formats,
        videos=_chosen("video", config.video, tuple(PATHS)),
        frames=config.frames,
        background=Wanted.background if config.background == REMOVE else config.background,
        maps=config.maps,
        screen_space_dilation=config.screen_space_dilation,
        converter=find_splat_transform() if set(formats) & set(CONVERTED) else None,
    )


def _chosen(name: str, value: Any, choice: Sequence[str]) -> tuple[str, ...]:
    """Return one name, or the names of a list without duplicates; refuse those that are not in `choice`."""
    several = not value or (isinstance(value, Sequence) and not isinstance(value, str))
    names = list(value or []) if several else [value]
    for entry in names:
        if entry not in choice:
            raise CompleteSplatError(f"{name}={entry}: choose from {', '.join(choice)}")
    return tuple(dict.fromkeys(names))


def predict_pictures(config: Any, model: SceneModel, pictures: Sequence[Path], wanted: Wanted, out: Path) -> None:
    """Write each image's files into a folder below `out`, with a progress bar, or a line per image without a terminal.

    Raises:
        CompleteSplatError: the only image failed, or some of several, which the message names; the others are written.
        DiskError: the disk is full; the remaining images are not predicted.
    """
    console, failed = Console(), []
    if (config.mask is not None or config.box is not None) and not model.knows_hidden:
        log.warning(
            "%s: these weights were not trained with parts of the picture hidden (data.box_masks, conf/experiment/"
            "*_masked.yaml): what is hidden may come out black or grey",
            "mask" if config.mask is not None else "box",
        )
    rasterizer = instantiate(config.rasterizer, _convert_="all")
    folders = folder_names(picture.stem for picture in pictures)
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=len(pictures) * config.samples)
        for index, (picture, folder) in enumerate(zip(pictures, folders, strict=True)):
            name = printable(picture.name)
            bar.update(task, description=escape(name), completed=index * config.samples)
            start = time.perf_counter()
            try:
                _predict(config, model, rasterizer, wanted, picture, out / folder, lambda: bar.advance(task))
            except DiskError:  # the other images would fail, too
                raise
            except Exception as error:
                message, expected = _told(error, picture), isinstance(error, CompleteSplatError | OSError)
                if len(pictures) == 1 and expected:
                    raise CompleteSplatError(message) from error
                if len(pictures) == 1:
                    raise
                if not expected:
                    log.error("a fault of the program, not of the picture", exc_info=error)
                failed.append(name)
                print(f"error: {message}", file=sys.stderr, flush=True)
                continue
            if not console.is_terminal:
                took = f"{time.perf_counter() - start:.0f} s"
                print(f"{index + 1}/{len(pictures)} {name}: {out / folder} ({took})", flush=True)
    if failed:
        share = f"{len(failed)} of {len(pictures)} pictures failed ({', '.join(failed)})"
        raise CompleteSplatError(f"{share}; the others are in {out}" if len(failed) < len(pictures) else share)


def _told(error: Exception, picture: Path) -> str:
    """Return the error of an image in one line that names the image."""
    message = " ".join(str(error).split()) or type(error).__name__
    return printable(message if picture.name in message else f"{picture}: {message}")


def predict_from_views(config: Any, pictures: Sequence[Path], wanted: Wanted, out: Path) -> None:
    """Write the files of one scene that all images show, into a folder with the name of the first image.

    Raises:
        CompleteSplatError: one image alone, or a mask, box, field of view or removed background besides the cameras.
        DataError, WeightsError: as `read_photographs`, `CompleteSplat.reconstruct`.
    """
    from completesplat.data.captures.transforms_json import read_photographs

    if len(pictures) < 2:
        raise CompleteSplatError("cameras=FILE goes with two pictures or more: image=[A,B]")
    beside = [name for name in ("mask", "box", "fov") if config[name] is not None]
    beside += ["background=remove"] if config.background == REMOVE else []
    if beside:
        raise CompleteSplatError(f"{beside[0]} does not go with cameras=FILE")
    model = open_generator(config)
    views = read_photographs(pictures, Path(config.cameras), model.image_size)
    views = replace(views, cameras=model.in_model_units(views.cameras))
    scene = model.reconstruct(views)
    recorded = {
        "seed": config.seed,
        "image": printable(pictures[0].name),
        "images": [printable(picture.name) for picture in pictures],
        "cameras": printable(Path(config.cameras).name),
        "screen_space_dilation": config.screen_space_dilation,
        "depth_range": model.depth_range.tolist(),
    }
    rasterizer, folder = instantiate(config.rasterizer, _convert_="all"), out / safe_name(pictures[0].stem)
    write_prediction(folder, views.images[0], [scene], views.cameras[0], rasterizer, model.up, wanted, recorded)
    print(f"one scene of {len(pictures)} pictures, at the posterior's mean: {folder}")


def _predict(
    config: Any,
    model: SceneModel,
    rasterizer: Rasterizer,
    wanted: Wanted,
    image: Path,
    folder: Path,
    on_sample: Callable[[], None],
) -> None:
    photograph = model.read(image, config.fov, config.background == REMOVE)
    visible = visible_part(config, image, model.image_size)
    if warnings := remarks(photograph, model, whole=visible is None):
        log.warning("%s: %s", printable(image.name), "; ".join(warnings))
    settings = {name: config[name] for name in ("samples", "seed")}
    how = {}
    if isinstance(model, CompleteSplat):
        settings["guidance_weight"] = config.guidance_weight
        settings["skip_weight"] = allowed_skip_weight(config.skip_weight, visible)
        settings["steps"] = model.sampler.steps if config.steps is None else config.steps
        how = {"sampler": model.architecture["sampler"]["scheduler"]["_target_"].rpartition(".")[2]}
    scenes = model(photograph, visible, batch=config.batch, **settings)
    recorded = {
        **settings,
        **how,
        "image": printable(image.name),
        "screen_space_dilation": config.screen_space_dilation,
        "mask": None if config.mask is None else printable(Path(config.mask).name),
        "box": None if config.box is None else list(config.box),
        "fov_degrees": photograph.fov_degrees,
        "fov_source": photograph.fov_source,
        "depth_range": model.depth_range_of(photograph).tolist(),
    }
    if config.background == REMOVE:
        recorded["background"] = REMOVE
    visible_image = photograph.image if visible is None else photograph.image * visible
    camera = model.camera(photograph)
    write_prediction(folder, visible_image, scenes, camera, rasterizer, model.up, wanted, recorded, on_sample)


def remarks(photograph: Photograph, model: SceneModel, whole: bool) -> list[str]:
    """Return warnings about a photo that is unlike the training images; its contents are compared only if `whole`."""
    warnings = [unusual_field_of_view(photograph, model.fov_degrees.item())]
    distance = model.distance(photograph) if whole else None
    if distance is not None and distance > UNLIKE:
        warnings.append(
            f"colours, contrast or detail lie {distance:.1f} standard deviations from the training pictures'"
            f" ({UNLIKE:g} is far): expect little of it in the scenes"
        )
    return [remark for remark in warnings if remark]


def unusual_field_of_view(photograph: Photograph, trained_degrees: float) -> str | None:
    """Return a warning if the field of view is far from that in training: tan(fov / 2) differs by 1.5 times or more.

    The networks see pixels, not angles, and put them at the depths that they have learnt. Lengths across the image
    grow with the tangent, lengths along the depth do not; so the proportions are wrong by the ratio of the tangents.
    """
    tangent, trained_tangent = (math.tan(math.radians(fov) / 2) for fov in (photograph.fov_degrees, trained_degrees))
    ratio = tangent / trained_tangent
    if 1 / FAR < ratio < FAR:
        return None
    wrong = f"{ratio:.1f} times too flat" if ratio > 1 else f"{1 / ratio:.1f} times too deep"
    source = "given" if photograph.fov_source == "given" else "from EXIF; fov=DEGREES overrides it"
    return (
        f"the field of view is {photograph.fov_degrees:.0f} degrees ({source}), {trained_degrees:.0f} in training:"
        f" expect shapes about {wrong}"
    )


def visible_part(config: Any, image: Path, size: int) -> Float[Tensor, "1 size size"] | None:
    """Return 0 where `mask` or `box` hides the photo and 1 elsewhere; None without them.

    Raises:
        ImageError: the mask is not a readable image.
        CompleteSplatError: mask and box at once, a box without four numbers, or a mask that hides nothing.
    """
    if config.mask is not None and config.box is not None:
        raise CompleteSplatError("give mask=FILE or box=[x0,y0,x1,y1], not both")
    if config.mask is not None:
        return outside_of_mask(image, Path(config.mask), size)
    if config.box is None:
        return None
    if isinstance(config.box, str | int | float) or not all(isinstance(edge, int | float) for edge in config.box):
        raise CompleteSplatError(f"box={config.box}: give [x0,y0,x1,y1]")
    return outside_of_box(image, list(config.box), size)
