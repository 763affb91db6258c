"""Picture of scanned things from eight sides, beside the truth (card of `general`).

python notebooks/things.py SCANS WEIGHTS OUT.jpg [seed=0] [count=10]

SCANS is a folder of captures with `splits.json`. Each of `count` test objects, drawn by the seed, has two rows: the
photo and seven other views, from those near the photo to those from behind, and below them one sample of WEIGHTS.
"""

import random
import sys

import torch
from PIL import Image

import completesplat
from completesplat.data.captures.capture_set import CaptureSetDataModule
from completesplat.export.images import to_pixels
from completesplat.rasterizers.selection import auto

SHOWN = 8


def rows_of(name, data, model, rasterizer):
    """Return the truth and one sample of an object, each [view 3 height width]."""
    store = data.store("test")
    sequence = store.source.read(name)
    scene = store.scene(sequence, 0, list(range(1, len(sequence.frames))))
    views = scene.all_views()
    places = torch.nn.functional.normalize(sequence.cameras.centers, dim=-1)
    order = (places @ places[0]).argsort(descending=True)
    chosen = order[torch.linspace(0, len(order) - 1, SHOWN).round().long()]
    views = views[chosen]
    batch = [part[None] for part in (scene.reference.images, scene.reference.cameras, scene.depth_range)]
    with torch.no_grad():
        gaussians = model.generate(*batch)
        background = 0.5 if model.background is None else model.background
        drawn = rasterizer(gaussians, views.cameras[None]).over(background)[0].clamp(0, 1)
    return views.images, drawn


def main(root, weights, out, *words):
    """Write the picture."""
    settings = dict(word.split("=") for word in words)
    model = completesplat.CompleteSplat.from_pretrained(weights)
    depths = model.depths_of_training()
    data = CaptureSetDataModule(root, image_size=model.image_size, batch_size=1, **depths)
    data.setup("test")
    names = sorted(data.store("test").names)
    chosen = random.Random(int(settings.get("seed", 0))).sample(names, int(settings.get("count", 10)))
    rasterizer = auto()
    strips = []
    for name in chosen:
        for images in rows_of(name, data, model, rasterizer):
            strips.append(torch.cat(list(images), dim=-1))
        print(name, flush=True)
    Image.fromarray(to_pixels(torch.cat(strips, dim=-2))).save(out, quality=88)


if __name__ == "__main__":
    main(*sys.argv[1:])
