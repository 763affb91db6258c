"""Writers of toy data: objects as a CO3D category, rooms in RealEstate10K's layout."""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypedDict, Unpack

import numpy as np
from filelock import FileLock
from rich.console import Console
from rich.progress import track

from completesplat.data.co3d import category_writers
from completesplat.data.co3d.annotations import viewpoint
from completesplat.data.toy.object_scene import PATCH_COLORS, ToyScene, draw_mini, draw_object_scene, render_frame
from completesplat.data.toy.room_scene import draw_room_scene, image_width, render_room_frame
from completesplat.data.toy.shapes import Array
from completesplat.data.toy.surroundings import WHITE
from completesplat.data.validation.processes import map_in_processes
from completesplat.errors import DataError
from completesplat.files import atomic_folder
from completesplat.photo.saving import save_jpeg, to_uint8
from completesplat.quantities import Entries, Natural, Positive, Range, Side
from completesplat.settings.schema import violations

FORMAT_VERSION = 3
DESCRIPTION = "toy.json"
MOST_FRAMES = 1000
ROOM_FRAMES_PER_SECOND = 30
MICROSECONDS = 1_000_000
LATEST_START = 9000
ROOMS = "toy_rooms"
SUBSET = "fewview_train"
DRAW: dict[str, Callable[[np.random.Generator, int], ToyScene]] = {
    "toy_objects": draw_object_scene,
    "toy_minis": draw_mini,
    "toy_marked_minis": partial(draw_mini, marked=True),
}
"""Functions that draw a scene, by category: (random generator, number of frames) -> scene."""

KINDS = ["objects", "minis", "marked_minis", "rooms"]


class DataSetSize(TypedDict):
    """Number of scenes, of frames of each, side or height of the images in pixels, and seed of all scenes."""

    scenes: int
    frames: int
    size: Side
    seed: Natural


Factors = Annotated[Sequence[Annotated[float, Range(0)]], Entries(3, 3)]
WrittenScene = tuple[str, list[category_writers.Annotation], category_writers.Annotation]
"""Split of a sequence, and annotations of its frames and of itself."""


def _write_frame(folder: Path, place: tuple[str, str, int], scene: ToyScene, size: int, split: str) -> dict[str, Any]:
    _, name, frame = place
    # The world has the scene's unit and origin.
    world_to_camera = np.linalg.inv(scene.camera_to_world[frame])
    rotation = world_to_camera[:3, :3]
    translation = scene.unit * world_to_camera[:3, 3] - rotation @ scene.origin
    focal = float(1 / np.tan(np.radians(scene.fov_degrees) / 2))
    seen_from = viewpoint(rotation, translation, [focal, focal], [0.0, 0.0])
    annotation = category_writers.write_frame(
        folder / name, place, *render_frame(scene, frame, size), seen_from, scene.unit
    )
    return annotation | {"meta": {"frame_type": f"{split}_known"}}


def _splits(scenes: int, rooms: bool) -> list[str]:
    """Return the split of every scene in order. Three or more objects have all splits, and rooms have no `val`."""
    if rooms:
        return ["test" if index % 10 == 0 else "train" for index in range(scenes)]
    test = max(1, round(0.1 * scenes)) if scenes > 1 else 0
    val = max(1, round(0.05 * scenes)) if scenes > 2 else 0
    return ["train"] * (scenes - val - test) + ["val"] * val + ["test"] * test


def draw_category(category: str, seed: int, index: int, frames: int, light: Array) -> ToyScene:
    """Draw a scene of a category (a key of `DRAW`) from a separate random generator, in light of a colour."""
    scene = DRAW[category](np.random.default_rng([seed, index]), frames)
    return scene._replace(light=scene.light._replace(color=light), point_colors=scene.point_colors * light)


def _write_scene(
    root: Path, place: tuple[int, str], category: str, frames: int, size: int, seed: int, light: Array
) -> WrittenScene:
    """Write one sequence and return its split and annotations. Its `toy.json` has the colour of the patch.

    A test scene has its images with every colour of the patch, too, for `test evaluation=hidden_modes`.
    """
    index, split = place
    scene = draw_category(category, seed, index, frames, light)
    name = f"{index:05d}_{scene.family}"
    for folder in category_writers.FOLDERS:
        (root / name / folder).mkdir(parents=True)
    annotations = [_write_frame(root, (category, name, frame), scene, size, split) for frame in range(frames)]
    points = scene.unit * scene.points + scene.origin
    category_writers.write_points(root / name / "pointcloud.ply", points, to_uint8(scene.point_colors))
    if split == "test":
        _write_modes(root / name, scene, size)
    record = {"family": scene.family, "hidden": scene.patch_color, "chances": scene.chances.tolist()}
    (root / name / DESCRIPTION).write_text(json.dumps(record) + "\n")
    return split, annotations, category_writers.sequence_annotation(category, name, len(points))


def _write_modes(folder: Path, scene: ToyScene, size: int) -> None:
    """Write the images of a scene with each colour of the patch."""
    for mode, color in PATCH_COLORS.items():
        (folder / mode).mkdir()
        painted = scene._replace(patch=scene.patch._replace(color=np.array(color)))
        for frame, image in enumerate(sorted((folder / "images").iterdir())):
            save_jpeg(render_frame(painted, frame, size)[0], category_writers.in_mode(image, mode))


