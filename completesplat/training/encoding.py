"""The latent cache: a training set encoded once by the frozen autoreconstructor, and latents drawn from it."""

import hashlib
import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from rich.progress import track
from torch import Tensor, nn

from completesplat import __version__
from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.posterior import Posterior
from completesplat.data.latent_cache import (
    Array,
    ArrayWriter,
    CachedSequence,
    LatentCache,
    LatentCacheManifest,
    Origin,
    is_latent_cache,
    write_manifest,
)
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.packed.source import PackedSource
from completesplat.data.packed.writing import require_space
from completesplat.data.sequences import SequenceSource, spread_places
from completesplat.errors import CompleteSplatError, DataError, WeightsError
from completesplat.scene import CachedScene

PRECISIONS = {"float32": torch.float32, "float16": torch.float16}
Rows = dict[str, Shaped[np.ndarray, "picture _ _ _"]]

logger = logging.getLogger(__name__)


def latent_draw(batch: CachedScene, scale: Tensor | float) -> Float[Tensor, "batch channel height width"]:
    """One draw of each scaled latent: the same noise as `CompleteSplat.encode` draws."""
    return Posterior(batch.mean, batch.log_variance).sample() * scale


def fingerprint(module: nn.Module) -> str:
    """SHA-256 (hexadecimal) of a module's weights: names, types, shapes and bytes."""
    digest = hashlib.sha256()
    for name, value in sorted(module.state_dict().items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)} ".encode())
        digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def check_cache(
    store: LatentCache,
    autoreconstructor: VariationalAutoReconstructor,
    source: SequenceSource,
    conditioning: nn.Module | None = None,
) -> None:
    """Refuse a stale cache. (The data module compares picture sizes and all other settings of the data.)

    Args:
        conditioning: a frozen one needs its own features, one that is trained needs pictures; None is not looked at.

    `WeightsError`: made with another autoreconstructor or conditioning; `DataError`: of other data, or its latents
    have another shape than this autoreconstructor's.
    """
    if store.origin.encoder != fingerprint(autoreconstructor.encoder):
        raise WeightsError(f"{store.folder}: made with another autoreconstructor; encode the training set again")
    store.must_be_of(source)
    device = next(autoreconstructor.parameters()).device
    blank = torch.zeros(1, 3, store.origin.image_size, store.origin.image_size, device=device)
    with torch.no_grad():
        shape = tuple(autoreconstructor.encoder(blank)[0].mean.shape[1:])
    if shape != store.latent_shape:
        raise DataError(f"latents of {store.latent_shape}, the autoreconstructor's are {shape}", str(store.folder))
    if conditioning is not None and store.origin.conditioning != features_fingerprint(conditioning):
        held = "pictures" if store.holds_pictures else "features of another conditioning"
        raise WeightsError(f"{store.folder}: holds {held}; encode the training set again with this run's conditioning")


def features_fingerprint(conditioning: nn.Module | None) -> str | None:
    """Of a frozen conditioning, whose features are stored; None for one that is trained on pictures, or for none."""
    return fingerprint(conditioning) if conditioning is not None and conditioning.frozen else None


@torch.no_grad()
def encoded(
    pictures: UInt8[Tensor, "picture 3 size size"],
    encoder: Encoder,
    conditioning: nn.Module | None,
    precision: torch.dtype,
    device: torch.device | str,
) -> Rows:
    """The rows "mean", "log_variance" and "condition" of these pictures, by frozen networks."""
    # Divided as everywhere: torch multiplies by 1 / 255 on a GPU.
    images = torch.from_numpy(np.divide(pictures.numpy(), 255, dtype=np.float32)).to(device)
    posterior, _ = encoder(images)
    made = {"mean": posterior.mean, "log_variance": posterior.log_variance}
    if conditioning is not None:
        made["condition"] = conditioning(images)
    stored = {name: value.to(precision).cpu().numpy() for name, value in made.items()}
    return {"condition": pictures.numpy(), **stored} if conditioning is None else stored


class Moments:
    """Sums over all elements of what was encoded, in float64, for the deviation of a draw."""

    def __init__(self) -> None:
        self.count, self.total, self.squares = 0, 0.0, 0.0

    def add(self, mean: Float[np.ndarray, "*any"], log_variance: Float[np.ndarray, "*any"]) -> None:
        """Some more elements."""
        mean, variance = mean.astype(np.float64), np.exp(log_variance.astype(np.float64))
        self.count += mean.size
        self.total += float(mean.sum())
        self.squares += float((np.square(mean) + variance).sum())

    def scale(self) -> float:
        """1 / std, from Var[h] = E[mean^2] + E[variance] - E[mean]^2: no draw is needed for it."""
        return float((self.squares / self.count - (self.total / self.count) ** 2) ** -0.5)


