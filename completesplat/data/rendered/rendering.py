"""Renders of objects in CO3D's layout: jobs of a renderer, the files made of them, and the data module."""

import json
import logging
import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from threading import Event
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, Unpack, cast

import numpy as np
import torch
from filelock import FileLock
from jaxtyping import Float
from PIL import Image
from rich.progress import track

from completesplat.data.co3d import category_writers
from completesplat.data.co3d.annotations import viewpoint
from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.lists import listed_names
from completesplat.data.rendered.assets import Asset, BrokenMesh, check_named_files, find_meshes, procedural_objects
from completesplat.data.rendered.blender import Blender, find_blender, run_job
from completesplat.data.rendered.mesh_reading import READABLE, import_trimesh
from completesplat.data.rendered.mesh_renderer import draw_job
from completesplat.data.rendered.random_scenes import PAINTS, RenderSettings, check_surroundings, draw_rendered_scene
from completesplat.data.sequences import first_names
from completesplat.data.validation import read_points
from completesplat.data.validation.processes import share_of, usable_cores
from completesplat.errors import CompleteSplatError, DataError, MissingFile, UnreadableFile
from completesplat.files import atomic_folder, write_text
from completesplat.geometry.cameras import Cameras, pixel_centers, unproject
from completesplat.photo.saving import save_jpeg, to_uint8
from completesplat.quantities import Natural, Positive, Range
from completesplat.wording import counted

logger = logging.getLogger(__name__)

Renderer: TypeAlias = Literal["mesh", "blender"]

CATEGORY = "rendered"
DESCRIPTION = "rendered.json"
OBJECT = "object.json"
BROKEN = "broken.json"
LOCK = ".rendered.lock"
FORMAT_VERSION = 2
MOST_POINTS = 20_000
SKY = 1e9  # Cycles has 1e10 where no surface is
MEGABYTE = 1_000_000
LEAST_MEMORY = 4000 * MEGABYTE
MEMORY_OF_BYTE = 20  # of Blender for a mesh: bytes, and for each byte of its file


class JobSettings(RenderSettings):
    """Settings of all scenes, and of a job.

    Attributes:
        max_megabytes: largest size of a mesh's file.
        max_minutes: longest time of an object.
        workers: number of objects that are drawn at the same time, each by one thread (None: one for each core).
        shard, shards: the job renders every `shards`-th object from number `shard` on, and other jobs the others.
    """

    max_megabytes: Positive
    max_minutes: Annotated[float, Range(0)]
    workers: Positive | None
    shard: Natural
    shards: Positive


def render(
    meshes: str | None,
    factory: str | None,
    count: Positive,
    out: Path,
    objects: str | None = None,
    renderer: Renderer = "mesh",
    blender: str | None = None,
    **job: Unpack[JobSettings],
) -> Path:
    """Render objects into `out`/rendered, and return this folder.

    What an object's images show depends on the settings, which include the seed, and on its path or number alone.
    Objects that are rendered already remain; those that cannot be rendered are left out and tried again the next time.
    When all jobs that share the objects have ended, in whatever order, the files are those of one job for all.

    Args:
        meshes, factory: a folder of meshes, or a class of Infinigen, of which `count` objects are made.
        objects: list of the meshes to render (`listed_names`), by the names of their sequences; None: all.
        renderer: `mesh` draws what `READABLE` names without Blender, and the rest with it; `blender` draws all with it.
        blender: see `find_blender`.

    Raises:
        CompleteSplatError: Blender is needed, and there is none, or it is too old; or there is no such shard.
        DataError: there are no meshes, a file of the settings is missing, the folder holds something else, or nothing
            can be rendered; `broken.json` has the reasons.
        DiskError: the disk is full.
    """
    of_scenes = {name: value for name, value in job.items() if name in RenderSettings.__annotations__}
    settings = cast(RenderSettings, of_scenes)
    _check_places(meshes, factory, out)
    check_surroundings(settings)
    draw_rendered_scene("", settings)  # refuses cameras that cannot be read
    assets = find_meshes(Path(meshes)) if meshes is not None else []
    if objects is not None:
        assets = _of_list(assets, objects, meshes)
    by_blender = renderer == "blender" or factory is not None or settings["light"] != "random"
    needed = by_blender or any(not _is_readable(asset) for asset in assets)
    program = find_blender(blender) if needed else None
    if not by_blender:
        import_trimesh()
    category = out / CATEGORY
    if factory is not None and program is not None:
        assets = procedural_objects(program, factory, count)
    mine = share_of(assets, job["shard"], job["shards"])
    lock = FileLock(out / LOCK)
    out.mkdir(parents=True, exist_ok=True)
    with lock:
        _begin(category, settings, by_blender)
    waiting = [asset for asset in mine if not (category / asset.name).exists()]
    most = (MEGABYTE * job["max_megabytes"], job["max_minutes"])
    write_one = partial(_write_object, category, program, by_blender, settings, most)
    results = track(_in_threads(write_one, waiting, job["workers"]), "Rendering", len(waiting))
    broken = {name: reason for name, reason in sorted(results) if reason}
    for name, reason in broken.items():
        logger.warning("left out: %s: %s", name, reason)
    with lock:
        _write_lists(category, assets, broken, len(waiting) - len(broken))
    return category