def _write_lists(category: Path, written: list[WrittenScene]) -> None:
    """Write the annotations and the set list of all scenes."""
    lists: dict[str, list[list[str | int]]] = {"train": [], "val": [], "test": []}
    for split, frames, _ in written:
        for frame in frames:
            lists[split].append([frame["sequence_name"], frame["frame_number"], frame["image"]["path"]])
    annotations = [frame for _, frames, _ in written for frame in frames]
    category_writers.write_annotations(category, annotations, [sequence for _, _, sequence in written])
    category_writers.write_set_list(category, SUBSET, lists)


def _write_clip(root: Path, place: tuple[int, str], frames: int, size: int, seed: int, light: Array) -> None:
    """Write one clip, drawn from a separate random generator: `text`/<split>/<key>.txt and <key>/<timestamp>.jpg.

    The text has the address of the video, then a line for each frame: timestamp, fx fy cx cy as fractions of width or
    height, two zeros, and `world_to_camera` by rows.
    """
    index, split = place
    rng = np.random.default_rng([seed, index])
    scene = draw_room_scene(rng, frames)
    scene = scene._replace(light=scene.light._replace(color=light))
    width = image_width(size)
    start = int(rng.integers(LATEST_START))
    intrinsics = scene.move.intrinsics(size, width)
    poses = scene.move.world_to_camera().reshape(frames, 12)
    rows = np.concatenate([np.broadcast_to(intrinsics, (frames, 4)), np.zeros((frames, 2)), poses], axis=1)
    key = f"room{index:05d}"
    images = root / "text" / split / key
    images.mkdir(parents=True)
    lines = [f"https://example.com/toy/{key}"]  # no real video
    for frame, row in enumerate(rows.astype(np.float32)):
        time = round((start + frame) * MICROSECONDS / ROOM_FRAMES_PER_SECOND)
        numbers = " ".join(f"{number:.9g}" for number in row)  # nine digits identify a float32 exactly
        lines.append(f"{time} {numbers}")
        save_jpeg(render_room_frame(scene, frame, size, width)[0], images / f"{time}.jpg")
    images.with_suffix(".txt").write_text("\n".join(lines) + "\n")


def write(
    kind: str,
    out: Path,
    workers: Positive | None = None,
    light: Factors = WHITE,
    progress: bool = True,
    **numbers: Unpack[DataSetSize],
) -> Path:
    """Write scenes of a kind (one of `KINDS`) and return their folder, `out`/toy_<kind>, with a `toy.json`.

    The files depend only on the numbers (at least 1 scene, 2 rooms) and the light's colour. `workers` are processes
    (None: one for each core). A folder that was made with the same settings remains unchanged.

    Raises:
        DataError: the kind is unknown, a number is out of its range, or the folder holds something else.
        DiskError: the disk is full.
    """
    if kind not in KINDS:
        raise DataError(f"no toy data of kind {kind!r}; there are: {', '.join(KINDS)}")
    folder = out / f"toy_{kind}"
    rooms = kind == "rooms"
    rules = {"scenes": Range(1 + rooms), "frames": Range(2, MOST_FRAMES), "size": Range(8)}
    for name, rule in rules.items():
        unfit = violations(Annotated[int, rule], numbers[name])  # type: ignore[literal-required]
        if unfit:
            raise DataError(f"{folder.name}: {name}={unfit[0].value}: {unfit[0].reason}")
    parameters: dict[str, Any] = {"format": FORMAT_VERSION, **numbers}
    if tuple(light) != WHITE:
        parameters["light"] = list(light)
    if category_writers.is_written(folder / DESCRIPTION, parameters):
        if progress:
            Console().print(f"{folder} already holds these scenes")
        return folder
    out.mkdir(parents=True, exist_ok=True)
    with FileLock(out / f".{folder.name}.lock"):
        if not category_writers.is_written(folder / DESCRIPTION, parameters):  # by another process
            _write_all(folder, parameters, workers, progress)
    return folder


def _write_all(folder: Path, parameters: Mapping[str, Any], workers: int | None, progress: bool) -> None:
    rooms = folder.name == "toy_rooms"
    scenes = parameters["scenes"]
    light = parameters.get("light", WHITE)
    sizes = {name: parameters[name] for name in ("frames", "size", "seed")}
    with atomic_folder(folder) as unfinished:
        write_one: Callable[..., Any] = _write_clip if rooms else partial(_write_scene, category=folder.name)
        write_one = partial(write_one, unfinished, **sizes, light=np.array(light, float))
        written = map_in_processes(write_one, list(enumerate(_splits(scenes, rooms))), workers)
        results = list(track(written, f"Rendering {folder.name}", scenes, disable=not progress))
        if not rooms:
            _write_lists(unfinished, results)
        (unfinished / DESCRIPTION).write_text(json.dumps(parameters, indent=1) + "\n")


write_objects = partial(write, "objects")
write_rooms = partial(write, "rooms")
