"""Photos of anything, turned a little: the picture of the README (experiments.md, "Anything").

python notebooks/anything.py FILE.png PHOTO ...
"""

import sys
from pathlib import Path

import torch

import completesplat
from completesplat.export.images import image_sheet, strip, write_png
from completesplat.export.placed_scene import PlacedScene
from completesplat.export.subject import subject_of
from completesplat.geometry.trajectories import orbit
from completesplat.rasterizers.selection import auto

STEP, SHOWN = 15, (-2, -1, 0, 1, 2)  # degrees, and steps from the photo's view
SIZE = 256  # pixels
model, rasterizer, rows = completesplat.CompleteSplat.from_pretrained("general"), auto(), []
for name in sys.argv[2:]:
    photo = model.read(name)
    camera = model.camera(photo, SIZE)
    (scene,) = model(photo, detail=SIZE)
    pivot = subject_of(PlacedScene(scene, camera, model.up), rasterizer).center
    cameras = orbit(camera, pivot, model.up, 360 // STEP)[torch.tensor(SHOWN)]
    with torch.no_grad():
        scenes = scene.map(lambda tensor: tensor.expand(len(SHOWN), *tensor.shape))
        views = rasterizer(scenes, cameras[:, None]).over(0.5)[:, 0].clamp(0, 1)
    rows.append(strip(torch.cat([photo.square_at(SIZE)[None], views]), Path(name).stem))
write_png(Path(sys.argv[1]), image_sheet(["photo", *(f"{STEP * step} degrees" for step in SHOWN)], rows))
