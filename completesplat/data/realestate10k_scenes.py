"""RealEstate10K clips as scenes: views selected and cropped, cameras in the reference's frame, items in order."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from completesplat.data.realestate10k_chunks import ChunkedClips
from completesplat.data.realestate10k_clips import Clip
from completesplat.data.realestate10k_text import TextClips
from completesplat.data.transforms import Square, principal_square
from completesplat.data.view_selection import draws, evaluation_views_within, nearby_views
from completesplat.errors import DataError
from completesplat.geometry.cameras import Cameras, crop_resize
from completesplat.scene import SceneBatch, Views
from completesplat.tensors import stack

CROPS = ("center", "principal")

Clips = TextClips | ChunkedClips


def open_clips(folder: Path) -> Clips:
    """The clips of a split's folder, in whichever form they are: with an `index.json`, in chunks, else in texts.

    Raises:
        DataError: neither is there.
    """
    if (folder / "index.json").is_file():
        return ChunkedClips(folder)
    if folder.is_dir() and any(folder.glob("*.txt")):
        return TextClips(folder)
    raise DataError(f"no RealEstate10K clips at {folder}: neither index.json (with *.torch) nor *.txt")


def split_by_hash(keys: Sequence[str], fraction: float, seed: int) -> tuple[list[str], list[str]]:
    """Training and held-out clips, in the given order.

    A clip's side depends on its key and the seed only, so that it stays where it is when others come; only where no
    clip would be held out is it the one with the smallest hash.
    """
    position = {key: int.from_bytes(hashlib.sha256(f"{seed}/{key}".encode()).digest()[:8]) / 2**64 for key in keys}
    held_out = {key for key in keys if position[key] < fraction} or set(sorted(keys, key=position.__getitem__)[:1])
    return [key for key in keys if key not in held_out], [key for key in keys if key in held_out]


class SceneStore:
    """Makes scenes of some clips.

    Args:
        crop: "center": the largest central square; "principal": the largest square around the principal point.
        scale: all lengths are multiplied by this, near and far included.
        near, far: the depth range of every scene, in the clips' own units.
    """

    def __init__(
        self, clips: Clips, keys: list[str], image_size: int, crop: str, scale: float, near: float, far: float
    ) -> None:
        self.clips = clips
        self.keys = keys
        self.image_size = image_size
        self.crop = crop
        self.scale = scale
        self.depth_range = torch.tensor([near * scale, far * scale])

    def scene(self, clip: Clip, reference: int, targets: Sequence[int]) -> SceneBatch:
        """One scene in the reference camera's frame, from the frames of these numbers.

        Raises:
            DataError: a picture that cannot be read.
        """
        frames = [reference, *targets]
        cameras = self.cameras(clip, frames)
        cameras = cameras.relative_to(cameras[0]).to(torch.float32)
        images = torch.stack([self.image(clip, frame) for frame in frames]).float().div(255)
        views = Views(images, cameras, torch.ones_like(images[:, :1]))
        return SceneBatch(views[0], views[1:], self.depth_range, clip.key)

    def cameras(self, clip: Clip, frames: Sequence[int]) -> Cameras:
        """Cameras of some frames, cropped and scaled (float64); the world is still the clip's own, with its origin."""
        squares = [(frame, self._square(clip, frame)) for frame in frames]
        cropped = [crop_resize(clip.cameras[f], s.left, s.top, s.side, self.image_size) for f, s in squares]
        return stack(cropped).scale_world(torch.tensor(self.scale, dtype=torch.float64))

    def image(self, clip: Clip, frame: int) -> UInt8[Tensor, "3 height width"]:
        """One cropped picture."""
        return clip.read(frame, self._square(clip, frame), self.image_size)

    def _square(self, clip: Clip, frame: int) -> Square:
        height, width = clip.cameras.image_size
        x, y = clip.cameras.intrinsics[frame, :2, 2].tolist() if self.crop == "principal" else (width / 2, height / 2)
        return principal_square((x, y), (height, width))

    def excerpts(self, clips: int, frames: int) -> Iterator[tuple[Clip, list[int]]]:
        """The first clips, each with evenly spaced frames: at most so many of either."""
        for key in self.keys[:clips]:
            clip = self.clips.clip(key)
            count = len(clip.timestamps)
            yield clip, sorted({i * count // frames for i in range(frames)})


class TrainingScenes(Dataset[SceneBatch]):
    """Scenes of random views that are near each other; a key is (epoch, index), see `ChunkSampler`."""

    def __init__(
        self, store: SceneStore, targets: int, min_gap: int, max_gap: int, references_per_clip: int, seed: int
    ) -> None:
        self.store = store
        self.targets = targets
        self.min_gap = min_gap
        self.max_gap = max_gap
        self.references_per_clip = references_per_clip
        self.seed = seed

    def __len__(self) -> int:
        return len(self.store.keys) * self.references_per_clip

    def __getitem__(self, key: tuple[int, int]) -> SceneBatch:
        epoch, index = key
        clip = self.store.clips.clip(self.store.keys[index // self.references_per_clip])
        rng = draws(self.seed, epoch, index)
        views = nearby_views(len(clip.timestamps), self.targets, self.min_gap, self.max_gap, rng)
        return self.store.scene(clip, *views)

    def chunks(self) -> list[list[int]]:
        """Items by the chunk in which their clips lie."""
        several = range(self.references_per_clip)
        chunks = self.store.clips.chunks(self.store.keys)
        return [[clip * self.references_per_clip + i for clip in chunk for i in several] for chunk in chunks]


class EvaluationScenes(Dataset[SceneBatch]):
    """Every clip once.

    Args:
        targets, gap: the first frame is the reference, the targets are spread over the next `gap` frames.
        listed: views (reference, targets) by key, instead of that rule.
    """

    def __init__(
        self, store: SceneStore, targets: int, gap: int, listed: Mapping[str, tuple[int, list[int]]] | None
    ) -> None:
        self.store = store
        self.targets = targets
        self.gap = gap
        self.listed = listed

    def __len__(self) -> int:
        return len(self.store.keys)

    def __getitem__(self, index: int) -> SceneBatch:
        key = self.store.keys[index]
        clip = self.store.clips.clip(key)
        frames = len(clip.timestamps)
        if self.listed is None:
            return self.store.scene(clip, *evaluation_views_within(frames, self.targets, self.gap))
        reference, targets = self.listed[key]
        if max(reference, *targets) >= frames:
            raise DataError(
                f"evaluation index wants frame {max(reference, *targets)} of clip {key}, which has {frames}"
            )
        return self.store.scene(clip, reference, targets)

    def stackable(self) -> bool:
        """Whether all scenes have the same number of targets."""
        return self.listed is None or len({len(self.listed[key][1]) for key in self.store.keys}) == 1


class ChunkSampler(Sampler[tuple[int, int]]):
    """All items, chunk by chunk: chunks and the items of each in an order drawn from (seed, epoch), with the epoch.

    Lightning calls `set_epoch` before every epoch, also after a resume.
    """

    def __init__(self, chunks: list[list[int]], seed: int) -> None:
        self.chunks = chunks
        self.seed = seed
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """The epoch of the iterations that start from now on."""
        self.epoch = epoch

    def __len__(self) -> int:
        return sum(map(len, self.chunks))

    def __iter__(self) -> Iterator[tuple[int, int]]:
        # The index `len(self)` belongs to no item, so the order is independent of what the items draw.
        rng = draws(self.seed, self.epoch, len(self))
        order = [i for chunk in rng.permutation(len(self.chunks)) for i in rng.permutation(self.chunks[chunk])]
        return iter([(self.epoch, int(index)) for index in order])
