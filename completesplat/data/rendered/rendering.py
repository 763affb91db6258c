"""Renders of a folder of meshes: list of objects, jobs of worker processes, broken meshes, data module."""

import json
import logging
import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Annotated, Any, ClassVar, NamedTuple, Unpack, cast
from urllib.parse import unquote

import numpy as np
import torch
from filelock import FileLock
from jaxtyping import Float
from PIL import Image
from rich.progress import track

from completesplat.data.co3d import writing
from completesplat.data.co3d.annotations import viewpoint
from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.hidden_modes import in_mode
from completesplat.data.rendered.blender import Blender, find_blender, run_job
from completesplat.data.rendered.drawing import PAINTS, RenderSettings, check_surroundings, draw_rendered_scene
from completesplat.data.validation import read_points
from completesplat.data.validation.processes import share_of, usable_cores
from completesplat.errors import CompleteSplatError, DataError, MissingFile, UnreadableFile
from completesplat.files import atomic_folder, counted, folder_names, write_text
from completesplat.geometry.cameras import Cameras, pixel_centers, unproject
from completesplat.photo.saving import save_jpeg, to_uint8
from completesplat.settings.schema import Natural, Positive, Range

logger = logging.getLogger(__name__)

CATEGORY = "rendered"
DESCRIPTION = "rendered.json"
OBJECT = "object.json"
BROKEN = "broken.json"
LOCK = ".rendered.lock"
FORMAT_VERSION = 2
SUFFIXES = ("glb", "gltf", "obj", "ply", "stl", "fbx", "usd", "usda", "usdc", "usdz")
MOST_POINTS = 20_000
SKY = 1e9  # Cycles has 1e10 where no surface is
MEGABYTE = 1_000_000
LEAST_MEMORY = 4000 * MEGABYTE
MEMORY_OF_BYTE = 20  # of Blender for a mesh: bytes, and for each byte of its file
MOST_OPTIONS = 30  # words before the name of a texture


class Asset(NamedTuple):
    """Object to render: the name of its sequence, a key that draws its surroundings, and its mesh or factory."""

    name: str
    key: str
    mesh: Path | None = None
    factory: str | None = None


class BrokenMesh(Exception):
    """Object that Blender cannot render, or of which no image shows anything.

    It is no CompleteSplatError, so that `atomic_folder` looks whether a full disk is the reason.
    """


def find_meshes(folder: Path) -> list[Asset]:
    """List the mesh files below a folder by path; a sequence is named after its file's path without suffix, if unique.

    Raises:
        MissingFile: the folder does not exist or has no mesh.
    """
    if not folder.is_dir():
        raise MissingFile("no such folder", str(folder))
    paths = sorted(path for path in folder.rglob("[!.]*") if path.suffix[1:].lower() in SUFFIXES and path.is_file())
    if not paths:
        raise MissingFile(f"no meshes there ({', '.join(SUFFIXES)})", str(folder))
    relative = [path.relative_to(folder).as_posix() for path in paths]
    objects = [path.removesuffix(Path(path).suffix) for path in relative]
    count = Counter(objects)
    names = folder_names(name if count[name] == 1 else path for name, path in zip(objects, relative, strict=True))
    return [Asset(*mesh) for mesh in zip(names, relative, paths, strict=True)]


def check_named_files(mesh: Path, root: Path) -> None:
    """Refuse files that an OBJ or glTF names and Blender would open, unless they are regular files below `root`.

    Raises:
        BrokenMesh: there is such a file, or an OBJ's material file is missing.
    """
    names = _uris(mesh) if mesh.suffix.lower() in (".gltf", ".glb") else []
    for line in _lines(mesh, "mtllib") if mesh.suffix.lower() == ".obj" else ():
        library = line.strip('"').replace("\\", "/")
        _check_named_file(mesh, library, root)
        if not os.path.isfile(mesh.parent / library):
            raise BrokenMesh(f"its material file {library} is missing")
        for line in _lines(mesh.parent / library, "map_", "bump", "disp", "decal", "refl", "norm"):
            words = line.split(maxsplit=MOST_OPTIONS)
            names += [" ".join(words[start:]) for start in range(len(words))]  # options may precede the name
    for name in names:
        _check_named_file(mesh, name, root)


def _check_named_file(mesh: Path, name: str, root: Path) -> None:
    named = mesh.parent / name.replace("\\", "/")
    for path in (named, mesh.parent / named.name):  # Blender looks beside the mesh, too
        if not os.path.exists(path) or path.is_dir():
            continue
        if not path.resolve().is_relative_to(root):
            raise BrokenMesh(f"{path.name} lies outside of the folder of meshes")
        if not path.is_file():
            raise BrokenMesh(f"{path.name} is no regular file")


def _lines(path: Path, *starts: str) -> list[str]:
    """Return what follows the first word of the lines that start so."""
    with path.open(errors="replace") as lines:
        return [(line.split(maxsplit=1)[1:] or [""])[0].strip() for line in lines if line.lstrip().startswith(starts)]


