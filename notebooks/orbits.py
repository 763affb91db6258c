"""Whether orbits keep an object in the frame that is off the middle of its photo (experiments.md, "Orbits").

python notebooks/orbits.py CAPTURES WEIGHTS [photos=10] [sheet=FILE]

CAPTURES are folders of objects with images and masks. Each photo is a first image, which goes on at two sides, so that
the object is in a corner. The box is that of the points that the scene's front shows within the mask without
its outline, without the hundredth at each end of each axis.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch.nn import functional

import completesplat
from completesplat.export.images import to_pixels
from completesplat.export.placed_scene import PlacedScene
from completesplat.export.subject import all_around, subject_of
from completesplat.export.video import render_views
from completesplat.geometry.cameras import pixel_rays, project
from completesplat.geometry.trajectories import orbit
from completesplat.photo.crop import continued
from completesplat.rasterizers.selection import auto

VIEWS, SHOWN = 24, (0, 3, 6, 12, 18)
rasterizer = auto()


def off_center(folder, number):
    """Return a photo with its object in a corner, and the object's mask in it."""
    image, mask = (np.asarray(Image.open(next(folder.glob(f"{kind}/00.*")))) for kind in ("images", "masks"))
    height, width = mask.shape[:2]
    widths = [
        (0, height // 3) if number % 2 else (height // 3, 0),
        (0, width // 2) if number // 2 % 2 else (width // 2, 0),
    ]
    if number % 3 == 0:
        widths = widths[::-1]
    mask = mask if mask.ndim == 2 else mask.max(-1)
    return np.pad(image, [*widths, (0, 0)], mode="edge"), np.pad(mask, widths)


def inner_part(mask, photograph):
    """Return a mask of a photo in its square without its outline, where depths are partly of what lies behind."""
    size = photograph.image.shape[-1]
    square = continued(Image.fromarray(mask), photograph.window).resize((size, size), Image.Resampling.BOX)
    outside = 1 - torch.from_numpy(np.array(square)).float()[None] / 255
    return 1 - functional.max_pool2d(outside, 3, stride=1, padding=1)[0]


def box_of(scene, camera, mask):
    """Return the eight corners of the box of what a scene's front shows within a mask."""
    with torch.no_grad():
        depth = rasterizer(scene[None], camera[None][None])[0, 0].surface_depth()[0]
    inside = (mask > 0.5) & (depth > 0)
    points = (pixel_rays(camera) * depth[..., None])[inside]
    ends = torch.quantile(points, torch.tensor([0.01, 0.99]), dim=0)
    return torch.cartesian_prod(*ends.T)


def main():
    words = dict(word.split("=") for word in sys.argv[3:])
    model = completesplat.CompleteSplat.from_pretrained(sys.argv[2])
    folders = sorted(path.parent for path in Path(sys.argv[1]).glob("*/masks"))
    count = int(words.get("photos", 10))
    rows = []
    for number, folder in enumerate(folders[:: len(folders) // count][:count]):
        image, mask = off_center(folder, number)
        photograph = model.read(image)
        seen = inner_part(mask, photograph)
        if not (seen > 0.5).any():
            print(f"{folder.name}: too thin")
            continue
        camera = model.camera(photograph)
        scene = model(photograph, color_fits=20, detail=model.image_size)[0]
        placed = PlacedScene(scene, camera, model.up, own=photograph.own_at(model.image_size))
        subject = subject_of(placed, rasterizer)
        cameras = orbit(all_around(camera, subject), subject.center, model.up, VIEWS)
        pixels, depths = project(cameras, box_of(scene, camera, seen).expand(VIEWS, 8, 3))
        within = (depths > 0) & ((pixels > 0) & (pixels < model.image_size)).all(-1)
        before = orbit(camera, torch.tensor([0.0, 0, subject.center[2].item()]), model.up, VIEWS)
        old, depths = project(before, box_of(scene, camera, seen).expand(VIEWS, 8, 3))
        old = (depths > 0) & ((old > 0) & (old < model.image_size)).all(-1)
        text = f"{within.all(-1).sum()} of {VIEWS} views hold the box, {within.float().mean():.1%} of its corners"
        print(
            f"{folder.name}: {text}; around the picture's middle {old.all(-1).sum()} views, {old.float().mean():.1%}",
            flush=True,
        )
        views, _ = render_views(rasterizer, scene, cameras[torch.tensor(SHOWN)], 0.5)
        rows.append(torch.cat([photograph.shown_at(model.image_size), *views], -1))
        if "sheet" in words:
            Image.fromarray(to_pixels(torch.cat(rows, -2))).save(words["sheet"])


if __name__ == "__main__":
    main()
