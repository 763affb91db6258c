"""`completesplat predict cameras=...`: one scene from several photos whose cameras are known."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra.utils import instantiate
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from completesplat.commands.trained import open_generator, shown_background
from completesplat.errors import CompleteSplatError
from completesplat.export.placed_scene import PlacedScene
from completesplat.export.prediction import write_prediction
from completesplat.export.scene_files import OutputFiles
from completesplat.photo.angles import cameras_by_angles, distances_by_size, up_of_first
from completesplat.photo.reading import Photograph
from completesplat.scene import Views
from completesplat.scene_model import SceneModel
from completesplat.settings.checks import REMOVE
from completesplat.wording import counted, printable, safe_name

OF_OBJECT = 0.1  # least difference of a channel from the weights' background in a pixel of the object


class KnownViews(NamedTuple):
    """Photos with their cameras, the direction up in the first one's frame, and facts for `scene.json`."""

    views: Views
    up: Float[Tensor, "3"]
    facts: dict[str, Any]


def predict_from_views(config: DictConfig, images: Sequence[Path], outputs: OutputFiles, out: Path) -> None:
    """Write the files of one scene that all images show, into a folder with the name of the first image.

    Raises:
        CompleteSplatError: one image alone, no such file of cameras, or settings that do not go with the cameras.
        DataError, WeightsError: as `read_photographs`, `CompleteSplat.reconstruct`.
    """
    of_file = isinstance(config.cameras, str)
    if len(images) < 2:
        given = "cameras=FILE" if of_file else "cameras=[0,90]"
        raise CompleteSplatError(f"{given} goes with two images or more: image=[A,B]")
    refuse_others(config, of_file)
    if of_file and not Path(config.cameras).is_file():
        wanted = "give a transforms.json, or a list with the angle of each image: cameras=[0,90]"
        raise CompleteSplatError(f"cameras={printable(config.cameras)}: no such file; {wanted}")
    model = open_generator(config, images)
    known = views_of_file(config, images, model) if of_file else views_by_angles(config, images, model)
    views = replace(known.views, cameras=model.in_model_units(known.views.cameras))
    scene = PlacedScene(model.reconstruct(views).to("cpu"), views.cameras[0], known.up)
    recorded = {
        "seed": config.seed,
        "image": printable(images[0].name),
        "images": [printable(image.name) for image in images],
        **known.facts,
        "weights": printable(Path(config.weights).name),
        "screen_space_dilation": config.screen_space_dilation,
        "depth_range": model.depth_range.tolist(),
    }
    outputs = replace(outputs, background=shown_background(config.background, model))
    rasterizer = instantiate(config.rasterizer, _convert_="all")
    folder = out / safe_name(images[0].stem)
    write_prediction(folder, views.images[0], [scene], rasterizer, outputs, recorded, partial(print, flush=True))
    print(f"one scene of {len(images)} images, at the posterior's mean: {folder.name}/")


def refuse_others(config: DictConfig, of_file: bool) -> None:
    """Raise CompleteSplatError for a setting that does not go with known cameras."""
    names = ("mask", "box", "fov") if of_file else ("mask", "box")
    others = [name for name in names if config[name] is not None]
    if of_file:
        if config.background == REMOVE:
            others.append("background=remove")
        if config.crop != "whole":
            others.append("crop")
        if config.elevation != 0:
            others.append("elevation")
    if others:
        raise CompleteSplatError(f"{others[0]} does not go with cameras={'FILE' if of_file else '[ANGLES]'}")


def views_of_file(config: DictConfig, images: Sequence[Path], model: SceneModel) -> KnownViews:
    """Return the photos with their cameras in a `transforms.json`."""
    from completesplat.data.captures.transforms_json import read_photographs  # which other predictions do not need

    views = read_photographs(images, Path(config.cameras), model.image_size)
    return KnownViews(views, model.up.cpu(), {"cameras": printable(Path(config.cameras).name)})


def views_by_angles(config: DictConfig, images: Sequence[Path], model: SceneModel) -> KnownViews:
    """Return the photos with cameras around the object, at distances that make it equally high in all.

    Raises:
        CompleteSplatError: there are not as many angles or elevations as photos, or two photos are from one place.
    """
    count = len(images)
    angles = numbers(config.cameras, count, "cameras", "angles")
    elevations = numbers(config.elevation, count, "elevation", "elevations")
    places = {(angle % 360, elevation) for angle, elevation in zip(angles, elevations, strict=True)}
    if len(places) < count:
        raise CompleteSplatError("cameras: two photos are from the same angle and elevation; leave one out")
    remove = config.background == REMOVE
    photographs = [model.read(image, config.fov, remove, None, None, config.crop) for image in images]
    lenses = [model.camera(photograph).to("cpu") for photograph in photographs]
    intrinsics = torch.stack([camera.intrinsics for camera in lenses])
    masks = [object_mask(photograph, model.background) for photograph in photographs]
    distances = distances_by_size(masks, intrinsics, angles)
    cameras = cameras_by_angles(intrinsics, model.image_size, angles, elevations, distances)
    shown = torch.ones(count, 1, model.image_size, model.image_size)
    views = Views(torch.stack([photograph.image for photograph in photographs]), cameras, shown)
    facts = {"cameras": angles, "elevation": elevations, "distances": distances}
    return KnownViews(views, up_of_first(elevations[0]), facts)


def numbers(given: Any, count: int, setting: str, what: str) -> list[float]:
    """Return one number for each photo, from a list or from one number for all."""
    if isinstance(given, int | float):
        return [float(given)] * count
    values = [float(value) for value in given]
    if len(values) != count:
        raise CompleteSplatError(f"{setting}: {counted(len(values), what.removesuffix('s'))} for {count} images")
    return values


def object_mask(photograph: Photograph, background: float | None) -> Float[Tensor, "1 size size"] | None:
    """Return the mask of a photo's object: what was cut out, or what differs from the background of the weights."""
    if photograph.cut_out is not None or background is None:
        return photograph.cut_out
    different = (photograph.image - background).abs().amax(0, keepdim=True) > OF_OBJECT
    return different.float()
