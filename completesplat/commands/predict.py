"""`completesplat predict`: complete scenes, each from one photo, or one scene from several photos."""

import json
import logging
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba.np.arraymath  # else the first kernel imports it, and scipy with it  # noqa: F401
import torch
from hydra.utils import instantiate
from jaxtyping import Float
from omegaconf import DictConfig
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, TaskID
from torch import Tensor

from completesplat.commands.inputs import find_images, left_out
from completesplat.commands.trained import open_generator, shown_background
from completesplat.data.images.photograph import Photograph, outside_of_box, outside_of_mask
from completesplat.data.sequences import first_names
from completesplat.data.validation.processes import map_in_processes, share_of
from completesplat.diffusion.guidance import allowed_skip_weight
from completesplat.errors import CompleteSplatError, DiskError
from completesplat.export.formats import CONVERTED, FORMATS
from completesplat.export.prediction import SCENE_FILE, OutputFiles, Shot, write_prediction
from completesplat.export.splat_transform import find_splat_transform
from completesplat.files import counted, folder_names, printable, safe_name
from completesplat.generator import CompleteSplat
from completesplat.rasterizers import Rasterizer
from completesplat.scene_model import SceneModel, distance_to_training, match_shipped
from completesplat.settings.checks import REMOVE
from completesplat.settings.composition import has_bfloat16
from completesplat.version import __version__
from completesplat.weights import sha256_of

logger = logging.getLogger(__name__)

OF_RUNS = ("image", "out", "shard", "shards", "devices")  # settings on which no single prediction depends
FAR = 1.5  # ratio of tan(fov / 2), photo to training, from which a warning is given
UNLIKE = 2.0  # distance from the training images (`distance_to_training`) from which a warning is given
sha256_of_weights = cache(sha256_of)  # a process has one model, of up to gigabytes
RESIZING = 0.1  # change of a distance that resizing to another model's size and back may cause
ELSEWHERE = "for objects weights=splatter_image:objaverse (226 MB), for scenes github.com/apple/ml-sharp"