def _check_places(meshes: str | None, factory: str | None, out: Path) -> None:
    """Refuse neither or both of meshes and factory, and results among the meshes."""
    if (meshes is None) == (factory is None):
        raise CompleteSplatError("give either meshes=FOLDER or factory=NAME (of Infinigen, such as SofaFactory)")
    if meshes is not None and out.resolve().is_relative_to(Path(meshes).resolve()):
        raise DataError(f"lies in meshes={meshes}, and its points would be taken for meshes", f"out={out}")


def _of_list(assets: Sequence[Asset], chosen: str, meshes: str | None) -> list[Asset]:
    """Return the listed objects; raise MissingFile if one is not among the meshes."""
    names = set(listed_names(chosen))
    listed = [asset for asset in assets if asset.name in names]
    missing = sorted(names.difference(asset.name for asset in listed))
    if missing:
        raise MissingFile(f"{len(missing)} of {len(names)} meshes of objects={chosen}: {first_names(missing)}", meshes)
    return listed


def _begin(category: Path, settings: RenderSettings, by_blender: bool) -> None:
    """Write the settings into a new folder of renders; refuse a folder that other settings began."""
    parameters: dict[str, object] = {"format": FORMAT_VERSION, **settings}
    if not by_blender:
        parameters["renderer"] = "mesh"
    if not category_writers.is_written(category / DESCRIPTION, parameters):
        with atomic_folder(category) as unfinished:
            (unfinished / DESCRIPTION).write_text(json.dumps(parameters, indent=1, sort_keys=True) + "\n")


def _write_lists(category: Path, objects: Sequence[Asset], broken: dict[str, str], new: int) -> None:
    """Write reasons for all objects that are left out, and annotations of all that are not. `new` ones are logged."""
    path = category / BROKEN
    reasons = json.loads(path.read_text()) if path.is_file() else {}
    reasons |= broken
    missing = sorted(asset.name for asset in objects if not (category / asset.name).exists())
    broken = {name: reasons[name] for name in missing if name in reasons}
    write_text(path, json.dumps(broken, indent=1) + "\n")
    rendered = {path.parent.name: json.loads(path.read_text()) for path in sorted(category.glob(f"[!.]*/{OBJECT}"))}
    names = {asset.key: asset.name for asset in objects}  # an object that was added may have renamed another
    records = [record for name, record in rendered.items() if names.get(record["source"], name) == name]
    if len(broken) == len(objects) and not records:
        raise DataError(f"none of {len(broken)} objects can be rendered: {next(iter(broken.values()))}", str(category))
    frames = [frame for record in records for frame in record["frames"]]
    category_writers.write_annotations(category, frames, [record["sequence"] for record in records])
    logger.info("%s in %s/, %d of them new, %d left out", counted(len(records), "object"), CATEGORY, new, len(broken))


def _in_threads(
    function: Callable[[Asset, Event], tuple[str, str]], assets: Sequence[Asset], workers: int | None
) -> Iterator[tuple[str, str]]:
    """Yield the results as they come. At an exception, end those that run and start no more."""
    stopped = Event()
    with ThreadPoolExecutor(workers or usable_cores()) as pool:
        futures = [pool.submit(function, asset, stopped) for asset in assets]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            stopped.set()
            pool.shutdown(cancel_futures=True)


def _is_readable(asset: Asset) -> bool:
    """Whether the renderer of meshes reads an object."""
    return asset.mesh is not None and asset.mesh.suffix.lower() in READABLE


