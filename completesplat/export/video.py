"""Videos of finished scenes along camera paths, in a format that every browser plays."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.export.images import to_pixels
from completesplat.files import atomic_path
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer

SMALLEST_SIDE = 256
CHUNK = 8  # views that are rendered at a time
Frames = Float[Tensor, "frame 3 height width"]
DepthMaps = Float[Tensor, "frame 1 height width"]


@torch.no_grad()
def render_views(
    rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras, background: float
) -> tuple[Frames, DepthMaps]:
    """Return images of one unbatched scene from several cameras, and expected depths (0 where nothing is seen)."""
    images = []
    depths = []
    for start in range(0, len(cameras.world_to_camera), CHUNK):
        rendering = rasterizer(gaussians[None], cameras[start : start + CHUNK][None])
        images.append(rendering.over(background)[0])
        depths.append(rendering.expected_depth()[0])
    return torch.cat(images), torch.cat(depths)


def write_video(path: str | Path, frames: Frames, fps: int = 24) -> None:
    """Write an H.264 `.mp4` (yuv420p) of images (sRGB, 0 to 1).

    Small images are enlarged by a whole factor until their shorter side has at least 256 px. The last row or column of
    an odd side is repeated, because H.264 needs even sizes.

    Raises:
        ValueError: there are no frames, a frame is not finite, or the path does not end in `.mp4`.
        DiskError: the disk is full.
        RuntimeError: ffmpeg did not write the video to its end.
    """
    import imageio.v2 as imageio

    if len(frames) == 0 or Path(path).suffix != ".mp4":
        raise ValueError(f"{path}: a video needs at least one frame and a name that ends in .mp4")
    height, width = frames.shape[-2:]
    factor = -(-SMALLEST_SIDE // min(height, width))
    with atomic_path(path) as temporary:
        options: dict[str, Any] = {
            "codec": "libx264",
            "quality": 8,
            "pixelformat": "yuv420p",
            "macro_block_size": 2,
            # Two fifths of the default's time, for files of about its size.
            "output_params": ["-preset", "veryfast"],
        }
        with imageio.get_writer(temporary, format="FFMPEG", fps=fps, **options) as writer:
            for frame in frames:
                large = to_pixels(frame).repeat(factor, axis=0).repeat(factor, axis=1)
                padded = np.pad(large, ((0, len(large) % 2), (0, large.shape[1] % 2), (0, 0)), mode="edge")
                writer.append_data(padded)  # type: ignore[attr-defined]
        # ffmpeg is another process, and imageio does not pass on its errors.
        if not _is_whole(temporary):
            raise RuntimeError(f"{path}: was not written to its end")


def _is_whole(path: Path) -> bool:
    """Return whether an `.mp4` ends where its last box does, and has an index of its frames (ISO/IEC 14496-12, 4.2)."""
    content = path.read_bytes()
    at = 0
    kinds = set()
    while at + 8 <= len(content):
        length = int.from_bytes(content[at : at + 4])
        kind = content[at + 4 : at + 8]
        if length == 1:
            length = int.from_bytes(content[at + 8 : at + 16])
        if length < 8:
            return False
        kinds.add(kind)
        at += length
    return at == len(content) and b"moov" in kinds