def _uris(mesh: Path) -> list[str]:
    """Return the files that a glTF names; of one that cannot be read none, because Blender says what is wrong."""
    with mesh.open("rb") as file:
        start = file.read(20)
        content = file.read(int.from_bytes(start[12:16], "little") if start.startswith(b"glTF") else -1)
    try:
        description = json.loads(content if start.startswith(b"glTF") else start + content)
        return [unquote(x["uri"]) for kind in ("buffers", "images") for x in description.get(kind, ()) if "uri" in x]
    except (ValueError, TypeError, AttributeError, RecursionError):
        return []


def procedural_objects(program: Blender, factory: str, count: int) -> list[Asset]:
    """List objects of a factory of Infinigen; refuse one that the program's Python does not have."""
    if not factory.isidentifier():
        raise CompleteSplatError(f"factory={factory}: must be the name of a class, such as SofaFactory")
    with TemporaryDirectory() as folder:
        result = run_job(program, {"factory": factory, "views": []}, Path(folder), Event())
    if "refused" in result:
        raise CompleteSplatError(f"factory={factory}: {result['refused']}")
    return [Asset(name, name, factory=factory) for name in (f"{factory}_{index:05d}" for index in range(count))]


class JobSettings(RenderSettings):
    """Settings of all scenes, and of a job.

    Attributes:
        max_megabytes: largest size of a mesh's file.
        max_minutes: longest time of an object.
        workers: number of Blender's processes, each with one object and one thread (None: one for each core).
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
    blender: str | None = None,
    **job: Unpack[JobSettings],
) -> Path:
    """Render objects into `out`/rendered, and return this folder.

    What an object's images show depends on the settings, which include the seed, and on its path or number alone.
    Objects that are rendered already remain; those that cannot be rendered are left out and tried again the next time.
    When all jobs that share the objects have ended, in whatever order, the files are those of one job for all.

    Args:
        meshes, factory: a folder of meshes, or a class of Infinigen, of which `count` objects are made.
        blender: see `find_blender`.

    Raises:
        CompleteSplatError: there is no Blender, or it is too old; or there is no such shard.
        DataError: there are no meshes, a file of the settings is missing, the folder holds something else, or nothing
            can be rendered; `broken.json` has the reasons.
        DiskError: the disk is full.
    """
    settings = cast(RenderSettings, {name: x for name, x in job.items() if name in RenderSettings.__annotations__})
    if (meshes is None) == (factory is None):
        raise CompleteSplatError("give either meshes=FOLDER or factory=NAME (of Infinigen, such as SofaFactory)")
    if meshes is not None and out.resolve().is_relative_to(Path(meshes).resolve()):
        raise DataError(f"lies in meshes={meshes}, and its points would be taken for meshes", f"out={out}")
    check_surroundings(settings)
    draw_rendered_scene("", settings)  # refuses cameras that cannot be read
    objects = find_meshes(Path(meshes)) if meshes is not None else []
    program = find_blender(blender)
    category = out / CATEGORY
    objects = objects or procedural_objects(program, str(factory), count)
    mine = share_of(objects, job["shard"], job["shards"])
    parameters = {"format": FORMAT_VERSION, **settings}
    lock = FileLock(out / LOCK)
    out.mkdir(parents=True, exist_ok=True)
    with lock:
        if not writing.is_written(category / DESCRIPTION, parameters):
            with atomic_folder(category) as unfinished:
                (unfinished / DESCRIPTION).write_text(json.dumps(parameters, indent=1, sort_keys=True) + "\n")
    waiting = [asset for asset in mine if not (category / asset.name).exists()]
    most = MEGABYTE * job["max_megabytes"], job["max_minutes"]
    write_one = partial(_write_object, category, program, settings, most)
    results = track(_in_threads(write_one, waiting, job["workers"]), "Rendering", len(waiting))
    broken = {name: reason for name, reason in sorted(results) if reason}
    for name, reason in broken.items():
        logger.warning("left out: %s: %s", name, reason)
    with lock:
        _write_lists(category, objects, broken, len(waiting) - len(broken))
    return category


def _write_lists(category: Path, objects: Sequence[Asset], broken: dict[str, str], new: int) -> None:
    """Write reasons for all objects that are left out, and the others' annotations; log how many, `new` by this job."""
    path = category / BROKEN
    reasons = (json.loads(path.read_text()) if path.is_file() else {}) | broken
    missing = sorted(asset.name for asset in objects if not (category / asset.name).exists())
    broken = {name: reasons[name] for name in missing if name in reasons}
    write_text(path, json.dumps(broken, indent=1) + "\n")
    rendered = {path.parent.name: json.loads(path.read_text()) for path in sorted(category.glob(f"[!.]*/{OBJECT}"))}
    names = {asset.key: asset.name for asset in objects}  # an object that was added may have renamed another
    records = [record for name, record in rendered.items() if names.get(record["source"], name) == name]
    if len(broken) == len(objects) and not records:
        raise DataError(f"none of {len(broken)} objects can be rendered: {next(iter(broken.values()))}", str(category))
    frames = [frame for record in records for frame in record["frames"]]
    writing.write_annotations(category, frames, [record["sequence"] for record in records])
    logger.info("%s in %s/, %d of them new, %d left out", counted(len(records), "object"), CATEGORY, new, len(broken))


