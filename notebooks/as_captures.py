"""Write sequences of any data set of objects as captures, which then train together (experiments.md, "Anything").

python notebooks/as_captures.py OUT PREFIX FRAMES SPLITS data=NAME data.root=ROOT ...

OUT/PREFIXname gets `images`, `masks` and `transforms.json` of at most FRAMES frames, evenly spread, of each sequence of
SPLITS (train,val,test). Images have `data.image_size` pixels. `points.ply` has six points, from which the object gets
the centre and size that it has in the data set.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import completesplat
from completesplat.data.placement import OBJECT_HALF_SIZE, upright_axes
from completesplat.geometry.cameras import invert_rigid

QUALITY = 92
PLY = "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\nend_header\n"


def center_of(sequence, depth_after):
    """Return the object's centre [3]: in each camera its depth is the far end of the depth range less `depth_after`.

    Of many such points, as for cameras on a level circle, it is the one nearest to the origin.
    """
    poses = sequence.cameras.world_to_camera
    depths = sequence.depth_ranges[:, 1].double() - depth_after
    return torch.linalg.lstsq(poses[:, 2, :3], (depths - poses[:, 2, 3])[:, None], driver="gelsd").solution[:, 0]


def write_frame(folder, number, image, camera):
    """Write one image and its mask, and return its entry in `transforms.json`."""
    names = f"images/{number:03d}.jpg", f"masks/{number:03d}.png"
    Image.fromarray(image.image.permute(1, 2, 0).numpy()).save(folder / names[0], quality=QUALITY)
    Image.fromarray(image.mask[0].numpy()).save(folder / names[1], optimize=True)
    pose = invert_rigid(camera.world_to_camera)
    pose[:3, 1:3] *= -1  # OpenGL's axes
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    return {"file_path": names[0], "mask_path": names[1], **lens, "transform_matrix": pose.tolist()}


def write_capture(sequence, center, folder, most):
    """Write at most so many frames of a sequence, and the ends of the object's upright axes as points."""
    count = len(sequence.frames)
    chosen = sorted({part * count // most for part in range(most)}) if count > most else range(count)
    cameras = [sequence.cameras[index] for index in chosen]
    for kind in ("images", "masks"):
        (folder / kind).mkdir(parents=True)
    frames = [write_frame(folder, k, sequence.read(k), camera) for k, camera in zip(chosen, cameras, strict=True)]
    axes = OBJECT_HALF_SIZE * upright_axes(cameras).T
    points = [" ".join(map(repr, point)) for point in (center.numpy() + np.concatenate([axes, -axes])).tolist()]
    (folder / "points.ply").write_text(PLY.format(len(points)) + "\n".join(points) + "\n")
    height, width = sequence.cameras.image_size
    capture = {"camera_model": "PINHOLE", "w": width, "h": height, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(capture) + "\n")


def main(out, prefix, most, splits, *settings):
    """Write captures as the words of the command say."""
    data, _ = completesplat.instantiate(completesplat.compose("fit", *settings))
    for split in splits.split(","):
        source = data.open(split)[split]
        for name in source.names:
            sequence = source.read(name)
            center = center_of(sequence, data.framing.depth_after)
            write_capture(sequence, center, Path(out, prefix + name), int(most))
        print(len(source.names), "captures of", split)


if __name__ == "__main__":
    main(*sys.argv[1:])
