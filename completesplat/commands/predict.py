"""`completesplat predict`: complete scenes, each from one photo, or one scene from several photos."""

import logging
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numba.np.arraymath  # else the first kernel imports it, and scipy with it  # noqa: F401
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from completesplat.commands.inputs import find_images, left_out
from completesplat.commands.predict_views import object_mask, predict_from_views
from completesplat.commands.trained import open_generator, shown_background
from completesplat.data.sequences import first_names
from completesplat.data.validation.processes import map_in_processes, share_of
from completesplat.diffusion.guidance import allowed_skip_weight
from completesplat.errors import CompleteSplatError, DiskError
from completesplat.export.description import finished_digest, made_from
from completesplat.export.formats import CONVERTED, FORMATS
from completesplat.export.placed_scene import PlacedScene
from completesplat.export.prediction import SHEET_FILE, write_prediction
from completesplat.export.progress import PhotoProgress
from completesplat.export.scene_files import OutputFiles
from completesplat.export.splat_transform import find_splat_transform
from completesplat.gaussians import Gaussians
from completesplat.generator import CompleteSplat
from completesplat.photo.reading import Photograph
from completesplat.photo.warnings import hidden_parts_warning
from completesplat.rasterizers import Rasterizer
from completesplat.scene_model import SceneModel
from completesplat.settings.checks import REMOVE
from completesplat.settings.composition import has_bfloat16
from completesplat.weights import sha256_of
from completesplat.wording import counted, folder_names, printable, safe_name

logger = logging.getLogger(__name__)

OF_RUNS = ("image", "out", "shard", "shards", "devices")  # settings on which no single prediction depends
sha256_of_weights = cache(sha256_of)  # a process has one model, of up to gigabytes


