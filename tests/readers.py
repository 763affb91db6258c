"""Readers of files that may be damaged: an intact input of each, and how all of it is read."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import meshes
import numpy as np
import pytest
from co3d_trees import CATEGORY, SUBSET
from co3d_trees import write_tree as write_category
from latent_caches import rooms, small_autoreconstructor, sound_rooms
from PIL import Image
from pretrained_vaes import build, random_vae
from published_weights import write_published
from realestate10k_trees import StoredClip, make_clip, module, write_chunk_form, write_text_form
from splats_of_others import SCENE
from support import change_json, some_gaussians, write_capture

from completesplat.baselines.splatter_image.model import find_published, read_tensors
from completesplat.data.captures.module import CaptureDataModule
from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.loading.latent_cache import LatentCache
from completesplat.data.rendered.rendering import render
from completesplat.data.sequences import SequenceSource
from completesplat.errors import DataError, refused_to
from completesplat.export.ply import write_ply
from completesplat.export.reading import read_gaussians
from completesplat.gaussians import Gaussians
from completesplat.ply_files import read_vertices
from completesplat.training.encoding import FrameEncoder, encode_training_set
from completesplat.viewer.sample import read_newest, read_scene

Damage = Callable[[Path], object]
CLIPS = [make_clip(key, frames=4) for key in ("bad", "one", "two")]
VAE = random_vae()
INTRINSICS = [[50, 0, 16], [0, 50, 16], [0, 0, 1]]
CAMERA = {"world_to_camera": np.eye(4).tolist(), "intrinsics": INTRINSICS, "image_size": [32, 32]}
UP = [0, -1, 0]


class Usable(NamedTuple):
    """Frames that were read, by sequence and number, and what was refused."""

    frames: set[tuple[str, int]]
    refused: list[DataError]


class Reader(NamedTuple):
    """How an input is written into a folder and read from there."""

    write: Callable[[Path], object]
    read: Callable[[Path], object]


def read_frames(source: SequenceSource) -> Usable:
    """Read every frame of a source."""
    result = Usable(set(), list(source.refused))
    for name in source.names:
        with refused_to(result.refused.append, sequence=name):
            sequence = source.read(name)
            for index, frame in enumerate(sequence.frames):
                with refused_to(result.refused.append, sequence=name, frame=frame):
                    sequence.read(index)
                    result.frames.add((name, frame))
    return result


def write_co3d(folder: Path) -> None:
    """Write training sequences a and b, c for validation, d for testing, of four frames each."""
    write_category(folder, dict.fromkeys("abcd", 4), {"train": "ab", "val": "c", "test": "d"})


def read_co3d(folder: Path) -> Usable:
    settings = {"image_size": 8, "batch_size": 1, "targets": 3}
    return read_frames(CO3DDataModule(str(folder), CATEGORY, SUBSET, **settings).open("train")["train"])


def write_texts(folder: Path, clips: list[StoredClip] = CLIPS) -> None:
    write_text_form(folder / "train", clips)


def write_chunks(folder: Path, clips: list[StoredClip] = CLIPS) -> None:
    """Write one clip a chunk, the one that will be damaged in the first."""
    write_chunk_form(folder / "train", clips, clips_per_chunk=1)


def read_rooms(folder: Path) -> Usable:
    sources = module(folder, val_fraction=0.0).open("train")
    sources["train"].names += sources["val"].names
    return read_frames(sources["train"])


def write_transforms(folder: Path) -> None:
    """Write a capture of eight images with its lens in `transforms.json`."""
    write_capture(folder, 8)
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    del content["camera_angle_x"]
    path.write_text(json.dumps({"fl_x": 19, "fl_y": 19.5, "cx": 8, "cy": 6, "w": 16, "h": 12, **content}))


def write_model(folder: Path) -> None:
    """Write a capture of six images, and a binary model by COLMAP itself."""
    pycolmap = pytest.importorskip("pycolmap")
    write_capture(folder / "images", 6)
    (folder / "sparse/0").mkdir(parents=True)
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 20.0, 16, 12)
    reconstruction.add_camera_with_trivial_rig(camera)
    for number in range(6):
        image = pycolmap.Image()
        image.name, image.camera_id, image.image_id = f"frame{number}.png", 1, number + 1
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), [0, 0, number]))
    for number in range(3):
        reconstruction.add_point3D(np.full(3, float(number)), pycolmap.Track(), np.full(3, 9, dtype=np.uint8))
    reconstruction.write_binary(str(folder / "sparse/0"))


def read_capture(folder: Path) -> Usable:
    return read_frames(CaptureDataModule(str(folder), image_size=8).source("train"))


def write_latents(folder: Path) -> None:
    root = sound_rooms(folder.with_name("rooms"))
    encode_training_set(FrameEncoder(small_autoreconstructor()), rooms(root), folder, progress=False)


def read_latents(folder: Path) -> list[list]:
    (store_folder,) = (path.parent for path in folder.rglob("manifest.json"))
    store = LatentCache(store_folder)
    scenes = [store.scene(name, frame) for name, sequence in store.sequences.items() for frame in sequence.stored]
    return [[part.tolist() for part in (scene.mean, scene.log_variance, scene.condition)] for scene in scenes]


def write_prediction(folder: Path) -> None:
    """Write a sample, its description, and the description of a run with it."""
    write_ply(folder / "sample_00.ply", SCENE)
    description = {"reference_camera": CAMERA, "settings": {"up": UP}}
    (folder / "scene.json").write_text(json.dumps(description))
    rows = [{"file": "sample_00.ply", "scene": "a", "reference_camera": CAMERA}]
    (folder / "scenes.json").write_text(json.dumps({"step": 3, "up": UP, "scenes": rows}))


def read_only_file(folder: Path) -> Gaussians:
    (path,) = folder.iterdir()
    return read_gaussians(path)


def write_meshes(folder: Path) -> None:
    """Write a triangle in a folder of meshes, private files beside it, and a program that stands in for Blender."""
    (folder / "outside").mkdir()
    Image.new("RGB", (8, 8), (200, 40, 40)).save(folder / "outside/private.png")
    (folder / "outside/private.mtl").write_text("newmtl m\n")
    (folder / "meshes/sub").mkdir(parents=True)
    meshes.write_stand_in(folder)


def read_meshes(folder: Path) -> None:
    """Render meshes; those that are taken make the stand-in say that it has started."""
    quick = meshes.SETTINGS | {"views": 2, "size": 16, "samples": 1, "workers": 1, "max_minutes": 0.1}
    render(str(folder / "meshes"), out=folder / "data", blender=str(folder / "blender"), **quick)


READERS = {
    "co3d": Reader(write_co3d, read_co3d),
    "texts": Reader(write_texts, read_rooms),
    "chunks": Reader(write_chunks, read_rooms),
    "transforms": Reader(write_transforms, read_capture),
    "colmap": Reader(write_model, read_capture),
    "latents": Reader(write_latents, read_latents),
    "vae": Reader(VAE.save_pretrained, lambda folder: build(str(folder))),
    "published": Reader(
        lambda folder: write_published(folder, "hydrants"),
        lambda folder: read_tensors(find_published(str(folder / "model_hydrants.pth")).weights),
    ),
    "prediction": Reader(write_prediction, read_scene),
    "newest": Reader(write_prediction, read_newest),
    "ply": Reader(
        lambda folder: write_ply(folder / "a.ply", some_gaussians(1)[0]), lambda f: read_vertices(f / "a.ply", "xyz")
    ),
    "splats": Reader(lambda folder: write_ply(folder / "a.ply", SCENE), read_only_file),
    "meshes": Reader(write_meshes, read_meshes),
}


def edit(file: str, edit_content: Callable[[Any], object]) -> Damage:
    """Edit a (gzipped) JSON file."""
    return lambda folder: change_json(folder / file, edit_content)


def put(file: str, keys: str, value: object) -> Damage:
    """Set a value in a JSON file at keys that are joined by dots, or remove it (...)."""
    *path, last = [int(key) if key.isdecimal() else key for key in keys.split(".")]

    def edit_content(content: Any) -> None:
        for key in path:
            content = content[key]
        if value is ...:
            del content[last]
        else:
            content[last] = value

    return edit(file, edit_content)
