"""Means over the training images and cameras, or over an excerpt of large data sets."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from completesplat.data.loading.scenes import SceneStore
from completesplat.data.sequences import PosedSequence
from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras
from completesplat.photo.features import image_features

# A mean over all images of RealEstate10K's 66,033 training clips would take hours.
SEQUENCES = 400
IMAGES = 8192
# Fewer images suffice for the standard deviations of eight features.
FEATURE_IMAGES = 1024
SMALLEST_DEVIATION = 1e-3
LEAST_TURN = 0.1  # radians, root mean square; image axes that turn less show no horizon


class TypicalCamera(NamedTuple):
    """Mean horizontal field of view, near and far in scene units, up direction (unit vector in the camera frame)."""

    fov_degrees: float
    depth_range: tuple[float, float]
    up: tuple[float, float, float]


def typical_camera(sequences: Sequence[Cameras], depth_ranges: Sequence[Float[Tensor, "_ 2"]]) -> TypicalCamera:
    """Average over all cameras of all sequences, each of which is a batch [view]."""
    focal = torch.cat([cameras.intrinsics[:, 0, 0] for cameras in sequences])
    width = sequences[0].image_size[1]
    near, far = torch.cat(list(depth_ranges)).mean(dim=0).tolist()
    ups = torch.cat([cameras.world_to_camera[:, :3, :3] @ world_up(cameras) for cameras in sequences])
    x, y, z = torch.nn.functional.normalize(ups.mean(dim=0), dim=0).tolist()
    return TypicalCamera(2 * torch.atan(0.5 * width / focal).mean().rad2deg().item(), (near, far), (x, y, z))


def world_up(cameras: Cameras) -> Float[Tensor, "3"]:
    """Estimate the up direction of hand-held cameras [view] in world coordinates.

    People hold cameras level, so up is most nearly perpendicular to all horizontal image axes. Its sign follows the
    cameras' up directions (after `co3d_normalisation.py` of Splatter Image). If the cameras hardly turn, no horizon
    follows from them, and up is the mean of their up directions.
    """
    horizontal = cameras.world_to_camera[:, 0, :3]
    down = cameras.world_to_camera[:, 1, :3]
    _, singular_values, axes = torch.linalg.svd(horizontal)
    # One camera has no second value.
    if not (singular_values[1:2] > LEAST_TURN * len(horizontal) ** 0.5).any():
        return -torch.nn.functional.normalize(down.mean(dim=0), dim=0)
    return torch.where(down.mean(dim=0) @ axes[-1] > 0, -axes[-1], axes[-1])


def mean_camera(store: SceneStore) -> TypicalCamera:
    """Return the typical camera of the `excerpts`.

    Raises:
        DataError: none of their sequences can be read.
    """
    cameras = []
    depth_ranges = []
    for sequence, frames in excerpts(store):
        cameras.append(sequence.cameras[frames])
        depth_ranges.append(sequence.depth_ranges[frames])
    if not cameras:
        raise DataError("no training sequence can be read")
    return typical_camera(cameras, depth_ranges)


def mean_image(store: SceneStore, size: int) -> Float[Tensor, "3 {size} {size}"]:
    """Average the images of the frames that `mean_camera` takes. The mean is black if none can be read."""
    total = torch.zeros(3, size, size, dtype=torch.float64)
    count = 0
    for image in _images(store, IMAGES):
        total += image
        count += 1
    return (total / (255 * max(count, 1))).float()


def feature_moments(store: SceneStore) -> dict[str, list[float]]:
    """Return mean and standard deviation of `image_features` over about 1,024 images, if some can be read."""
    rows = [image_features(image.double() / 255) for image in _images(store, FEATURE_IMAGES)]
    if not rows:
        return {}
    features = torch.stack(rows)
    deviation = features.std(0, correction=0).clamp(min=SMALLEST_DEVIATION)
    return {"picture_mean": features.mean(0).tolist(), "picture_std": deviation.tolist()}


def _images(store: SceneStore, images: int) -> Iterator[UInt8[Tensor, "3 height width"]]:
    for sequence, frames in excerpts(store, images):
        for frame in frames:
            with suppress(DataError):
                yield store.image(sequence, frame)


def excerpts(store: SceneStore, images: int = IMAGES) -> Iterator[tuple[PosedSequence, list[int]]]:
    """Yield those of the first 400 sequences that can be read, each with evenly spaced frames.

    Together they have at most `images` frames. The store must have sequences, as those of `SceneDataSet.store` have.
    """
    names = store.names[:SEQUENCES]
    most = images // len(names)
    for name in names:
        with suppress(DataError):
            sequence = store.source.read(name)
            yield sequence, sorted({i * len(sequence.frames) // most for i in range(most)})