def run(config: DictConfig, out: Path) -> None:
    """Write the files of each photo in this shard into `out/<its name>/`, by `devices` processes.

    Raises:
        CompleteSplatError: the only image failed, or some of several, which the message names; the others are written.
        DiskError: the disk is full; the remaining images are not predicted.
    """
    wanted = output_files(config)
    images = find_images(config.image)
    if others := left_out(config.image, images):
        logger.warning("left out: %s: %s", counted(len(others), "other file"), first_names(others))
    if config.mask is not None and len(images) > 1:
        raise CompleteSplatError("mask=FILE belongs to one image; box=[x0,y0,x1,y1] goes for several")
    share_of(images, config.shard, config.shards)  # refuses a shard that does not exist
    if config.cameras is not None:
        return predict_from_views(config, images, wanted, out)
    start = time.perf_counter()
    threads = max(1, torch.get_num_threads() // config.devices)
    share = partial(predict_share, config, images, wanted, out, threads)
    results = list(map_in_processes(share, range(config.devices), config.devices))
    count = sum(count for count, _ in results)
    failed = [name for _, names in results for name in names]
    seconds = time.perf_counter() - start
    if count > 1:
        print(f"{count} photos in {seconds:.0f} s, {60 * count / seconds:.1f} a minute (devices={config.devices})")
    if failed:
        text = f"{len(failed)} of {count + len(failed)} images failed ({', '.join(failed)})"
        raise CompleteSplatError(f"{text}; the others are in {out}" if count else text)


def predict_share(
    config: DictConfig, images: Sequence[Path], wanted: OutputFiles, out: Path, threads: int, process: int
) -> tuple[int, list[str]]:
    """Predict every N-th image, from this process' first on, unless it is finished; N processes do all.

    Returns:
        The number of images that were predicted, and the names of those that failed.
    """
    if config.devices > 1:
        torch.set_num_threads(threads)
        if torch.cuda.is_available():
            torch.cuda.set_device(process % torch.cuda.device_count())
    folders = (out / name for name in folder_names(image.stem for image in images))
    pairs = [*zip(images, folders, strict=True)]
    count = config.shards * config.devices
    photos = share_of(pairs, config.shard + config.shards * process, count)
    if not photos:
        return 0, []
    model = open_generator(config, images, announced=process == 0)
    waiting = [(image, folder) for image, folder in photos if not is_predicted(folder, config, model, image)]
    if len(waiting) < len(photos):
        before = f"{len(photos) - len(waiting)} of {len(photos)} images: predicted before by the same settings"
        print(f"{before}; to repeat one, remove its folder", flush=True)
    return predict_images(config, model, waiting, wanted)


def is_predicted(folder: Path, config: DictConfig, model: SceneModel, image: Path) -> bool:
    """Return whether a folder has all files of this image's prediction by the same settings and weights."""
    try:
        made = json.loads((folder / SCENE_FILE).read_text())
        whole = all((folder / name).is_file() for name in made["files"].values())
        return whole and made["settings"]["made_from"] == made_from(config, model, image)
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return False


def made_from(config: DictConfig, model: SceneModel, image: Path) -> str:
    """Return a digest of what a prediction depends on: the version, settings, and contents of all files."""
    settings = {str(key): value for key, value in config.items() if key not in OF_RUNS}
    files = [sha256_of(Path(file)) for file in (image, config.mask) if file is not None]
    weights = None if model.file is None else sha256_of_weights(Path(model.file))
    return sha256(json.dumps([__version__, settings, files, weights], sort_keys=True, default=str).encode()).hexdigest()


def output_files(config: DictConfig) -> OutputFiles:
    """Return the outputs for each image; raise CompleteSplatError for none, or a missing program."""
    formats = _names(config.formats)
    videos = _names(config.video)
    if not formats and not videos:
        raise CompleteSplatError(f"formats=[] video=[]: choose a format ({', '.join(FORMATS)}) or a video")
    settings = {name: config[name] for name in ("frames", "maps", "screen_space_dilation")}
    wanted = OutputFiles(formats, videos, **settings)
    if set(formats) & set(CONVERTED):
        find_splat_transform()  # before the model runs
    return wanted


def _names(value: object) -> tuple[Any, ...]:
    names = value if isinstance(value, Sequence) and not isinstance(value, str) else [value] if value else []
    return tuple(dict.fromkeys(names))


def predict_images(
    config: DictConfig, model: SceneModel, photos: Sequence[tuple[Path, Path]], wanted: OutputFiles
) -> tuple[int, list[str]]:
    """Write images' files into their folders, with a progress bar, or lines without a terminal or by several processes.

    Returns:
        The number of images that were predicted, and the names of those that failed.

    Raises:
        CompleteSplatError: the only image failed.
        DiskError: the disk is full; the remaining images are not predicted.
    """
    console = Console()
    failed = []
    _warn_of_hidden_parts(config, model)
    rasterizer = instantiate(config.rasterizer, _convert_="all")
    wanted = replace(wanted, background=shown_background(config.background, model))
    with Progress(console=console, disable=config.devices > 1 or not console.is_terminal) as bar:
        steps = 1 + config.samples * (len(wanted.formats) + len(wanted.videos))
        task = bar.add_task("", total=len(photos) * steps)
        for index, (image, folder) in enumerate(photos):
            name = printable(image.name)
            start = time.perf_counter()
            begin = partial(_begin, bar, task, name)
            predict = partial(_predict, config, model, rasterizer, wanted, image, folder, begin)
            if not _succeeds(predict, image, is_only=len(photos) == 1 == config.devices):
                failed.append(name)
            elif bar.disable:
                seconds = f"{time.perf_counter() - start:.0f} s"
                print(f"{index + 1}/{len(photos)} {name}: {folder.name}/ ({seconds})", flush=True)
            bar.update(task, completed=(index + 1) * steps)
    return len(photos) - len(failed), failed


def _begin(bar: Progress, task: TaskID, image: str, step: str, advance: int = 1) -> None:
    """Show which step of an image begins, on the bar or, if there is none, in a line; `advance` ends earlier steps."""
    if bar.disable:
        print(f"{image}: {step}", flush=True)
    bar.update(task, description=escape(f"{image}: {step}"), advance=advance)


def _warn_of_hidden_parts(config: DictConfig, model: SceneModel) -> None:
    hiding = [name for name in ("mask", "box") if config[name] is not None]
    if hiding and not model.architecture.get("training", {}).get("box_masks"):
        text = "these weights were not trained with parts of the image hidden (data.box_masks, conf/experiment/"
        logger.warning("%s: %s*_masked.yaml): hidden parts may come out black or grey", hiding[0], text)


def _succeeds(predict: Callable[[], None], image: Path, is_only: bool) -> bool:
    """Predict an image; raise the error of the only one, or print that of one of several and return false."""
    try:
        predict()
    except DiskError:  # the other images would fail, too
        raise
    except Exception as error:
        is_fault = not isinstance(error, CompleteSplatError | OSError)
        if is_only and is_fault:
            raise
        message = " ".join(str(error).split()) or type(error).__name__
        message = printable(message if image.name in message else f"{image}: {message}")
        if is_only:
            raise CompleteSplatError(message) from error
        if is_fault:
            logger.error("a fault of the program, not of the image", exc_info=error)
        print(f"error: {message}", file=sys.stderr, flush=True)
        return False
    return True


def predict_from_views(config: DictConfig, images: Sequence[Path], wanted: OutputFiles, out: Path) -> None:
    """Write the files of one scene that all images show, into a folder with the name of the first image.

    Raises:
        CompleteSplatError: one image alone, or a mask, box, field of view or removed background besides the cameras.
        DataError, WeightsError: as `read_photographs`, `CompleteSplat.reconstruct`.
    """
    from completesplat.data.captures.transforms_json import read_photographs

    if len(images) < 2:
        raise CompleteSplatError("cameras=FILE goes with two images or more: image=[A,B]")
    others = [name for name in ("mask", "box", "fov") if config[name] is not None]
    others += ["background=remove"] if config.background == REMOVE else []
    if others:
        raise CompleteSplatError(f"{others[0]} does not go with cameras=FILE")
    model = open_generator(config, images)
    views = read_photographs(images, Path(config.cameras), model.image_size)
    views = replace(views, cameras=model.in_model_units(views.cameras))
    scene = model.reconstruct(views).to("cpu")
    recorded = {
        "seed": config.seed,
        "image": printable(images[0].name),
        "images": [printable(image.name) for image in images],
        "cameras": printable(Path(config.cameras).name),
        "weights": printable(Path(config.weights).name),
        "screen_space_dilation": config.screen_space_dilation,
        "depth_range": model.depth_range.tolist(),
    }
    wanted = replace(wanted, background=shown_background(config.background, model))
    rasterizer = instantiate(config.rasterizer, _convert_="all")
    folder = out / safe_name(images[0].stem)
    shot = Shot(scene, views.cameras[0], model.up.cpu())
    write_prediction(folder, views.images[0], [shot], rasterizer, wanted, recorded, partial(print, flush=True))
    print(f"one scene of {len(images)} images, at the posterior's mean: {folder.name}/")


def _predict(
    config: DictConfig,
    model: SceneModel,
    rasterizer: Rasterizer,
    wanted: OutputFiles,
    image: Path,
    folder: Path,
    begin: Callable[..., None],
) -> None:
    if config.background == REMOVE:
        begin("removing the background", advance=0)
    photograph = model.read(image, config.fov, config.background == REMOVE)
    visible = visible_part(config, image, photograph)
    for warning in photo_warnings(photograph, model, whole=visible is None):
        logger.warning("%s: %s", printable(image.name), warning)
    settings = {name: config[name] for name in ("samples", "seed", "color_fits")}
    sampler = {}
    if isinstance(model, CompleteSplat):
        settings["guidance_weight"] = config.guidance_weight
        settings["skip_weight"] = allowed_skip_weight(config.skip_weight, visible)
        settings["steps"] = model.sampler.steps if config.steps is None else config.steps
        settings["bfloat16"] = has_bfloat16(model.up.device.type)
        sampler = {"sampler": model.architecture["sampler"]["scheduler"]["_target_"].rpartition(".")[2]}
    begin(f"drawing {config.samples} sample{'s' if config.samples > 1 else ''}", advance=0)
    scenes = model(photograph, visible, batch=config.batch, **settings)
    recorded = {
        **settings,
        **sampler,
        "made_from": made_from(config, model, image),
        "image": printable(image.name),
        "weights": printable(Path(config.weights).name),
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
    camera = model.camera(photograph).to("cpu")
    up = model.up.cpu()
    if model.background is not None:  # images of objects, whose centre is in the middle of the depth range
        wanted = replace(wanted, pivot_depth=model.middle_depth(model.depth_range_of(photograph)))
    shots = [Shot(scene.to("cpu"), camera, up) for scene in scenes]
    write_prediction(folder, visible_image, shots, rasterizer, wanted, recorded, begin)


def photo_warnings(photograph: Photograph, model: SceneModel, whole: bool) -> list[str]:
    """Return lines about a photo that is unlike the training images; its contents are compared only if `whole`."""
    moves = "depth_before" in (model.architecture.get("training") or {})  # the depth range, by the field of view
    warnings = [None if moves else unusual_field_of_view(photograph, model.fov_degrees.item())]
    distance = distance_to_training(photograph, model.architecture) if whole else None
    if distance is not None and distance > UNLIKE:
        far = f"{distance:.1f} standard deviations, {UNLIKE:g} is far"
        warnings.append(f"unlike the training images ({far}): expect little of it in the scenes")
        warnings.append(nearer_weights(photograph, distance))
    return [warning for warning in warnings if warning]


def nearer_weights(photograph: Photograph, distance: float) -> str:
    """Name the shipped weights whose training images are nearer to a photo, and `ELSEWHERE` if these are far, too."""
    name, (_, other) = next(iter(match_shipped(photograph.image).items()), ("", (0.0, math.inf)))
    nearer = other < distance - RESIZING
    lines = [f"weights={name} are nearer ({other:.1f})"] if nearer else []
    return "; ".join([*lines, ELSEWHERE] if min(other, distance) > UNLIKE else lines)


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


def visible_part(config: DictConfig, image: Path, photograph: Photograph) -> Float[Tensor, "1 size size"] | None:
    """Return 0 where `mask` or `box` hides the photo, else 1; None without both. Raise CompleteSplatError if unfit."""
    if config.mask is not None and config.box is not None:
        raise CompleteSplatError("give mask=FILE or box=[x0,y0,x1,y1], not both")
    if (part := config.box if config.mask is None else config.mask) is None:
        return None
    if photograph.crop != "center":
        raise CompleteSplatError("mask= and box= are of a photo's central square, but its object is shown in another")
    size = photograph.image.shape[-1]
    return outside_of_box(image, list(part), size) if config.mask is None else outside_of_mask(image, Path(part), size)
