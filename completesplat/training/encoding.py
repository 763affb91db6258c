"""Latent cache: a training set encoded once by the frozen autoreconstructor."""

import hashlib
import logging
import shutil
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from rich.filesize import decimal
from rich.progress import track
from torch import nn
from torch.utils.data import DataLoader, Dataset

from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.posterior import LOG_VARIANCE_RANGE
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.distributed import gather_values, processes
from completesplat.data.loading.latent_cache import CachedSequence, LatentCache, Origin, Rows, Sums, write_cache
from completesplat.data.loading.scenes import LoadedScenes, SceneStore, collate
from completesplat.data.loading.view_selection import spread_around
from completesplat.data.loading.worker_folder import prepare_worker, worker_folder
from completesplat.data.packed.manifest import MANIFEST
from completesplat.data.packed.source import PackedSource
from completesplat.data.sequences import spread_places
from completesplat.errors import CompleteSplatError, DataError, WeightsError
from completesplat.scene import SceneBatch
from completesplat.wording import counted

PRECISIONS = {"float32": torch.float32, "float16": torch.float16}
Moments = Float[np.ndarray, "row channel _ _"]

logger = logging.getLogger(__name__)


def fingerprint(module: nn.Module) -> str:
    """Return the SHA-256 (hexadecimal) of a module's weights: names, types, shapes and bytes."""
    digest = hashlib.sha256()
    for name, value in sorted(module.state_dict().items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)} ".encode())
        digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def fingerprints(model: VariationalAutoReconstructor, conditioning: nn.Module | None) -> tuple[str, str | None]:
    """Return the fingerprint of all weights that latents depend on, and that of a frozen conditioning, else None.

    The first one also says if latents are modes (`variational=false`).
    """
    encoder: nn.Module = model.encoder
    if model.view_encoder is not None:
        encoder = nn.ModuleList([encoder, model.view_encoder])
    features = None
    if conditioning is not None and conditioning.frozen:
        features = fingerprint(conditioning)
    latents = fingerprint(encoder)
    return latents if model.variational else f"{latents} modes", features


def check_cache(store: LatentCache, autoreconstructor: VariationalAutoReconstructor, conditioning: nn.Module) -> None:
    """Raise WeightsError if a cache was made with other networks. (The data module checks data and their settings.)

    Args:
        conditioning: the run's. The cache must hold its features if it is frozen, else images.
    """
    latents, features = fingerprints(autoreconstructor, conditioning)
    if store.origin.encoder != latents:
        raise WeightsError(f"{store.folder}: made with another autoreconstructor; encode the training set again")
    if store.origin.conditioning != features:
        content = "images" if store.origin.conditioning is None else "features of another conditioning"
        advice = "encode the training set again with this run's conditioning"
        raise WeightsError(f"{store.folder}: holds {content}; {advice}")


@dataclass(frozen=True)
class FrameEncoder:
    """Frozen networks that encode scenes, on a device.

    Args:
        conditioning: frozen network from images to features, which are stored; None: the images are stored.
        precision: "float32", or "float16" for half the space, with relative errors of at most 2^-11 in means and 0.8%
            in variances. (The diffusion's first timestep adds noise of 0.029 to latents of unit variance.)

    Raises:
        CompleteSplatError: the conditioning is trained.
    """

    autoreconstructor: VariationalAutoReconstructor
    conditioning: nn.Module | None = None
    precision: str = "float32"
    device: torch.device | str = "cpu"

    def __post_init__(self) -> None:
        if self.conditioning is not None and not self.conditioning.frozen:
            message = "a conditioning that is trained needs images, not features: leave conditioning out"
            raise CompleteSplatError(message)
        self.autoreconstructor.to(self.device).eval()
        if self.conditioning is not None:
            self.conditioning.to(self.device).eval()

    @torch.no_grad()
    def __call__(self, scenes: SceneBatch) -> Rows:
        """Encode the reference images of scenes.

        Returns:
            The rows "mean", "log_variance" and "condition".
        """
        scenes = scenes.to(self.device)
        network = self.autoreconstructor
        images = scenes.reference.images
        views = scenes.all_views() if network.sees_views else None
        posterior, _ = network.posterior(images, views, scenes.depth_range)
        log_variance = posterior.log_variance
        if not network.variational:  # its variance is not trained: latents are modes
            log_variance = torch.full_like(log_variance, LOG_VARIANCE_RANGE[0])
        precision = PRECISIONS[self.precision]
        if self.conditioning is None:
            condition = (images * 255).round().to(torch.uint8)
        else:
            condition = self.conditioning(images).to(precision)
        return {
            "condition": condition.cpu().numpy(),
            "mean": posterior.mean.to(precision).cpu().numpy(),
            "log_variance": log_variance.to(precision).cpu().numpy(),
        }

    def origin(self, data: SceneDataModule, frames: int | None, views: int) -> Origin:
        """Return all that determines the content of a cache of the training data."""
        encoder, features = fingerprints(self.autoreconstructor, self.conditioning)
        source = data.source("train").fingerprint()
        return Origin(
            encoder,
            features,
            source,
            dict(data.packed_settings()),
            data.image_size,
            frames,
            views,
            self.precision,
        )


def moment_sums(mean: Moments, log_variance: Moments) -> Sums:
    """Return each channel's number of elements and expected sums of h and h^2, in float64, without sampling h."""
    mean = mean.astype(np.float64)
    variance = np.exp(log_variance.astype(np.float64))
    total = mean.sum((0, 2, 3))
    squares = (np.square(mean) + variance).sum((0, 2, 3))
    return np.stack([np.full_like(total, mean[:, 0].size), total, squares])