def encode_training_set(
    autoreconstructor: VariationalAutoReconstructor,
    data: SceneDataModule,
    out: Path,
    frames: int | None = None,
    precision: str = "float32",
    conditioning: nn.Module | None = None,
    batch_size: int = 64,
    device: torch.device | str = "cpu",
    progress: bool = True,
) -> LatentCache:
    """Encode every frame of every sequence of a packed training set, as it is without augmentation.

    A finished store of the same is left as it is. Nothing that opens is left behind by a run that was interrupted.

    Args:
        frames: the largest number of frames of a sequence, evenly spaced; None: all.
        precision: "float32", or "float16" for half the space, with relative errors of 2^-11 at most in means (the
            first of the diffusion's timesteps adds noise of 0.029 to latents of deviation 1) and 0.8% in variances.
        conditioning: frozen, images -> features, which are stored; None: the pictures are.

    `DataError`: data not packed or damaged, no space, another store in the folder, or encodings that are not finite.
    """
    if precision not in PRECISIONS or (frames is not None and frames < 1) or batch_size < 1:
        raise CompleteSplatError(f"needs precision={' or '.join(PRECISIONS)}, 1 <= frames and 1 <= batch_size")
    source = data.source("train")
    if not isinstance(source, PackedSource):
        advice = "run `completesplat data prepare` first, then give overrides=['data.root=STORE']"
        raise DataError(f"the latent cache is made from packed data: {advice}", str(data.root))
    origin = _origin(autoreconstructor, data, conditioning, frames, precision)
    if is_latent_cache(out):
        store = LatentCache(out)
        if store.origin != origin:
            raise DataError("already holds another store: choose another folder, or remove this one", str(out))
        logger.info("%s already holds these encodings", out)
        return store
    out.mkdir(parents=True, exist_ok=True)
    features = None if conditioning is None else conditioning.to(device).eval()
    encoder = autoreconstructor.to(device).eval().encoder
    encode = partial(encoded, encoder=encoder, conditioning=features, precision=PRECISIONS[precision], device=device)
    blank = encode(torch.zeros(1, 3, data.image_size, data.image_size, dtype=torch.uint8))
    _check_space(source, frames, sum(rows.nbytes for rows in blank.values()), out)
    sequences: list[CachedSequence] = []
    pictures = _pictures(source, frames, sequences, progress)
    arrays, scale = _write_arrays(out, encode, blank, pictures, batch_size)
    write_manifest(out, LatentCacheManifest(__version__, origin, scale, arrays, tuple(sequences)))
    return LatentCache(out)


class FrameToEncode(NamedTuple):
    """A picture that is to be encoded, and the frame that it is of."""

    image: UInt8[Tensor, "3 size size"]
    sequence: str
    number: int


def _pictures(
    source: PackedSource, frames: int | None, sequences: list[CachedSequence], progress: bool
) -> Iterator[FrameToEncode]:
    """All pictures in the order of their rows; `sequences` gets an entry for each sequence that they are of."""
    rows = 0
    for name in track(source.names, "encoding sequences", disable=not progress):
        sequence = source.read(name)
        places = spread_places(len(sequence.frames), frames)
        sequences.append(CachedSequence(name, len(sequence.frames), rows, tuple(places)))
        rows += len(places)
        for place in places:
            yield FrameToEncode(sequence.read(place).image, name, sequence.frames[place])


def _check_space(source: PackedSource, frames: int | None, bytes_per_frame: int, out: Path) -> None:
    """Say how large the store is going to be; `DataError` if the disk has less space than that."""
    most = [len(shard.sequences) * (frames or shard.frames) for shard in source.shards]
    total = sum(min(shard.frames, limit) for shard, limit in zip(source.shards, most, strict=True))
    contents = f"{total:,} frames of {len(source.names):,} sequences"
    require_space(total * bytes_per_frame, contents, out, "; frames=N takes fewer frames of a sequence")


def _write_arrays(
    out: Path, encode: Callable[[Tensor], Rows], blank: Rows, pictures: Iterator[FrameToEncode], batch_size: int
) -> tuple[dict[str, Array], float]:
    """Rows like those of `blank` for all pictures; what was written, and the scale."""
    moments = Moments()
    with ExitStack() as files:
        writers = {
            name: files.enter_context(ArrayWriter(out / f"{name}.npy", rows.shape[1:], rows.dtype.name))
            for name, rows in blank.items()
        }
        while batch := list(islice(pictures, batch_size)):
            rows = encode(torch.stack([picture.image for picture in batch]))
            _refuse_not_finite(rows, batch)
            moments.add(rows["mean"], rows["log_variance"])
            for name, writer in writers.items():
                writer.append(rows[name])
    return {name: writer.described() for name, writer in writers.items()}, moments.scale()


def _origin(
    autoreconstructor: VariationalAutoReconstructor,
    data: SceneDataModule,
    conditioning: nn.Module | None,
    frames: int | None,
    precision: str,
) -> Origin:
    if conditioning is not None and not conditioning.frozen:
        raise CompleteSplatError("a conditioning that is trained needs pictures, not features: leave conditioning out")
    return Origin(
        fingerprint(autoreconstructor.encoder),
        features_fingerprint(conditioning),
        data.source("train").fingerprint(),
        data.packed_settings(),
        data.image_size,
        frames,
        precision,
    )


def _refuse_not_finite(rows: Rows, pictures: list[FrameToEncode]) -> None:
    for name, values in rows.items():
        finite = np.isfinite(values).all(axis=(1, 2, 3))
        if not finite.all():
            bad = pictures[int(finite.argmin())]
            limits = " in float16: try precision=float32" if values.dtype == np.float16 else ""
            raise DataError(f"its {name} is not finite{limits}", None, bad.sequence, bad.number)
