"""Writer of toy objects as a category in CO3D v2's layout, with every file that its reader expects."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from completesplat.data.co3d.annotations import sequence_annotation, viewpoint, write_annotations, write_points
from completesplat.data.images.files import save_image
from completesplat.data.toy.disk import write_once, write_scenes
from completesplat.data.toy.mini_scene import draw_mini
from completesplat.data.toy.object_scene import ToyScene, draw_scene, render_frame
from completesplat.data.toy.raytracing import Array

FRAMES_PER_SECOND = 10.0
DRAW: dict[str, Callable[[np.random.Generator, int], ToyScene]] = {
    "toy_objects": draw_scene,
    "toy_minis": draw_mini,
    "toy_marked_minis": partial(draw_mini, marked=True),
}
"""Functions that draw a scene, by category: (random generator, number of frames) -> scene."""
SUBSET = "fewview_train"

Annotations = tuple[str, list[dict[str, Any]], dict[str, Any]]


def _write_frame(
    folder: Path, category: str, name: str, scene: ToyScene, frame: int, size: int, split: str
) -> dict[str, Any]:
    stem = f"frame{frame + 1:06d}"
    files = {
        "image": f"{name}/images/{stem}.jpg",
        "mask": f"{name}/masks/{stem}.png",
        "depth": f"{name}/depths/{stem}.jpg.geometric.png",
        "depth_mask": f"{name}/depth_masks/{stem}.png",
    }
    image, coverage, depth = render_frame(scene, frame, size)
    picture, mask = _to_bytes(image), _to_bytes(coverage)
    save_image(Image.fromarray(picture), folder / files["image"], quality=95, subsampling=0)
    save_image(Image.fromarray(mask), folder / files["mask"])
    # CO3D stores depth as a 16-bit image whose bits are float16, in units of `scale_adjustment`.
    save_image(Image.fromarray(depth.astype(np.float16).view(np.uint16)), folder / files["depth"])
    save_image(Image.fromarray(np.full_like(mask, 255)), folder / files["depth_mask"])
    paths = {key: f"{category}/{path}" for key, path in files.items()}
    return {
        "sequence_name": name,
        "frame_number": frame,
        "frame_timestamp": frame / FRAMES_PER_SECOND,
        "image": {"path": paths["image"], "size": [size, size]},
        "mask": {"path": paths["mask"], "mass": float(coverage.sum())},
        "depth": {"path": paths["depth"], "scale_adjustment": scene.unit, "mask_path": paths["depth_mask"]},
        "viewpoint": _viewpoint(scene, frame),
        "meta": {"frame_type": f"{split}_known"},
    }


def _to_bytes(values: Array) -> Any:
    return np.round(255 * values.clip(0, 1)).astype(np.uint8)


def _viewpoint(scene: ToyScene, frame: int) -> dict[str, Any]:
    """Return a frame's viewpoint in a world with the scene's own unit and origin."""
    world_to_camera = np.linalg.inv(scene.camera_to_world[frame])
    rotation = world_to_camera[:3, :3]
    translation = scene.unit * world_to_camera[:3, 3] - rotation @ scene.origin
    focal = float(1 / np.tan(np.radians(scene.fov_degrees) / 2))
    return viewpoint(rotation, translation, [focal, focal], [0.0, 0.0])


def write_objects(
    out: Path,
    scenes: int,
    frames: int,
    size: int,
    seed: int,
    workers: int | None = None,
    progress: bool = True,
    category: str = "toy_objects",
) -> Path:
    """Write `scenes` sequences of `frames` square images with masks, depth, point clouds and annotations.

    The subset `fewview_train` splits the sequences: about 85 % train, 5 % val, 10 % test. `<seq>/toy.json` reveals the
    family and the colour of the patch on the back. See `write_once` for the numbers; `workers` are processes (None: one
    for each core). Return the folder of the category (a key of `DRAW`).
    """

    def fill(folder: Path) -> None:
        write = partial(_write_scene, folder, category, frames, size, seed)
        _write_lists(folder, write_scenes(write, _splits(scenes), workers, category, progress))

    return write_once(out / category, fill, progress, 1, scenes=scenes, frames=frames, size=size, seed=seed)


def _splits(scenes: int) -> list[str]:
    """Return the split of every sequence in order; with at least three scenes, each split has one or more."""
    test = max(1, round(0.1 * scenes)) if scenes > 1 else 0
    val = max(1, round(0.05 * scenes)) if scenes > 2 else 0
    return ["train"] * (scenes - val - test) + ["val"] * val + ["test"] * test


def _write_scene(root: Path, category: str, frames: int, size: int, seed: int, place: tuple[int, str]) -> Annotations:
    """Write one sequence, drawn from a separate random generator, and return its split and annotations."""
    index, split = place
    scene = DRAW[category](np.random.default_rng([seed, index]), frames)
    name = f"{index:05d}_{scene.family}"
    for folder in ("images", "masks", "depths", "depth_masks"):
        (root / name / folder).mkdir(parents=True)
    annotations = [_write_frame(root, category, name, scene, frame, size, split) for frame in range(frames)]
    points = scene.unit * scene.points + scene.origin
    write_points(root / name / "pointcloud.ply", points, _to_bytes(scene.point_colors))
    hidden = {"family": scene.family, "patch_color": scene.patch_color}
    (root / name / "toy.json").write_text(json.dumps(hidden) + "\n")
    return split, annotations, sequence_annotation(category, name, len(points))


def _write_lists(category: Path, written: list[Annotations]) -> None:
    lists: dict[str, list[list[Any]]] = {"train": [], "val": [], "test": []}
    for split, frames, _ in written:
        lists[split] += [[f["sequence_name"], f["frame_number"], f["image"]["path"]] for f in frames]
    annotations = [frame for _, frames, _ in written for frame in frames]
    write_annotations(category, annotations, [sequence for _, _, sequence in written], SUBSET, lists)
