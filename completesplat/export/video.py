"""Rendered frames as a video that every browser plays."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.export.atomic import atomic_path
from completesplat.export.pixels import enlarge, to_bytes

SMALLEST_SIDE = 256


def write_video(path: str | Path, frames: Float[Tensor, "frame 3 height width"], fps: int = 24) -> None:
    """Write an H.264 `.mp4` (yuv420p) of images (sRGB, 0 to 1).

    Small images are enlarged by a whole factor until their shorter side has at least 256 px. H.264 halves the
    colour resolution, which needs even sizes: an odd side gets its last row or column once more.

    Raises:
        ValueError: no frames, frames that are not finite, or a path that does not end in `.mp4`.
    """
    import imageio.v2 as imageio

    if len(frames) == 0 or Path(path).suffix != ".mp4":
        raise ValueError(f"{path}: a video needs at least one frame and a name that ends in .mp4")
    height, width = frames.shape[-2:]
    factor = -(-SMALLEST_SIDE // min(height, width))
    tall, wide = height * factor, width * factor
    with atomic_path(path) as temporary:
        options = {"codec": "libx264", "quality": 8, "pixelformat": "yuv420p", "macro_block_size": 2}
        with imageio.get_writer(temporary, format="FFMPEG", fps=fps, **options) as writer:  # type: ignore[arg-type]
            for frame in frames:
                large = enlarge(frame, factor)
                padded = torch.nn.functional.pad(large[None], (0, wide % 2, 0, tall % 2), mode="replicate")[0]
                writer.append_data(to_bytes(padded))  # type: ignore[attr-defined]
