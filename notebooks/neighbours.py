"""Views near a photo's, drawn from scenes of that photo, against true photos (experiments.md, "Anything").

python notebooks/neighbours.py CAPTURES WEIGHTS ... [depth_after=4] [size=256] [sheet=FILE]

CAPTURES are folders with transforms.json, whose first photo is the reference, and the views within 30 degrees of it, as
seen from the object, are scored on all pixels. The object has the size of the reference's mask, if there is one. The
copy, and the copy on a plane at the object's depth, are the rivals. With `size`, larger than the weights' images, views
are drawn and scored at this size, also of scenes whose fronts have the photo's detail (`fit_detail`).
"""

import statistics
import sys
import time
from dataclasses import replace
from functools import partial

import torch
from PIL import Image
from torch.nn import functional

import completesplat
from completesplat.data.captures.capture_set import CaptureSetDataModule
from completesplat.data.placement import OBJECT_HALF_SIZE
from completesplat.errors import DataError
from completesplat.export.images import to_pixels
from completesplat.geometry.cameras import crop_resize, invert_rigid, nearest_to_axes, transform_points
from completesplat.metrics.images import psnr
from completesplat.rasterizers.front_detail import fit_detail, front_targets, seen_larger
from completesplat.rasterizers.selection import auto
from completesplat.sampling_settings import Sampling

LEAST, MOST, VIEWS, ROUNDS = 1.0, 30.0, 8, (0, 40)  # degrees from the reference, views of an object, `color_fits`
rasterizer = auto()


def on_a_plane(image, camera, depth, targets):
    """Return the reference image on a plane at a depth, as other cameras see it; its edge goes on outside."""
    height, width = image.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3)
    views = []
    for intrinsics, pose in zip(targets.intrinsics, invert_rigid(targets.world_to_camera), strict=True):
        rays = pixels @ torch.linalg.inv(intrinsics).T @ pose[:3, :3].T
        points = pose[:3, 3] + ((depth - pose[2, 3]) / rays[:, 2])[:, None] * rays
        seen = points @ camera.intrinsics.T
        grid = 2 * seen[:, :2] / seen[:, 2:] / torch.tensor([width, height]) - 1
        grid = grid.view(1, height, width, 2)
        views.append(functional.grid_sample(image[None], grid, padding_mode="border", align_corners=False)[0])
    return torch.stack(views)


def near_views(sequence):
    """Return images and cameras of the reference and its neighbours, in its frame and the model's units, and depth."""
    cameras = sequence.cameras
    center = nearest_to_axes(cameras)
    directions = functional.normalize(cameras.centers - center, dim=-1)
    angles = torch.rad2deg(torch.acos((directions @ directions[0]).clamp(-1, 1)))
    near = [view for view in range(len(angles)) if LEAST < angles[view] <= MOST]
    near = [0, *near[:: max(1, len(near) // VIEWS)][:VIEWS]]
    depth, scale = transform_points(cameras.world_to_camera[0], center[None])[0, 2].item(), 1.0
    mask = sequence.read(0).mask
    if mask is not None:
        rows, columns = torch.where(mask[0] > 127)
        extent = 1 + max(values.max() - values.min() for values in (rows, columns)).item()
        scale = OBJECT_HALF_SIZE / (extent / 2 / cameras.intrinsics[0, 0, 0].item() * depth)
    chosen = cameras.scale_world(torch.tensor(scale, dtype=torch.float64))[torch.tensor(near)]
    poses = (chosen.world_to_camera @ invert_rigid(chosen.world_to_camera[0])).float()
    images = torch.stack([sequence.read(view).image for view in near]).float() / 255
    return images, replace(chosen, world_to_camera=poses, intrinsics=chosen.intrinsics.float()), depth * scale


def resized(images, size):
    return functional.interpolate(images, (size, size), mode="area")


def photo_at(image, size):
    return resized(image[None], size)[0]


def placed_objects(root, size):
    """Yield name, photos, cameras and depth of each capture that has neighbours (`near_views`), and print errors."""
    data = CaptureSetDataModule(root, test_fraction=1, val_fraction=0, image_size=size, batch_size=1)
    data.setup("test")
    source = data.source("test")
    for name in source.names:
        try:
            images, cameras, depth = near_views(source.read(name))
        except DataError as error:
            print(error)
            continue
        if len(images) > 1:
            yield name, images, cameras, depth


def main():
    words = dict(word.split("=") for word in sys.argv[2:] if "=" in word)
    models = {name: completesplat.CompleteSplat.from_pretrained(name) for name in sys.argv[2:] if "=" not in name}
    least, size = (of(model.image_size for model in models.values()) for of in (min, max))
    if "size" in words:
        least = size = int(words["size"])
    scores, sheet, seconds = {}, [], []
    for _, images, cameras, depth in placed_objects(sys.argv[1], size):
        drawn = {"copy": images[:1].expand_as(images), "plane": on_a_plane(images[0], cameras[0], depth, cameras)}
        for weights, model in models.items():
            before, after = 1.0, float(words.get("depth_after", 4))
            depth_range = torch.tensor([[max(0.1, depth - before), depth + after]])
            for rounds in ROUNDS:
                with torch.no_grad():
                    seen, views = resized(images, model.image_size), crop_resize(cameras, 0, 0, size, model.image_size)
                    scene = model.generate(seen[:1], views[:1], depth_range, Sampling(color_fits=rounds))
                    background = 0.5 if model.background is None else model.background
                    if "size" not in words:
                        drawn[f"{weights}, {rounds} rounds"] = rasterizer(scene, views[None]).over(background)[0]
                        continue
                    targets = front_targets(views[:1], partial(photo_at, images[0]), size)
                    began = time.process_time()
                    detailed = fit_detail(scene, views[:1], targets, rasterizer, background)
                    seconds.append(time.process_time() - began)
                    scenes = {"": seen_larger(scene, views[:1], cameras[:1]), ", detail": detailed}
                    for kind, scene in scenes.items():
                        drawn[f"{weights}, {rounds} rounds{kind}"] = rasterizer(scene, cameras[None]).over(background)[
                            0
                        ]
        images = resized(images, least)
        drawn = {method: resized(views, least) for method, views in drawn.items()}
        for method, views in drawn.items():
            front, novel = psnr(views[:1], images[:1]).item(), psnr(views[1:], images[1:]).mean().item()
            scores.setdefault(method, []).append((front, novel))
        sheet.append(torch.cat([views[view] for views in (images, *drawn.values()) for view in (0, 1, -1)], -1))
    rivals = [max(copy, plane) for (_, copy), (_, plane) in zip(scores["copy"], scores["plane"], strict=True)]
    for method, rows in scores.items():
        front, novel = zip(*rows, strict=True)
        above = sum(ours > rival for ours, rival in zip(novel, rivals, strict=True))
        text = f"input view: median {statistics.median(front):.2f}, worst {min(front):.2f} dB; "
        rest = f"mean {statistics.mean(novel):.2f} dB, {above} of {len(rows)} above both rivals"
        print(f"{method}: {text}neighbours: {rest}")
    if seconds:
        print(f"detail: {statistics.mean(seconds):.2f} CPU seconds a scene")
    if "sheet" in words:
        Image.fromarray(to_pixels(torch.cat(sheet, -2))).save(words["sheet"])


if __name__ == "__main__":
    main()