def _in_threads(
    function: Callable[[Asset, Event], tuple[str, str]], assets: Sequence[Asset], workers: int | None
) -> Iterator[tuple[str, str]]:
    """Yield the results as they come; at an exception, end those that run and start no others."""
    stopped = Event()
    with ThreadPoolExecutor(workers or usable_cores()) as pool:
        futures = [pool.submit(function, asset, stopped) for asset in assets]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            stopped.set()
            pool.shutdown(cancel_futures=True)


def _write_object(
    category: Path, program: Blender, settings: RenderSettings, most: tuple[int, float], asset: Asset, stopped: Event
) -> tuple[str, str]:
    """Render an object into its folder, whole or not at all; return its name, and why it is left out (or "")."""
    mesh = asset.mesh
    most_bytes, minutes = most
    try:
        job, cameras = draw_rendered_scene(asset.key, settings)
        job["factory"] = asset.factory
        if mesh is not None:
            if (size := mesh.stat().st_size) > most_bytes:
                raise BrokenMesh(f"{size // MEGABYTE:,} MB, more than max_megabytes={most_bytes // MEGABYTE}")
            root = mesh.parents[asset.key.count("/")].resolve()
            check_named_files(mesh, root)
            job |= {"mesh": str(mesh.absolute()), "root": str(root), "memory": LEAST_MEMORY + MEMORY_OF_BYTE * size}
        # Blender's importer would move such vertices to the origin.
        if mesh is not None and mesh.suffix.lower() == ".ply" and not np.isfinite(read_points(mesh)).all():
            raise BrokenMesh("it has vertices that are not finite")
        with atomic_folder(category / asset.name) as folder:
            files = folder / "blender"
            files.mkdir()
            result = run_job(program, job | {"folder": str(files.absolute())}, files, stopped, minutes)
            if "refused" in result:
                raise BrokenMesh(result["refused"])
            if result["left_out"]:
                text = "%s: %d stray faces are left out, far from 99 %% of its surface"
                logger.warning(text, asset.name, result["left_out"])
            modes = job["hidden"]["modes"] if job["hidden"] else []
            record = {"source": asset.key, **result, **_write_sequence(folder, asset.name, files, cameras)}
            record["hidden"] = (*modes, None)[0]
            if settings["hidden"] == "modes":
                _write_modes(folder, modes, files)
            (folder / OBJECT).write_text(json.dumps(record) + "\n")
            shutil.rmtree(files)
    except BrokenMesh as error:
        return asset.name, str(error)
    except UnreadableFile as error:
        return asset.name, error.reason
    return asset.name, ""


def _write_sequence(folder: Path, name: str, files: Path, cameras: Sequence[Cameras]) -> dict[str, Any]:
    """Write images, masks, depths and points from the files of Blender; return the annotations."""
    for kind in writing.FOLDERS:
        (folder / kind).mkdir()
    frames = list[writing.Annotation]()
    points = []
    colors = []
    for number, camera in enumerate(cameras):
        image = _pixels(files / f"{number:04d}.png")
        depth, seen, coverage = np.moveaxis(np.load(files / f"{number:04d}.npy"), -1, 0)
        depth[depth > SKY] = 0
        place = CATEGORY, name, number
        frames.append(writing.write_frame(folder, place, image, coverage, depth, _viewpoint(camera)))
        pixels = pixel_centers(*camera.image_size, dtype=torch.float64)[torch.from_numpy(seen == 1)]
        points.append(unproject(camera, pixels, torch.from_numpy(depth[seen == 1]).double()).numpy())
        colors.append(to_uint8(image[seen == 1]))
    step = math.ceil(sum(map(len, points)) / MOST_POINTS)
    if not step:
        raise BrokenMesh("no image shows it")
    cloud = np.concatenate(points)[::step]
    writing.write_points(folder / "pointcloud.ply", cloud, np.concatenate(colors)[::step])
    return {"frames": frames, "sequence": writing.sequence_annotation(CATEGORY, name, len(cloud))}


def _write_modes(folder: Path, modes: Sequence[str], files: Path) -> None:
    for index, mode in enumerate(modes):
        (folder / mode).mkdir()
        prefix = f"{index}_" if index else ""
        for number, image in enumerate(sorted((folder / "images").iterdir())):
            save_jpeg(_pixels(files / f"{prefix}{number:04d}.png"), in_mode(image, mode))


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
