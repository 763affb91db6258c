"""Writes toy rooms with smooth camera moves in both of RealEstate10K's forms."""

from functools import partial
from pathlib import Path

import numpy as np

from completesplat.data.toy.realestate10k_files import ClipFiles, clip_files, write_chunks, write_picture, write_text
from completesplat.data.toy.room_camera import image_width
from completesplat.data.toy.room_scene import draw_room_scene, render_room_frame
from completesplat.data.toy.writing import in_processes, write_once
from completesplat.errors import DataError

ROOMS = "toy_rooms"
FORMAT_VERSION = 1
LATEST_START = 9000


def write_rooms(
    out: Path, scenes: int, frames: int, size: int, seed: int, workers: int | None = None, progress: bool = True
) -> Path:
    """Write `scenes` clips of `frames` pictures, `size` high and 16 / 9 as wide, with poses and intrinsics.

    `text`/<split>/ has <key>.txt and <key>/<timestamp>.jpg, `chunks`/<split>/ the same clips in NNNNNN.torch with
    index.json. Every tenth clip, from the first, is in the split `test`, the others in `train`. The bytes depend on
    `scenes`, `frames`, `size` and `seed` only, not on `workers` (processes; by default one a core). A folder that holds
    the same set already is kept.

    Returns:
        The folder, `out`/toy_rooms.

    Raises:
        DataError: a number that is too small, or a folder with other content.
    """
    if scenes < 2 or frames < 2 or size < 8:
        raise DataError(f"toy rooms need scenes >= 2, frames >= 2 and size >= 8, not {scenes}, {frames} and {size}")
    parameters = {"format": FORMAT_VERSION, "scenes": scenes, "frames": frames, "size": size, "seed": seed}
    splits = ["test" if index % 10 == 0 else "train" for index in range(scenes)]

    def fill(folder: Path) -> None:
        write = partial(_write_clip, folder / "text", frames, size, seed)
        clips = list(in_processes(write, splits, workers, "Rendering toy rooms", progress))
        for split in ("train", "test"):
            write_chunks(folder / "chunks" / split, [clip for clip in clips if clip.folder.name == split])

    return write_once(out / ROOMS, parameters, fill, progress)


def _write_clip(text: Path, frames: int, size: int, seed: int, index: int, split: str) -> ClipFiles:
    """The text form of one clip, from a random generator of its own."""
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
