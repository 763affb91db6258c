"""Borders that are continued around a photo that is no square, against the true square (experiments.md, "Borders").

python notebooks/borders.py CAPTURES WEIGHTS [share=0.75] [depth_after=3]

CAPTURES are as of `neighbours.py`. Of each square reference, the columns in the middle (`share` of them) are the
photo. Each method makes a square of it, and of that a scene with 40 rounds of fitting. Scores are of the photo in
the input view, and of the neighbours within 30 degrees, on all pixels.
"""

import statistics
import sys

import numpy as np
import torch
from neighbours import placed_objects, resized
from PIL import Image, ImageFilter

import completesplat
from completesplat.geometry.cameras import crop_resize
from completesplat.metrics.images import psnr
from completesplat.rasterizers.selection import auto
from completesplat.sampling_settings import Sampling

ROUNDS = 40
rasterizer = auto()


def copied(photo, side):
    """Repeat the photo's first and last column."""
    return np.pad(photo, ((0, 0), (side, side), (0, 0)), mode="edge")


def blurred(photo, side, widest=0.5):
    """Repeat the first and last column, blurred along the edge the more, the farther they are from the photo."""
    whole = copied(photo, side)
    image = Image.fromarray(whole)
    for distance in range(side):
        soft = np.asarray(image.filter(ImageFilter.GaussianBlur((0, widest * (distance + 1)))))
        for column in (side - 1 - distance, whole.shape[1] - side + distance):
            whole[:, column] = soft[:, column]
    return whole


def averaged(photo, side, columns=4):
    """Repeat the mean of the outermost columns, blurred as above."""
    first, last = (photo[:, part].mean(1, keepdims=True) for part in (slice(columns), slice(-columns, None)))
    soft = np.concatenate([first, photo[:, 1:-1], last], 1).round().astype(np.uint8)
    whole = blurred(soft, side)
    whole[:, side : side + photo.shape[1]] = photo
    return whole


def reflected(photo, side):
    """Mirror the photo at its edges."""
    return np.pad(photo, ((0, 0), (side, side), (0, 0)), mode="symmetric")


def reflected_blurred(photo, side):
    """Mirror the photo at its edges, blurred."""
    whole = reflected(photo, side)
    soft = np.asarray(Image.fromarray(whole).filter(ImageFilter.GaussianBlur(photo.shape[0] / 24)))
    soft = soft.copy()
    soft[:, side : side + photo.shape[1]] = photo
    return soft


BORDERS = {
    "edges copied": copied,
    "edges copied and blurred": blurred,
    "edges averaged and blurred": averaged,
    "reflected": reflected,
    "reflected and blurred": reflected_blurred,
}


def scenes_of(model, image, camera, depth_range, side):
    """Yield names of methods, and the scenes that they make of the middle of an image (3 x size x size)."""
    size = image.shape[-1]
    own = torch.zeros(1, 1, size, size)
    own[..., side : size - side] = 1
    pixels = (image.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    fits = Sampling(color_fits=ROUNDS)
    inner = size - 2 * side
    cut = Image.fromarray(pixels[side : size - side, side : size - side]).resize((size, size), Image.Resampling.LANCZOS)
    middle = crop_resize(camera, side, side, inner, size)
    yield "the square's middle", model.generate(to_tensor(np.asarray(cut)), middle, depth_range, fits)
    for name, border in BORDERS.items():
        square = to_tensor(border(pixels[:, side : size - side], side))
        yield name, model.generate(square, camera, depth_range, fits, own=own)
    yield "border hidden", model.generate(image[None], camera, depth_range, fits, visible=own)
    yield "the true square", model.generate(image[None], camera, depth_range, fits, own=own)


def to_tensor(pixels):
    return torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1)[None].float() / 255


def main():
    words = dict(word.split("=") for word in sys.argv[3:])
    model = completesplat.CompleteSplat.from_pretrained(sys.argv[2])
    size = model.image_size
    side = round(size * (1 - float(words.get("share", 0.75))) / 2)
    background = 0.5 if model.background is None else model.background
    scores = {}
    for name, images, cameras, depth in placed_objects(sys.argv[1], size):
        depth_range = torch.tensor([[max(0.1, depth - 1), depth + float(words.get("depth_after", 3))]])
        images = resized(images, size)
        cameras = crop_resize(cameras, 0, 0, cameras.image_size[0], size)
        for method, scene in scenes_of(model, images[0], cameras[:1], depth_range, side):
            with torch.no_grad():
                views = rasterizer(scene, cameras[None]).over(background)[0]
            front = psnr(views[:1, ..., side : size - side], images[:1, ..., side : size - side]).item()
            scores.setdefault(method, []).append((front, psnr(views[1:], images[1:]).mean().item()))
        print(name, *(f"{rows[-1][0]:.2f}/{rows[-1][1]:.2f}" for rows in scores.values()), flush=True)
    for method, rows in scores.items():
        front, novel = (statistics.mean(values) for values in zip(*rows, strict=True))
        print(f"| {method} | {front:.2f} | {novel:.2f} |")


if __name__ == "__main__":
    main()
