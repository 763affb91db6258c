"""Tiny RealEstate10K trees in both forms, with clips whose content is known, and what tests do with their batches."""

import io
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from completesplat.data.loading.loader import SceneLoader
from completesplat.data.realestate10k.module import RE10KDataModule
from completesplat.scene import SceneBatch

HEIGHT, WIDTH = 18, 32


@dataclass
class StoredClip:
    """What a clip's files say: rows of fx fy cx cy k1 k2 and the pose, and encoded images."""

    key: str
    timestamps: list[int]
    rows: np.ndarray
    images: list[bytes]


def make_clip(key: str, frames: int = 6, seed: int = 0, size: tuple[int, int] = (HEIGHT, WIDTH)) -> StoredClip:
    """A camera on its way through a room, turning; float32, as chunks have it."""
    rng = np.random.default_rng([seed, *key.encode()])
    rows = np.zeros((frames, 18))
    rows[:, :4] = [0.5, 0.5 * size[1] / size[0], 0.5, 0.5]
    for frame in range(frames):
        angle = 0.05 * frame
        rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        translation = [0.1 * frame + 0.3, -0.2, 0.05 * frame]
        rows[frame, 6:] = np.concatenate([rotation, np.array(translation)[:, None]], axis=1).ravel()
    images = [encode(rng.integers(0, 256, (*size, 3), dtype=np.uint8)) for _ in range(frames)]
    return StoredClip(key, [33_000 * (frame + 1) for frame in range(frames)], rows.astype(np.float32), images)


def encode(pixels: np.ndarray, form: str = "JPEG") -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, form)
    return buffer.getvalue()


def write_text_form(folder: Path, clips: list[StoredClip]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for clip in clips:
        lines = [
            " ".join([str(time), *(repr(float(number)) for number in row)])
            for time, row in zip(clip.timestamps, clip.rows, strict=True)
        ]
        (folder / f"{clip.key}.txt").write_text("\n".join(["https://video.example/watch?v=x", *lines]) + "\n")
        (folder / clip.key).mkdir()
        for time, image in zip(clip.timestamps, clip.images, strict=True):
            (folder / clip.key / f"{time}.jpg").write_bytes(image)


def chunk_entry(clip: StoredClip) -> dict:
    return {
        "url": "https://video.example/watch?v=x",
        "timestamps": torch.tensor(clip.timestamps, dtype=torch.int64),
        "cameras": torch.from_numpy(clip.rows),
        "images": [torch.from_numpy(np.frombuffer(image, np.uint8).copy()) for image in clip.images],
        "key": clip.key,
    }


def write_chunk_form(folder: Path, clips: list[StoredClip], clips_per_chunk: int = 2) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    index = {}
    for number in range(0, len(clips), clips_per_chunk):
        name = f"{number // clips_per_chunk:06}.torch"
        members = clips[number : number + clips_per_chunk]
        torch.save([chunk_entry(clip) for clip in members], folder / name)
        index |= {clip.key: name for clip in members}
    (folder / "index.json").write_text(json.dumps(index))


FORMS = {"text": write_text_form, "chunks": write_chunk_form}


def write_tree(root: Path, form: str, train: list[StoredClip], test: list[StoredClip]) -> Path:
    FORMS[form](root / "train", train)
    FORMS[form](root / "test", test)
    return root


def module(root: Path, **settings) -> RE10KDataModule:
    return RE10KDataModule(str(root), **{"image_size": 16, "batch_size": 2, "targets": 2, "max_gap": 2, **settings})


def epoch(loader: SceneLoader, number: int) -> list[SceneBatch]:
    loader.sampler.set_epoch(number)
    return list(loader)


def same(a: SceneBatch, b: SceneBatch) -> bool:
    """Bit by bit."""

    def tensors(batch: SceneBatch) -> list[torch.Tensor]:
        views = batch.all_views()
        cameras = (views.cameras.world_to_camera, views.cameras.intrinsics)
        return [views.images, views.masks, *cameras, batch.depth_range, batch.visible]

    return a.names == b.names and all(map(torch.equal, tensors(a), tensors(b)))


def equal(one: list[SceneBatch], other: list[SceneBatch]) -> bool:
    return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
