"""Writer of toy rooms with smooth camera moves, in both of RealEstate10K's forms."""

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from completesplat.data.images.files import save_image
from completesplat.data.toy.disk import write_once, write_scenes
from completesplat.data.toy.raytracing import Array
from completesplat.data.toy.room_scene import draw_room_scene, image_width, render_room_frame

ROOMS = "toy_rooms"
LATEST_START = 9000
FRAMES_PER_SECOND = 30
MICROSECONDS = 1_000_000
CLIPS_PER_CHUNK = 16
JPEG_QUALITY = 95


@dataclass(frozen=True)
class ClipFiles:
    """Clip in the text form: `folder`/`key`.txt and `folder`/`key`/`timestamp`.jpg.

    `cameras` [frame 18] are the numbers in the text: fx fy cx cy as fractions of width or height, two zeros, and
    `world_to_camera` by rows.
    """

    folder: Path
    key: str
    timestamps: list[int]
    cameras: NDArray[np.float32]

    @property
    def url(self) -> str:  # no real video
        return f"https://example.com/toy/{self.key}"

    def picture(self, frame: int) -> Path:
        """Return the path of a frame's image."""
        return self.folder / self.key / f"{self.timestamps[frame]}.jpg"


def clip_files(folder: Path, key: str, start: int, intrinsics: Array, world_to_camera: Array) -> ClipFiles:
    """Return a clip whose first frame is `start` frames into its video; poses are [frame 3 4]."""
    frames = len(world_to_camera)
    timestamps = [round((start + frame) * MICROSECONDS / FRAMES_PER_SECOND) for frame in range(frames)]
    rows = [np.broadcast_to(intrinsics, (frames, 4)), np.zeros((frames, 2)), world_to_camera.reshape(frames, 12)]
    return ClipFiles(folder, key, timestamps, np.concatenate(rows, axis=1).astype(np.float32))


def write_text(clip: ClipFiles) -> None:
    """Write the text (the address, then timestamp and camera of each frame in a line) and make the frames' folder."""
    (clip.folder / clip.key).mkdir(parents=True)
    lines = [clip.url]
    for time, row in zip(clip.timestamps, clip.cameras, strict=True):
        # Nine digits identify a float32 exactly, so text and chunks hold the same numbers.
        lines.append(" ".join([str(time), *(f"{number:.9g}" for number in row)]))
    (clip.folder / f"{clip.key}.txt").write_text("\n".join(lines) + "\n")


def write_picture(path: Path, image: Array) -> None:
    """Write colours in [0, 1], [height width 3], as a JPEG."""
    pixels = np.round(255 * image.clip(0, 1)).astype(np.uint8)
    save_image(Image.fromarray(pixels), path, quality=JPEG_QUALITY, subsampling=0)


def write_chunks(folder: Path, clips: list[ClipFiles]) -> None:
    """Write `folder`/NNNNNN.torch from the text form's frames, and `folder`/index.json."""
    folder.mkdir(parents=True)
    index = {clip.key: f"{number // CLIPS_PER_CHUNK:06d}.torch" for number, clip in enumerate(clips)}
    for name in sorted(set(index.values())):
        torch.save([_chunk_entry(clip) for clip in clips if index[clip.key] == name], folder / name)
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


def write_rooms(
    out: Path, scenes: int, frames: int, size: int, seed: int, workers: int | None = None, progress: bool = True
) -> Path:
    """Write `scenes` clips of `frames` images, `size` high and 16 / 9 as wide, with poses and intrinsics.

    `text`/<split>/ has <key>.txt and <key>/<timestamp>.jpg; `chunks`/<split>/ has the same clips in NNNNNN.torch and
    index.json. The first and every tenth clip after it are in the split `test`, the others in `train`. See `write_once`
    for the numbers; `workers` are processes (None: one for each core). Return the folder, `out`/toy_rooms.
    """
    splits = ["test" if index % 10 == 0 else "train" for index in range(scenes)]

    def fill(folder: Path) -> None:
        write = partial(_write_clip, folder / "text", frames, size, seed)
        clips = write_scenes(write, splits, workers, ROOMS, progress)
        for split in ("train", "test"):
            write_chunks(folder / "chunks" / split, [clip for clip in clips if clip.folder.name == split])

    return write_once(out / ROOMS, fill, progress, 2, scenes=scenes, frames=frames, size=size, seed=seed)


def _write_clip(text: Path, frames: int, size: int, seed: int, place: tuple[int, str]) -> ClipFiles:
    """Write the text form of one clip, drawn from a separate random generator."""
    index, split = place
    rng = np.random.default_rng([seed, index])
    scene = draw_room_scene(rng, frames)
    width, start = image_width(size), int(rng.integers(LATEST_START))
    intrinsics = scene.move.intrinsics(size, width)
    clip = clip_files(text / split, f"room{index:05d}", start, intrinsics, scene.move.world_to_camera())
    write_text(clip)
    for frame in range(frames):
        image, _ = render_room_frame(scene, frame, size, width)
        write_picture(clip.picture(frame), image)
    return clip
