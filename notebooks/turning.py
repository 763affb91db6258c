"""A photo that turns: the picture at the top of the README.

python notebooks/turning.py PHOTO OUT.webp [SIDE] [DEGREES]

The photo stands beside one sample by the weights that `predict` would take, which turns to both sides and back.
"""

import math
import sys

import torch
from PIL import Image

import completesplat
from completesplat.export.images import to_pixels
from completesplat.export.placed_scene import PlacedScene
from completesplat.export.subject import subject_of
from completesplat.geometry.trajectories import turned
from completesplat.rasterizers.selection import auto

FRAMES = 36
MILLISECONDS = 90
QUALITY = 65


def main(name, out, side="320", degrees="35"):
    """Write the animation, an endless loop."""
    model = completesplat.CompleteSplat.for_photo(name)
    photo = model.read(name)
    size = model.front_size(photo, int(side))
    camera = model.camera(photo, size)
    (scene,) = model(photo, detail=size)
    rasterizer = auto()
    pivot = subject_of(PlacedScene(scene, camera, model.up), rasterizer).center
    angles = torch.sin(torch.arange(FRAMES) / FRAMES * 2 * math.pi) * math.radians(float(degrees))
    cameras = turned(camera, pivot, model.up, angles)
    background = 0.5 if model.background is None else model.background
    still = photo.square_at(size)
    images = []
    for i in range(FRAMES):
        with torch.no_grad():
            view = rasterizer(scene[None], cameras[i : i + 1][None]).over(background)[0, 0].clamp(0, 1)
        images.append(Image.fromarray(to_pixels(torch.cat([still, view], dim=-1))))
    images[0].save(
        out, save_all=True, append_images=images[1:], duration=MILLISECONDS, loop=0, quality=QUALITY, method=6
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
