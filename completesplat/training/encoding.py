"""Latent cache: a training set encoded once by the frozen autoreconstructor, and latents drawn from it."""

import hashlib
import logging
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Shaped
from rich.progress import track
from torch import nn

from completesplat import __version__
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.distributed import gathered, is_first, processes
from completesplat.data.loading.latent_cache import (
    CHECKSUMS,
    Array,
    ArrayWriter,
    CachedSequence,
    LatentCache,
    LatentCacheManifest,
    Origin,
    is_latent_cache,
    row_checksums,
    write_manifest,
)
from completesplat.data.loading.scenes import SceneStore
from completesplat.data.loading.view_selection import spread_around
from completesplat.data.packed.source import PackedSource
from completesplat.data.packed.writing import require_space
from completesplat.data.sequences import PosedSequence, SequenceSource, spread_places
from completesplat.errors import CompleteSplatError, DataError, WeightsError
from completesplat.scene import SceneBatch
from completesplat.tensors import stack
from completesplat.weights import sha256_of

PRECISIONS = {"float32": torch.float32, "float16": torch.float16}
Rows = dict[str, Shaped[np.ndarray, "picture _ _ _"]]

logger = logging.getLogger(__name__)


def fingerprint(module: nn.Module) -> str:
    """Return the SHA-256 (hexadecimal) of a module's weights: names, types, shapes and bytes."""
    digest = hashlib.sha256()
    for name, value in sorted(module.state_dict().items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)} ".encode())
        digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def posterior_fingerprint(autoreconstructor: VariationalAutoReconstructor) -> str:
    """Return the fingerprint of all weights that latents depend on."""
    encoder, views = autoreconstructor.encoder, autoreconstructor.view_encoder
    return fingerprint(encoder if views is None else nn.ModuleList([encoder, views]))


def check_cache(
    store: LatentCache,
    autoreconstructor: VariationalAutoReconstructor,
    source: SequenceSource,
    conditioning: nn.Module | None = None,
) -> None:
    """Raise an error for a stale cache. (The data module compares image sizes and all other data options.)

    Args:
        conditioning: needs its stored features if it is frozen, else stored images; None is not checked.

    Raises:
        WeightsError: the cache was made with another autoreconstructor or conditioning.
        DataError: the cache is of other data, or its latents have another shape than this autoreconstructor's.
    """
    if store.origin.encoder != posterior_fingerprint(autoreconstructor):
        raise WeightsError(f"{store.folder}: made with another autoreconstructor; encode the training set again")
    store.must_be_of(source)
    device = next(autoreconstructor.parameters()).device
    blank = torch.zeros(1, 3, store.origin.image_size, store.origin.image_size, device=device)
    with torch.no_grad():
        shape = tuple(autoreconstructor.encoder(blank)[0].mean.shape[1:])
    if shape != store.latent_shape:
        raise DataError(f"latents of {store.latent_shape}, the autoreconstructor's are {shape}", str(store.folder))
    if conditioning is not None and store.origin.conditioning != features_fingerprint(conditioning):
        held = "pictures" if store.holds_images else "features of another conditioning"
        raise WeightsError(f"{store.folder}: holds {held}; encode the training set again with this run's conditioning")


def features_fingerprint(conditioning: nn.Module | None) -> str | None:
    """Return the fingerprint of a frozen conditioning, whose features are stored; else None."""
    return fingerprint(conditioning) if conditioning is not None and conditioning.frozen else None


@torch.no_grad()
def encoded(
    scenes: SceneBatch,
    autoreconstructor: VariationalAutoReconstructor,
    conditioning: nn.Module | None,
    precision: torch.dtype,
    device: torch.device | str,
) -> Rows:
    """Return the rows "mean", "log_variance" and "condition" of these scenes' references, by frozen networks."""
    scenes = scenes.to(device)
    images = scenes.reference.images
    views = scenes.all_views() if autoreconstructor.sees_views else None
    posterior, _ = autoreconstructor.posterior(images, views, scenes.depth_range)
    outputs = {"mean": posterior.mean, "log_variance": posterior.log_variance}
    if conditioning is not None:
        outputs["condition"] = conditioning(images)
    stored = {name: value.to(precision).cpu().numpy() for name, value in outputs.items()}
    pictures = (images * 255).round().to(torch.uint8).cpu().numpy()
    return {"condition": pictures, **stored} if conditioning is None else stored


