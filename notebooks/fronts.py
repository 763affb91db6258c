"""How well scenes keep what the photo shows, before and after fitting (experiments.md, "Fronts").

python notebooks/fronts.py PHOTO ...                                 # with the nearest weights, as `predict` takes them
python notebooks/fronts.py weights=NAME experiment=... data=... ...  # a test set: input views and novel views
python notebooks/fronts.py detail=512 PHOTO ...                      # by `general`, without detail and with it
"""

import statistics
import sys
import time

import torch

import completesplat
from completesplat.metrics.images import psnr
from completesplat.photo.choice import match_shipped
from completesplat.rasterizers.front_detail import seen_larger
from completesplat.rasterizers.selection import auto
from completesplat.sampling_settings import Sampling

ROUNDS, rasterizer = (0, 2, 5, 10, 20, 40), auto()
models, results = {}, {rounds: [] for rounds in ROUNDS}


def model_of(name):
    """Return weights, which are opened once, and the grey value behind their scenes."""
    if name not in models:
        models[name] = completesplat.CompleteSplat.from_pretrained(name)
    return models[name], 0.5 if models[name].background is None else models[name].background


def score(images, cameras, depth_range, targets, model, background):
    """Note the PSNR of the reference view, and of the novel views if there are any, after each number of rounds."""
    for rounds in ROUNDS:
        scene = model.generate(images, cameras, depth_range, Sampling(color_fits=rounds))
        views = [(cameras[:, None], images[:, None]), *([(targets.cameras, targets.images)] if targets else [])]
        with torch.no_grad():
            rendered = [rasterizer(scene, view).over(background)[0] for view, _ in views]
        results[rounds].append(
            [psnr(ours, true[0]).mean().item() for ours, (_, true) in zip(rendered, views, strict=True)]
        )


def energy(image):
    """Return the sum of the mean squared differences of neighbouring pixels in rows and in columns."""
    return sum(image.diff(dim=axis).square().mean().item() for axis in (-1, -2))


def score_detail(name, detail):
    """Print PSNR and gradient energy over the photo's, at a size, of a photo's front without detail and with it."""
    model, background = model_of("general")
    photo = model.read(name)
    size = model.front_size(photo, detail)
    image, camera = photo.square_at(size)[None], model.camera(photo, size)[None, None]
    rows = []
    plain = model(photo, color_fits=40, detail=model.image_size)[0][None]
    began = time.process_time()
    detailed = model.detailed(plain, photo, size)[0][None]
    seconds = time.process_time() - began
    for scene in (seen_larger(plain, model.camera(photo)[None], camera[:, 0]), detailed):
        with torch.no_grad():
            view = rasterizer(scene, camera).over(background)[0]
        rows += psnr(view, image).item(), energy(view) / energy(image)
    results[0].append((*rows, detailed.count, seconds))
    text = "{:.2f} dB ({:.2f}); with detail {:.2f} dB ({:.2f})".format(*rows)
    print(
        f"{name.rpartition('/')[2]} at {size} px: {text}; {detailed.count:,} Gaussians, {seconds:.1f} CPU s", flush=True
    )


if sys.argv[1].startswith("detail="):
    for name in sys.argv[2:]:
        score_detail(name, int(sys.argv[1].removeprefix("detail=")))
    columns = list(zip(*results[0], strict=True))
    medians = ", ".join(f"{statistics.median(values):.2f}" for values in columns)
    print(f"medians of {len(results[0])}: {medians}; most Gaussians {max(columns[4]):,}, seconds {max(columns[5]):.1f}")
    sys.exit()
if sys.argv[1].startswith("weights="):
    model, background = model_of(sys.argv[1].removeprefix("weights="))
    settings = "data.workers=0", "data.evaluation_batch_size=1", *sys.argv[2:]
    data, _ = completesplat.instantiate(completesplat.compose("fit", *settings))
    data.setup("test")
    for batch in data.test_dataloader():
        reference = batch.reference
        score(reference.images, reference.cameras, batch.depth_range, batch.targets, model, background)
else:
    for name in sys.argv[1:]:
        model, background = model_of(next(iter(match_shipped(name))))
        photo = model.read(name)
        inputs = photo.image[None], model.camera(photo)[None], model.depth_range_of(photo)[None]
        score(*inputs, None, model, background)
for rounds, rows in results.items():
    front, *novel = zip(*rows, strict=True)
    text = (
        f"{rounds} rounds: {len(rows)} input views: median {statistics.median(front):.2f} dB, worst {min(front):.2f} dB"
    )
    print(text, *(f"novel views: mean {statistics.mean(values):.2f} dB" for values in novel), sep="; ")
