"""Toy objects on a turntable, photographed, cropped and enlarged photo by photo."""

from pathlib import Path

import numpy as np
from PIL import Image

from completesplat.data.toy.object_scene import ToyScene, draw_mini, render_frame
from completesplat.data.toy.shapes import CHECKS, rotation_about
from completesplat.photo.saving import to_uint8

SIZE, DISTANCE = 48, 3.6


def toy() -> ToyScene:
    """An ellipsoid with checks, a nose and a patch."""
    scene = draw_mini(np.random.default_rng(0), 2)
    textures = scene.shapes.textures.copy()
    textures[0], scene.shapes.colors[0, 1] = [CHECKS, 6, 0], 0.1
    return scene._replace(shapes=scene.shapes._replace(textures=textures), fov_degrees=20.0)


def draw(scene: ToyScene, azimuth: float) -> Image.Image:
    """The toy on white, from the level of its centre; the light comes from the camera's side, the axis is y."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_about("y", azimuth) @ np.diag([1, -1, -1])  # at azimuth 0 it looks along -z
    pose[:3, 3] = -DISTANCE * pose[:3, 2]
    light = scene.light._replace(place=rotation_about("y", azimuth) @ [0.5, 0.6, 0.62])
    moved = scene._replace(camera_to_world=pose[None], light=light)
    color, coverage, _ = render_frame(moved, 0, SIZE)
    return Image.fromarray(to_uint8(color + 0.5 * (1 - coverage[..., None])))  # the dome behind it is grey


def cropped(photo: Image.Image) -> Image.Image:
    """The object's box, enlarged until it fills the square."""
    left, top, right, bottom = Image.fromarray(np.asarray(photo).min(-1) < 245).getbbox()
    scale = SIZE / max(right - left, bottom - top)
    box = photo.crop((left, top, right, bottom))
    box = box.resize((round(scale * box.width), round(scale * box.height)), Image.Resampling.BICUBIC)
    square = Image.new("RGB", (SIZE, SIZE), "white")
    square.paste(box, ((SIZE - box.width) // 2, (SIZE - box.height) // 2))
    return square


def write_turn(folder: Path, azimuths: np.ndarray, crop: bool = True) -> None:
    folder.mkdir(parents=True)
    for index, azimuth in enumerate(azimuths):
        photo = draw(toy(), azimuth)
        (cropped(photo) if crop else photo).save(folder / f"photo {index}.png")