class Moments:
    """Sums over all encoded elements of each channel, in float64, for mean and standard deviation of latents."""

    def __init__(self) -> None:
        self.count, self.total, self.squares = 0, 0.0, 0.0

    def add(
        self, mean: Float[np.ndarray, "row channel _ _"], log_variance: Float[np.ndarray, "row channel _ _"]
    ) -> None:
        """Add more rows."""
        mean, variance = mean.astype(np.float64), np.exp(log_variance.astype(np.float64))
        self.count += mean[:, 0].size
        self.total = self.total + mean.sum((0, 2, 3))
        self.squares = self.squares + (np.square(mean) + variance).sum((0, 2, 3))

    def join(self, other: "Moments") -> None:
        """Add the sums of other rows."""
        self.count += other.count
        self.total = self.total + other.total
        self.squares = self.squares + other.squares

    def results(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return mean and standard deviation; Var[h] = E[mean^2] + E[variance] - E[mean]^2 needs no samples."""
        mean = np.asarray(self.total) / self.count
        std = np.sqrt(np.asarray(self.squares) / self.count - np.square(mean))
        return tuple(mean.tolist()), tuple(std.tolist())


def encode_training_set(
    autoreconstructor: VariationalAutoReconstructor,
    data: SceneDataModule,
    out: Path,
    frames: int | None = None,
    views: int = 7,
    precision: str = "float32",
    conditioning: nn.Module | None = None,
    batch_size: int = 64,
    device: torch.device | str = "cpu",
    progress: bool = True,
) -> LatentCache:
    """Encode every frame of every sequence of a packed training set, without augmentation.

    A finished store of the same encodings is not changed. An interrupted run leaves no readable store. Several
    processes share the batches, and the first one writes the same store as a single process would.

    Args:
        frames: the largest number of frames of a sequence, evenly spaced; None: all.
        views: number of other views, evenly spread over the sequence, for a posterior that sees views.
        precision: "float32", or "float16" for half the space, with relative errors of 2^-11 at most in means (the
            first of the diffusion's timesteps adds noise of 0.029 to latents of unit variance) and 0.8% in variances.
        conditioning: frozen network from images to features, which are stored; None: the images are stored.

    Raises:
        DataError: data not packed or damaged, no space, another store in the folder, or encodings that are not finite.
    """
    views = views if autoreconstructor.sees_views else 0
    source = _packed(data)
    origin = _origin(autoreconstructor, data, conditioning, frames, views, precision)
    if is_latent_cache(out):
        store = LatentCache(out)
        if store.origin != origin:
            raise DataError("already holds another store: choose another folder, or remove this one", str(out))
        logger.info("%s already holds these encodings", out)
        return store
    out.mkdir(parents=True, exist_ok=True)
    features = None if conditioning is None else conditioning.to(device).eval()
    frozen = autoreconstructor.to(device).eval()
    encode = partial(
        encoded, autoreconstructor=frozen, conditioning=features, precision=PRECISIONS[precision], device=device
    )
    load = partial(_loaded, SceneStore(source, source.names, cache=False), views)
    blank = encode(stack([load(next(_references(source, 1, [], False))).scene]))
    _check_space(source, frames, sum(rows.nbytes for rows in blank.values()), out)
    sequences: list[CachedSequence] = []
    progress = progress and is_first()
    batches = _encoded_batches(_references(source, frames, sequences, progress), load, encode, batch_size)
    _write_store(out, origin, blank, batches, sequences)
    return LatentCache(out)


def _packed(data: SceneDataModule) -> PackedSource:
    source = data.source("train")
    if not isinstance(source, PackedSource):
        advice = "run `completesplat data prepare` first, then give overrides=['data.root=STORE']"
        raise DataError(f"the latent cache is made from packed data: {advice}", str(data.root))
    return source


class FrameToEncode(NamedTuple):
    """Scene whose reference is to be encoded, and the number of its frame."""

    scene: SceneBatch
    number: int


def _references(
    source: PackedSource, frames: int | None, sequences: list[CachedSequence], progress: bool
) -> Iterator[tuple[PosedSequence, int]]:
    """Yield sequence and place of all references, by row; append each of their sequences to `sequences`."""
    rows = 0
    for name in track(source.names, "encoding sequences", disable=not progress):
        sequence = source.read(name)
        places = spread_places(len(sequence.frames), frames)
        sequences.append(CachedSequence(name, len(sequence.frames), rows, tuple(places)))
        rows += len(places)
        yield from ((sequence, place) for place in places)


def _loaded(store: SceneStore, views: int, reference: tuple[PosedSequence, int]) -> FrameToEncode:
    sequence, place = reference
    scene = store.scene(sequence, place, spread_around(len(sequence.frames), place, views))
    return FrameToEncode(scene, sequence.frames[place])


def _encoded_batches(
    references: Iterator[tuple[PosedSequence, int]],
    load: Callable[[tuple[PosedSequence, int]], FrameToEncode],
    encode: Callable[[SceneBatch], Rows],
    batch_size: int,
) -> Iterator[tuple[Rows, Moments]]:
    """Yield the rows and moments of all batches, in order; all processes must iterate, because each encodes a share.

    Moments are computed before rows are sent, because their order in memory then changes, and with it the rounding.
    """
    rank, count = processes()
    while group := list(islice(references, count * batch_size)):
        local = group[rank * batch_size : (rank + 1) * batch_size]
        result: tuple[Rows, Moments] | DataError | None = None
        if local:
            try:
                batch = list(map(load, local))
                rows, moments = encode(stack([frame.scene for frame in batch])), Moments()
                _refuse_not_finite(rows, batch)
                moments.add(rows["mean"], rows["log_variance"])
                result = rows, moments
            except DataError as error:  # all processes raise it below
                result = error
        for encoded_there in gathered(result):
            if isinstance(encoded_there, DataError):
                raise encoded_there
            if encoded_there is not None:
                yield encoded_there


def _check_space(source: PackedSource, frames: int | None, bytes_per_frame: int, out: Path) -> None:
    """Log the size of the future store; raise DataError if the disk has less space."""
    most = [len(shard.sequences) * (frames or shard.frames) for shard in source.shards]
    total = sum(min(shard.frames, limit) for shard, limit in zip(source.shards, most, strict=True))
    contents = f"{total:,} frames of {len(source.names):,} sequences"
    require_space(total * bytes_per_frame, contents, out, "; frames=N takes fewer frames of a sequence")


def _write_store(
    out: Path, origin: Origin, blank: Rows, batches: Iterator[tuple[Rows, Moments]], sequences: Sequence[CachedSequence]
) -> None:
    """Write all processes' encodings in the first one; the others wait. `batches` completes `sequences`."""
    if is_first():
        arrays, moments = _write_arrays(out, blank, batches)
        checksums = sha256_of(out / arrays[CHECKSUMS].file)
        facts = (__version__, origin, *moments.results(), arrays, tuple(sequences), checksums)
        write_manifest(out, LatentCacheManifest(*facts))
    else:
        deque(batches, maxlen=0)
    gathered(None)


def _write_arrays(out: Path, blank: Rows, batches: Iterator[tuple[Rows, Moments]]) -> tuple[dict[str, Array], Moments]:
    """Write rows like those of `blank`; return what was written, and its moments."""
    moments = Moments()
    with ExitStack() as files:
        writers = {
            name: files.enter_context(ArrayWriter(out / f"{name}.npy", rows.shape[1:], rows.dtype.name))
            for name, rows in {**blank, CHECKSUMS: row_checksums(blank)}.items()
        }
        for rows, batch_moments in batches:
            moments.join(batch_moments)
            rows[CHECKSUMS] = row_checksums(rows)
            for name, writer in writers.items():
                writer.append(rows[name])
    return {name: writer.described() for name, writer in writers.items()}, moments


def _origin(
    autoreconstructor: VariationalAutoReconstructor,
    data: SceneDataModule,
    conditioning: nn.Module | None,
    frames: int | None,
    views: int,
    precision: str,
) -> Origin:
    if (
        precision not in PRECISIONS
        or (frames is not None and frames < 1)
        or (autoreconstructor.sees_views and views < 1)
    ):
        raise CompleteSplatError(f"needs precision={' or '.join(PRECISIONS)}, frames and views of 1 or more")
    if conditioning is not None and not conditioning.frozen:
        raise CompleteSplatError("a conditioning that is trained needs pictures, not features: leave conditioning out")
    return Origin(
        posterior_fingerprint(autoreconstructor),
        features_fingerprint(conditioning),
        data.source("train").fingerprint(),
        data.packed_settings(),
        data.image_size,
        frames,
        views,
        precision,
    )


def _refuse_not_finite(rows: Rows, scenes: list[FrameToEncode]) -> None:
    for name, values in rows.items():
        finite = np.isfinite(values).all(axis=(1, 2, 3))
        if not finite.all():
            bad = scenes[int(finite.argmin())]
            limits = " in float16: try precision=float32" if values.dtype == np.float16 else ""
            raise DataError(f"its {name} is not finite{limits}", None, str(bad.scene.names), bad.number)