def run(config: DictConfig, out: Path) -> str:
    """Write the files of each photo in this shard into `out/<its name>/`, by `devices` processes.

    Returns:
        The line that says which file to look at first.

    Raises:
        CompleteSplatError: the only image failed, or some of several, which the message names; the others are written.
        DiskError: the disk is full; the remaining images are not predicted.
    """
    outputs = output_files(config)
    images = find_images(config.image)
    others = left_out(config.image, images)
    if others:
        logger.warning("left out: %s: %s", counted(len(others), "other file"), first_names(others))
    if config.mask is not None and len(images) > 1:
        raise CompleteSplatError("mask=FILE belongs to one image; box=[x0,y0,x1,y1] goes for several")
    shard = share_of(images, config.shard, config.shards)
    if config.cameras is not None:
        predict_from_views(config, images, outputs, out)
        return sheet_line(out, images[:1])
    if config.elevation != 0:
        raise CompleteSplatError("elevation goes with cameras=[ANGLES] only: leave it out")
    start = time.perf_counter()
    if config.devices == 1:
        results = [predict_share(config, images, outputs, out, 0)]
    else:
        share = partial(predict_on_device, config, images, outputs, out, torch.get_num_threads() // config.devices)
        results = list(map_in_processes(share, range(config.devices), config.devices))
    seconds = time.perf_counter() - start
    count = sum(count for count, _ in results)
    failed = [name for _, names in results for name in names]
    if count > 1:
        print(f"{count} photos in {seconds:.0f} s, {60 * count / seconds:.1f} a minute (devices={config.devices})")
    if failed:
        text = f"{len(failed)} of {count + len(failed)} images failed ({', '.join(failed)})"
        raise CompleteSplatError(f"{text}; the others are in {out}" if count else text)
    return sheet_line(out, shard)


def sheet_line(out: Path, images: Sequence[Path]) -> str:
    """Return the line that says where the sheets of one or more images are."""
    name = safe_name(images[0].stem) if len(images) == 1 else "*"
    return f"look at {out / name / SHEET_FILE}"


def predict_on_device(
    config: DictConfig, images: Sequence[Path], outputs: OutputFiles, out: Path, threads: int, process: int
) -> tuple[int, list[str]]:
    """Predict the share of one of several processes, on its GPU or on its part of the cores."""
    torch.set_num_threads(max(1, threads))
    if torch.cuda.is_available():
        torch.cuda.set_device(process % torch.cuda.device_count())
    return predict_share(config, images, outputs, out, process)


def predict_share(
    config: DictConfig, images: Sequence[Path], outputs: OutputFiles, out: Path, process: int
) -> tuple[int, list[str]]:
    """Predict every N-th image, from this process' first on, unless it is finished. N processes do all.

    Returns:
        The number of images that were predicted, and the names of those that failed.
    """
    folders = [out / name for name in folder_names([image.stem for image in images])]
    pairs = list(zip(images, folders, strict=True))
    photos = share_of(pairs, config.shard + config.shards * process, config.shards * config.devices)
    if not photos:
        return 0, []
    model = open_generator(config, images, announced=process == 0)
    waiting = [(image, folder) for image, folder in photos if not is_predicted(config, model, image, folder)]
    if len(waiting) < len(photos):
        before = f"{len(photos) - len(waiting)} of {len(photos)} images: predicted before by the same settings"
        print(f"{before}; to repeat one, remove its folder", flush=True)
    return predict_images(config, model, waiting, outputs)


def predict_images(
    config: DictConfig, model: SceneModel, photos: Sequence[tuple[Path, Path]], outputs: OutputFiles
) -> tuple[int, list[str]]:
    """Write images' files into their folders, with a progress bar, or lines without a terminal or by several processes.

    Returns:
        The number of images that were predicted, and the names of those that failed.

    Raises:
        CompleteSplatError: the only image failed.
        DiskError: the disk is full; the remaining images are not predicted.
    """
    warning = hidden_parts_warning(model.framing.training or {}, config.mask, config.box)
    if warning is not None:
        logger.warning(warning)
    rasterizer = instantiate(config.rasterizer, _convert_="all")
    outputs = replace(outputs, background=shown_background(config.background, model))
    steps = 1 + config.samples * (len(outputs.formats) + len(outputs.videos))
    progress = PhotoProgress(len(photos), steps, bar=config.devices == 1)
    is_only = len(photos) == 1 == config.devices
    failed = []
    with progress.bar:
        for number, (image, folder) in enumerate(photos, 1):
            name = printable(image.name)
            start = time.perf_counter()
            progress.begin_photo(name)
            try:
                predict_photo(config, model, image, folder, outputs, rasterizer, progress.begin)
            except DiskError:  # the other images would fail, too
                raise
            except Exception as error:
                report_failure(error, image, is_only)
                failed.append(name)
                progress.end_photo(number, None)
            else:
                seconds = time.perf_counter() - start
                progress.end_photo(number, f"{number}/{len(photos)} {name}: {folder.name}/ ({seconds:.0f} s)")
    return len(photos) - len(failed), failed


def predict_photo(
    config: DictConfig,
    model: SceneModel,
    image: Path,
    folder: Path,
    outputs: OutputFiles,
    rasterizer: Rasterizer,
    begin: Callable[..., None],
) -> None:
    """Read one photo, generate its scenes and write their files. `begin` is called with the name of each step."""
    remove = config.background == REMOVE
    if remove:
        begin("removing the background", advance=0)
    photograph = model.read(image, config.fov, remove, config.mask, config.box, config.crop)
    settings = generation_settings(config, model, photograph)
    begin(f"drawing {config.samples} sample{'s' if config.samples > 1 else ''}", advance=0)
    size = model.front_size(photograph, config.detail)

    def on_fit(sample: int) -> None:
        begin(f"fitting the front of sample {sample} at {size} px", advance=0)

    scenes = model(photograph, batch=config.batch, on_fit=on_fit, **settings)
    samples = placed_samples(scenes, model, photograph, size)
    recorded = {**settings, **facts_of_photo(config, model, image, photograph)}
    write_prediction(folder, photograph.shown_at(size), samples, rasterizer, outputs, recorded, begin)


def generation_settings(config: DictConfig, model: SceneModel, photograph: Photograph) -> dict[str, Any]:
    """Return the settings of generating a photo's scenes, with those that the user leaves to the model."""
    settings = {
        "samples": config.samples,
        "seed": config.seed,
        "color_fits": config.color_fits,
        "detail": config.detail,
    }
    if isinstance(model, CompleteSplat):
        settings["guidance_weight"] = config.guidance_weight
        settings["skip_weight"] = allowed_skip_weight(config.skip_weight, photograph.visible)
        settings["steps"] = model.sampler.steps if config.steps is None else config.steps
        settings["bfloat16"] = has_bfloat16(model.up.device.type)
    return settings


def placed_samples(
    scenes: Sequence[Gaussians], model: SceneModel, photograph: Photograph, size: int
) -> list[PlacedScene]:
    """Return a photo's scenes with its camera, whose images have this size, on the CPU."""
    camera = model.camera(photograph, size).to("cpu")
    mask = object_mask(photograph, model.background)
    depth = None
    if model.background is not None:  # images of objects, whose centre is in the middle of the depth range
        depth = model.middle_depth(model.depth_range_of(photograph))
    own = photograph.own_at(model.image_size)
    return [PlacedScene(scene.to("cpu"), camera, model.up.cpu(), None, mask, own, depth) for scene in scenes]


def facts_of_photo(config: DictConfig, model: SceneModel, image: Path, photograph: Photograph) -> dict[str, Any]:
    """Return what `scene.json` records of a photo and the weights, beside the settings of generation."""
    facts: dict[str, Any] = {}
    if isinstance(model, CompleteSplat):
        facts["sampler"] = model.architecture["sampler"]["scheduler"]["_target_"].rpartition(".")[2]
    facts["made_from"] = digest_of(config, model, image)
    facts["image"] = printable(image.name)
    facts["weights"] = printable(Path(config.weights).name)
    facts["screen_space_dilation"] = config.screen_space_dilation
    facts["mask"] = None if config.mask is None else printable(Path(config.mask).name)
    facts["box"] = None if config.box is None else list(config.box)
    facts["crop"] = config.crop if isinstance(config.crop, str) else list(config.crop)
    facts["photo_part"] = list(photograph.part)
    facts["fov_degrees"] = photograph.fov_degrees
    facts["fov_source"] = photograph.fov_source
    facts["depth_range"] = model.depth_range_of(photograph).tolist()
    if config.background == REMOVE:
        facts["background"] = REMOVE
    return facts


def is_predicted(config: DictConfig, model: SceneModel, image: Path, folder: Path) -> bool:
    """Return whether a folder has all files of this image's prediction by the same settings and weights."""
    digest = finished_digest(folder)
    return digest is not None and os.access(image, os.R_OK) and digest == digest_of(config, model, image)


def digest_of(config: DictConfig, model: SceneModel, image: Path) -> str:
    """Return a digest of what a photo's prediction depends on (`made_from`)."""
    settings = {str(key): value for key, value in config.items() if key not in OF_RUNS}
    files = [image] if config.mask is None else [image, Path(config.mask)]
    weights_sum = None if model.file is None else sha256_of_weights(Path(model.file))
    return made_from(settings, files, weights_sum)


def report_failure(error: Exception, image: Path, is_only: bool) -> None:
    """Print the error of one of several images, or raise that of the only one."""
    is_fault = not isinstance(error, CompleteSplatError | OSError)
    if is_only and is_fault:
        raise error
    message = " ".join(str(error).split()) or type(error).__name__
    message = printable(message if image.name in message else f"{image}: {message}")
    if is_only:
        raise CompleteSplatError(message) from error
    if is_fault:
        logger.error("a fault of the program, not of the image", exc_info=error)
    print(f"error: {message}", file=sys.stderr, flush=True)


def output_files(config: DictConfig) -> OutputFiles:
    """Return the selected files for each image.

    Raises:
        CompleteSplatError: nothing is selected, or a program is missing.
    """
    formats = _names(config.formats)
    videos = _names(config.video)
    if not formats and not videos:
        raise CompleteSplatError(f"formats=[] video=[]: choose a format ({', '.join(FORMATS)}) or a video")
    outputs = OutputFiles(
        formats,
        videos,
        frames=config.frames,
        maps=config.maps,
        screen_space_dilation=config.screen_space_dilation,
        spz_version=config.spz_version,
    )
    if set(formats) & set(CONVERTED):
        find_splat_transform()  # before the model runs
    return outputs


def _names(value: object) -> tuple[Any, ...]:
    """Return the different names in a setting that is a list, one name, or nothing."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return tuple(dict.fromkeys(value))
    return (value,) if value else ()
