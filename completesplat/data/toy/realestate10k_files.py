"""Clips in RealEstate10K's two forms: a text beside a folder of frames, and pixelSplat's chunks of clips.

Sources: google.github.io/realestate10k (texts); dcharatan/real_estate_10k_tools, `src/convert.py` (chunks).
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from completesplat.data.toy.ingredients import Array

FRAMES_PER_SECOND = 30
MICROSECONDS = 1_000_000
CLIPS_PER_CHUNK = 16
JPEG_QUALITY = 95


@dataclass(frozen=True)
class ClipFiles:
    """A clip in the text form: `folder`/`key`.txt and `folder`/`key`/`timestamp`.jpg.

    `cameras` [frame 18] are what the text says: fx fy cx cy in shares of width or height, two zeros, and
    `world_to_camera` by rows.
    """

    folder: Path
    key: str
    timestamps: list[int]
    cameras: NDArray[np.float32]

    @property
    def url(self) -> str:
        """An address that is nobody's video."""
        return f"https://example.com/toy/{self.key}"

    def picture(self, frame: int) -> Path:
        """Where a frame is."""
        return self.folder / self.key / f"{self.timestamps[frame]}.jpg"


def clip_files(folder: Path, key: str, start: int, intrinsics: Array, world_to_camera: Array) -> ClipFiles:
    """A clip whose first frame is `start` frames into its video; poses are [frame 3 4]."""
    frames = len(world_to_camera)
    timestamps = [round((start + frame) * MICROSECONDS / FRAMES_PER_SECOND) for frame in range(frames)]
    rows = [np.broadcast_to(intrinsics, (frames, 4)), np.zeros((frames, 2)), world_to_camera.reshape(frames, 12)]
    return ClipFiles(folder, key, timestamps, np.concatenate(rows, axis=1).astype(np.float32))


def write_text(clip: ClipFiles) -> None:
    """Write the text: the address, then a line of timestamp and camera for each frame; make the frames' folder."""
    (clip.folder / clip.key).mkdir(parents=True)
    lines = [clip.url]
    for time, row in zip(clip.timestamps, clip.cameras, strict=True):
        # Nine digits tell float32 numbers apart, so the text says exactly what the chunks hold.
        lines.append(" ".join([str(time), *(f"{number:.9g}" for number in row)]))
    (clip.folder / f"{clip.key}.txt").write_text("\n".join(lines) + "\n")


def write_picture(path: Path, image: Array) -> None:
    """Colours in [0, 1], [height width 3], as a JPEG."""
    pixels = np.round(255 * image.clip(0, 1)).astype(np.uint8)
    Image.fromarray(pixels).save(path, quality=JPEG_QUALITY, subsampling=0)


def write_chunks(folder: Path, clips: list[ClipFiles]) -> None:
    """Write `folder`/NNNNNN.torch from the text form's frames, and `folder`/index.json."""
    folder.mkdir(parents=True)
    index: dict[str, str] = {}
    for number, first in enumerate(range(0, len(clips), CLIPS_PER_CHUNK)):
        members = clips[first : first + CLIPS_PER_CHUNK]
        name = f"{number:06d}.torch"
        torch.save([_chunk_entry(clip) for clip in members], folder / name)
        index |= {clip.key: name for clip in members}
    (folder / "index.json").write_text(json.dumps(index) + "\n")


def _chunk_entry(clip: ClipFiles) -> dict[str, Any]:
    pictures = [clip.picture(frame).read_bytes() for frame in range(len(clip.timestamps))]
    return {
        "url": clip.url,
        "timestamps": torch.tensor(clip.timestamps, dtype=torch.int64),
        "cameras": torch.from_numpy(clip.cameras),
        "images": [torch.frombuffer(bytearray(picture), dtype=torch.uint8) for picture in pictures],
        "key": clip.key,
    }