def _write_object(
    category: Path,
    program: Blender | None,
    by_blender: bool,
    settings: RenderSettings,
    most: tuple[int, float],
    asset: Asset,
    stopped: Event,
) -> tuple[str, str]:
    """Render an object into its folder, whole or not at all, and return its name and why it is left out (or "")."""
    mesh = asset.mesh
    most_bytes, minutes = most
    try:
        job, cameras = draw_rendered_scene(asset.key, settings)
        job["factory"] = asset.factory
        if mesh is not None:
            size = mesh.stat().st_size
            if size > most_bytes:
                raise BrokenMesh(f"{size // MEGABYTE:,} MB, more than max_megabytes={most_bytes // MEGABYTE}")
            root = mesh.parents[asset.key.count("/")].resolve()
            check_named_files(mesh, root)
            job["mesh"] = str(mesh.absolute())
            job["root"] = str(root)
            job["memory"] = LEAST_MEMORY + MEMORY_OF_BYTE * size
        # Blender's importer would move such vertices to the origin.
        if mesh is not None and mesh.suffix.lower() == ".ply" and not np.isfinite(read_points(mesh)).all():
            raise BrokenMesh("it has vertices that are not finite")
        with atomic_folder(category / asset.name) as folder:
            files = folder / "renderer"
            files.mkdir()
            job["folder"] = str(files.absolute())
            if program is not None and (by_blender or not _is_readable(asset)):
                result = run_job(program, job, files, stopped, minutes)
            else:
                result = draw_job(job, stopped, minutes)
                beyond = result.pop("beyond")
                if beyond:
                    logger.warning("%s: %s: drawn as plain colours; renderer=blender draws them", asset.name, beyond)
            if "refused" in result:
                raise BrokenMesh(result["refused"])
            if result["left_out"]:
                text = "%s: %d stray faces are left out, far from 99 %% of its surface"
                logger.warning(text, asset.name, result["left_out"])
            modes = job["hidden"]["modes"] if job["hidden"] else []
            record = {"source": asset.key} | result | _write_sequence(folder, asset.name, files, cameras)
            record["hidden"] = modes[0] if modes else None
            if settings["hidden"] == "modes":
                _write_modes(folder, modes, files)
            (folder / OBJECT).write_text(json.dumps(record) + "\n")
            shutil.rmtree(files)
    except (BrokenMesh, UnreadableFile) as error:
        return asset.name, error.reason
    return asset.name, ""


def _write_sequence(folder: Path, name: str, files: Path, cameras: Sequence[Cameras]) -> dict[str, Any]:
    """Write images, masks, depths and points from the files of a renderer, and return the annotations."""
    for kind in category_writers.FOLDERS:
        (folder / kind).mkdir()
    frames = list[category_writers.Annotation]()
    points = []
    colors = []
    for number, camera in enumerate(cameras):
        image = _pixels(files / f"{number:04d}.png")
        depth, is_object, coverage = np.moveaxis(np.load(files / f"{number:04d}.npy"), -1, 0)
        depth[depth > SKY] = 0
        place = (CATEGORY, name, number)
        shown = is_object == 1
        frames.append(category_writers.write_frame(folder, place, image, coverage, depth, _viewpoint(camera)))
        pixels = pixel_centers(*camera.image_size, dtype=torch.float64)[torch.from_numpy(shown)]
        points.append(unproject(camera, pixels, torch.from_numpy(depth[shown]).double()).numpy())
        colors.append(to_uint8(image[shown]))
    step = math.ceil(sum(map(len, points)) / MOST_POINTS)
    if not step:
        raise BrokenMesh("no image shows it")
    cloud = np.concatenate(points)[::step]
    category_writers.write_points(folder / "pointcloud.ply", cloud, np.concatenate(colors)[::step])
    return {"frames": frames, "sequence": category_writers.sequence_annotation(CATEGORY, name, len(cloud))}


def _write_modes(folder: Path, modes: Sequence[str], files: Path) -> None:
    for index, mode in enumerate(modes):
        (folder / mode).mkdir()
        prefix = f"{index}_" if index else ""
        for number, image in enumerate(sorted((folder / "images").iterdir())):
            save_jpeg(_pixels(files / f"{prefix}{number:04d}.png"), category_writers.in_mode(image, mode))


def _pixels(path: Path) -> Float[np.ndarray, "height width 3"]:
    return np.asarray(Image.open(path).convert("RGB")) / 255.0


def _viewpoint(camera: Cameras) -> dict[str, object]:
    half = np.array(camera.image_size[::-1]) / 2
    matrix = camera.world_to_camera.numpy()
    intrinsics = camera.intrinsics.numpy()
    focal = intrinsics.diagonal()[:2] / half
    center = 1 - intrinsics[:2, 2] / half
    return viewpoint(matrix[:3, :3], matrix[:3, 3], focal.tolist(), center.tolist())


class RenderedDataModule(CO3DDataModule):
    """`CO3DDataModule` of objects that `render` wrote below `root`, split by seed."""

    record = OBJECT
    chances: ClassVar = {name: paint.chance for name, paint in PAINTS.items()}

    def __init__(self, root: str, **settings: Any) -> None:
        super().__init__(root, CATEGORY, subset=None, **settings)

    def describe(self) -> dict[str, str | None]:
        return super().describe() | {"data_set": CATEGORY}
