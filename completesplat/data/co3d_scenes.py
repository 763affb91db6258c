"""CO3D sequences as scenes: frames cropped and cached, cameras at the common scale, views selected."""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from completesplat.data.co3d_annotations import CO3DFrame, CO3DSequence, object_placement
from completesplat.data.transforms import Square, principal_square, read_square
from completesplat.data.view_selection import draws, evaluation_views, training_views
from completesplat.geometry.cameras import Cameras, crop_resize, transform_points
from completesplat.scene import SceneBatch, Views
from completesplat.tensors import stack

SMALLEST_NEAR = 0.1


class SceneStore:
    """Makes scenes of a list of sequences.

    Args:
        image_size: side of the square pictures.
        depth_before, depth_after: the depth range reaches this far in front of and behind the object's centre.
        cache: keep decoded frames (uint8) in memory, each from its first use on.
    """

    def __init__(
        self, sequences: list[CO3DSequence], image_size: int, depth_before: float, depth_after: float, cache: bool
    ) -> None:
        self.sequences = sequences
        self.image_size = image_size
        self.depth_before = depth_before
        self.depth_after = depth_after
        self._frames: dict[tuple[int, int], tuple[UInt8[Tensor, "3 h w"], UInt8[Tensor, "1 h w"]]] | None
        self._frames = {} if cache else None
        self._cameras: dict[int, tuple[Cameras, Float[Tensor, " view"]]] = {}

    def scene(self, sequence: int, reference: int, targets: Sequence[int]) -> SceneBatch:
        """One scene in the reference camera's frame, from the frames of these numbers."""
        cameras, depths = self.cameras(sequence)
        relative = cameras.relative_to(cameras[reference]).to(torch.float32)
        return SceneBatch(
            reference=self._views(sequence, [reference], relative)[0],
            targets=self._views(sequence, targets, relative),
            depth_range=self._depth_range(depths[reference]).to(torch.float32),
            names=self.sequences[sequence].name,
        )

    def cameras(self, sequence: int) -> tuple[Cameras, Float[Tensor, " view"]]:
        """All cameras of a sequence, cropped and at the common scale, and the object centre's depth in each (float64).

        The world is still the sequence's own, with its origin.
        """
        if sequence not in self._cameras:
            center, factor = object_placement(self.sequences[sequence].point_cloud)
            cropped = [self._crop(frame) for frame in self.sequences[sequence].frames]
            cameras = stack(cropped).scale_world(torch.tensor(factor, dtype=torch.float64))
            depths = transform_points(cameras.world_to_camera, factor * center[None])[..., 0, 2]
            self._cameras[sequence] = cameras, depths
        return self._cameras[sequence]

    def depth_ranges(self, sequence: int) -> Float[Tensor, "view 2"]:
        """(near, far) with each of the sequence's frames as the reference."""
        return self._depth_range(self.cameras(sequence)[1])

    def image(self, sequence: int, frame: int) -> UInt8[Tensor, "3 height width"]:
        """One cropped picture."""
        return self._pixels(sequence, frame)[0]

    def _crop(self, frame: CO3DFrame) -> Cameras:
        square = _square_of(frame)
        return crop_resize(frame.camera, square.left, square.top, square.side, self.image_size)

    def _depth_range(self, depth: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 2"]:
        near = (depth - self.depth_before).clamp(min=SMALLEST_NEAR)
        # An object behind the camera (a broken pose) still gets a range of positive length.
        return torch.stack([near, torch.maximum(depth, near) + self.depth_after], dim=-1)

    def _pixels(self, sequence: int, frame: int) -> tuple[UInt8[Tensor, "3 h w"], UInt8[Tensor, "1 h w"]]:
        if self._frames is not None and (sequence, frame) in self._frames:
            return self._frames[sequence, frame]
        entry = self.sequences[sequence].frames[frame]
        square, size = _square_of(entry), entry.camera.image_size
        image = read_square(entry.image, size, square, self.image_size, "RGB")
        mask = read_square(entry.mask, size, square, self.image_size, "L")
        if self._frames is not None:
            self._frames[sequence, frame] = image, mask
        return image, mask

    def _views(self, sequence: int, frames: Sequence[int], cameras: Cameras) -> Views:
        pixels = [self._pixels(sequence, frame) for frame in frames]
        images, masks = (torch.stack(kind).float().div(255) for kind in zip(*pixels, strict=True))
        return Views(images, cameras[list(frames)], masks)


def _square_of(frame: CO3DFrame) -> Square:
    center = frame.camera.intrinsics[:2, 2].tolist()
    return principal_square((center[0], center[1]), frame.camera.image_size)


class TrainingScenes(Dataset[SceneBatch]):
    """Scenes of random views; a key is (epoch, index), see `EpochSampler`."""

    def __init__(self, store: SceneStore, targets: int, references_per_sequence: int, seed: int) -> None:
        self.store = store
        self.targets = targets
        self.references_per_sequence = references_per_sequence
        self.seed = seed

    def __len__(self) -> int:
        return len(self.store.sequences) * self.references_per_sequence

    def __getitem__(self, key: tuple[int, int]) -> SceneBatch:
        epoch, index = key
        sequence = index // self.references_per_sequence
        rng = draws(self.seed, epoch, index)
        reference, targets = training_views(len(self.store.sequences[sequence].frames), self.targets, rng)
        return self.store.scene(sequence, reference, targets)


class EvaluationScenes(Dataset[SceneBatch]):
    """Every sequence once: its first frame as the reference, the others as targets."""

    def __init__(self, store: SceneStore, targets: int | None) -> None:
        self.store = store
        self.views = [evaluation_views(len(sequence.frames), targets) for sequence in store.sequences]

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int) -> SceneBatch:
        return self.store.scene(index, *self.views[index])

    def stackable(self) -> bool:
        """Whether all scenes have the same number of targets."""
        return len({len(targets) for _, targets in self.views}) == 1


class EpochSampler(Sampler[tuple[int, int]]):
    """All indices in an order drawn from (seed, epoch), each with the epoch, so that worker processes know it too.

    Lightning calls `set_epoch` before every epoch, also after a resume.
    """

    def __init__(self, length: int, seed: int) -> None:
        self.length = length
        self.seed = seed
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """The epoch of the iterations that start from now on."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[tuple[int, int]]:
        # The index `length` belongs to no item, so the order is independent of what the items draw.
        order = draws(self.seed, self.epoch, self.length).permutation(self.length)
        return iter([(self.epoch, int(index)) for index in order])