def encode_training_set(
    encode: FrameEncoder,
    data: SceneDataModule,
    out: Path,
    frames: int | None = None,
    views: int = 7,
    batch_size: int = 64,
    progress: bool = True,
) -> LatentCache:
    """Encode every frame of every sequence of a packed training set, without augmentation.

    A finished cache stays unchanged, and that of an interrupted run is unreadable. Several processes share the
    batches, and `data.workers` processes of each read them.

    Args:
        frames: at most this many frames of a sequence, evenly spaced; None: all.
        views: number of other views, evenly spread over the sequence, for a posterior that sees views.

    Raises:
        DataError: damaged or unpacked data, too little space, another cache in the folder, or encodings not finite.
    """
    views = views if encode.autoreconstructor.sees_views else 0
    source = data.source("train")
    if not isinstance(source, PackedSource):
        advice = "run `completesplat data prepare` first, then give overrides=['data.root=STORE']"
        raise DataError(f"the latent cache is made from packed data: {advice}", str(data.root))
    origin = encode.origin(data, frames, views)
    if (out / MANIFEST).is_file():
        store = LatentCache(out)
        if store.origin != origin:
            raise DataError("already holds another store: choose another folder, or remove this one", str(out))
        logger.info("%s already holds these encodings", out)
        return store
    out.mkdir(parents=True, exist_ok=True)
    sequences: list[CachedSequence] = []
    for name in source.names:
        count = len(source.read(name).frames)
        sequences.append(CachedSequence(name, count, tuple(spread_places(count, frames))))
    places = [(sequence.name, place) for sequence in sequences for place in sequence.stored]
    references = References(SceneStore(source), views, places)
    first_frame = encode(_scenes(collate([references[0]])))
    _check_space(len(places), len(sequences), sum(rows.nbytes for rows in first_frame.values()), out)
    batches = _encoded_batches(references, encode, batch_size, data.workers, progress)
    if processes()[0] == 0:
        write_cache(out, origin, batches, sequences)
    else:
        deque(batches, maxlen=0)
    gather_values(None)  # the other processes wait until the manifest is written
    return LatentCache(out)


@dataclass(frozen=True)
class References(Dataset[LoadedScenes]):
    """Dataset of the frames to encode, with the views around them.

    Args:
        views: number of other views, evenly spread over the sequence.
        places: the sequence's name and the frame's index, of each item.
    """

    store: SceneStore
    views: int
    places: Sequence[tuple[str, int]]

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: int) -> LoadedScenes:
        name, place = self.places[index]
        try:
            sequence = self.store.source.read(name)
            views = spread_around(len(sequence.frames), place, self.views)
            return LoadedScenes(self.store.scene(sequence, place, views), ())
        except DataError as error:
            return LoadedScenes(None, (error,))


def _scenes(loaded: LoadedScenes) -> SceneBatch:
    if loaded.refused:
        raise loaded.refused[0]
    assert isinstance(loaded.scenes, SceneBatch)
    return loaded.scenes


def _encoded_batches(
    references: References, encode: FrameEncoder, batch_size: int, workers: int, progress: bool
) -> Iterator[tuple[Rows, Sums]]:
    """Yield rows and moment sums of all batches in order. Each process encodes a share, so all must iterate.

    Sums are computed before rows are sent, because sending changes the rows' memory order and so the rounding.
    """
    rank, count = processes()
    batches = [batch.tolist() for batch in torch.split(torch.arange(len(references)), batch_size)]
    loader: DataLoader[LoadedScenes] = DataLoader(
        references,
        batch_sampler=batches[rank::count],
        num_workers=workers,
        collate_fn=collate,
        worker_init_fn=partial(prepare_worker, worker_folder() if workers > 0 else None),
    )
    loaded = iter(loader)
    for first in track(range(0, len(batches), count), "encoding", disable=not progress or rank > 0):
        result: tuple[Rows, Sums] | DataError | None = None
        if first + rank < len(batches):
            result = _encoded_batch(next(loaded), references, encode, batches[first + rank])
        for rank_result in gather_values(result):
            if isinstance(rank_result, DataError):
                raise rank_result
            if rank_result is not None:
                yield rank_result


def _encoded_batch(
    loaded: LoadedScenes, references: References, encode: FrameEncoder, batch: Sequence[int]
) -> tuple[Rows, Sums] | DataError:
    """Return a batch's rows and sums, or an error, which all processes will raise together."""
    try:
        rows = encode(_scenes(loaded))
        _refuse_not_finite(rows, references, batch)
    except DataError as error:
        return error
    return rows, moment_sums(rows["mean"], rows["log_variance"])


def _check_space(frames: int, sequences: int, bytes_per_frame: int, out: Path) -> None:
    """Log the size of the future store.

    Raises:
        DataError: the disk has less space.
    """
    size = frames * bytes_per_frame
    free = shutil.disk_usage(out).free
    contents = f"{counted(frames, 'frame')} of {counted(sequences, 'sequence')}"
    needed = f"about {decimal(size)} for {contents}; {decimal(free)} are free"
    if size > free:
        raise DataError(f"not enough space: {needed}; frames=N takes fewer frames of a sequence", str(out))
    logger.info(needed)


def _refuse_not_finite(rows: Rows, references: References, batch: Sequence[int]) -> None:
    for name, values in rows.items():
        finite = np.isfinite(values).all(axis=(1, 2, 3))
        if not finite.all():
            sequence, place = references.places[batch[int(finite.argmin())]]
            limits = " in float16: try precision=float32" if values.dtype == np.float16 else ""
            frame = references.store.source.read(sequence).frames[place]
            raise DataError(f"its {name} is not finite{limits}", None, sequence, frame)
