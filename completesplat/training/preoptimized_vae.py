"""The supplement's second failed approach as a whole: fit Gaussians, project them, train a VAE on the projections."""

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import torch
from jaxtyping import Float
from rich import get_console
from rich.progress import track
from safetensors.torch import load_file, save_file
from torch import Tensor

from completesplat.atomic import atomic_path, make_folder
from completesplat.baselines.sparse_vae import SparseVAE
from completesplat.data.loading.distributed import processes
from completesplat.data.loading.scenes import SceneStore
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.scene import SceneBatch
from completesplat.schema import Range
from completesplat.splatter_image import SplatterImage
from completesplat.tensors import stack
from completesplat.training.per_scene import Preoptimized

logger = logging.getLogger(__name__)


class FittedScenes:
    """Fits each sequence when it is first asked for, to all its pictures; what is in the folder is not fitted again.

    One sequence at a time is in memory: its pictures and masks (16 bytes a pixel) and its Gaussians. A file takes 56
    bytes for each Gaussian, a folder of 1,000 sequences with 4,000 Gaussians each 224 MB.

    Args:
        folder: of the files, which several processes may share.
        fit: a batch of one scene -> its Gaussians, in the reference camera's frame.
        settings: what the fit depends on besides the pictures: another text means other files.
    """

    def __init__(
        self, folder: Path, stores: Sequence[SceneStore], fit: Callable[[SceneBatch], Gaussians], settings: str
    ) -> None:
        make_folder(folder)
        self.folder = folder
        self.stores = {name: store for store in stores for name in store.names}
        self.fit = fit
        self.settings = settings

    def complete(self, names: Sequence[str], progress: bool) -> None:
        """Fit those that are not there yet (`DataError` if a sequence cannot be read); a bar, or ten lines, show it."""
        missing = [name for name in names if not self._path(name).is_file()]
        bar = progress and get_console().is_terminal
        for done, name in enumerate(track(missing, "fitting Gaussians to scenes", disable=not bar), start=1):
            self._make(name)
            if progress and not bar and done * 10 // len(missing) > (done - 1) * 10 // len(missing):
                logger.info("fitted Gaussians to %d of %d scenes", done, len(missing))

    def seen_from(self, name: str, frame: int) -> Gaussians:
        """A sequence's Gaussians in the frame of one of its cameras, on the CPU."""
        if not self._path(name).is_file():
            self._make(name)
        cameras = self.stores[name].source.read(name).cameras
        to_frame = cameras[frame].relative_to(cameras[0]).world_to_camera
        return Gaussians(**load_file(self._path(name))).transform(to_frame.float())

    def _make(self, name: str) -> None:
        """In the frame of the first camera."""
        store = self.stores[name]
        sequence = store.source.read(name)
        gaussians = self.fit(stack([store.scene(sequence, 0, range(1, len(sequence.frames)))]))[0]
        with atomic_path(self._path(name)) as temporary:
            save_file({key: value.cpu().contiguous() for key, value in vars(gaussians).items()}, temporary)

    def _path(self, name: str) -> Path:
        """Names of sequences may have slashes."""
        key = hashlib.sha256(f"{name}\n{self.settings}".encode()).hexdigest()[:24]
        return self.folder / f"{key}.safetensors"


class PreoptimizedVAE(Preoptimized):
    """A VAE trained on `Preoptimized`'s Splatter Images, and what it makes of the test scenes' ones.

    Before training, Gaussians are fitted to each training sequence and kept in files (`FittedScenes`), to those of the
    validation set when they are first looked at. From these a training step makes the Splatter Images of its reference
    views, so the pictures' augmentation has no effect. Scenes of the test are fitted as they are tested, to the views
    that they are scored on.

    The loss, which the paper does not state, is the mean of the errors of depth, offset, scale, rotation and colour,
    plus the weighted error of the opacity (`SparseVAE.errors`), plus the weighted KL, divided by the number of raw
    values as `KullbackLeibler` is by those of a picture.

    Args:
        folder: of the fitted Gaussians.
        normalization_batches: of the training set, on which the normalisation of raw values is measured.
        opacity_weight, kl_weight: of the loss.
        **preoptimized: see `Preoptimized`.
    """

    def __init__(
        self,
        vae: SparseVAE,
        folder: str,
        normalization_batches: int,
        opacity_weight: Annotated[float, Range(0)],
        kl_weight: Annotated[float, Range(0)],
        **preoptimized: Any,
    ) -> None:
        super().__init__(vae.reconstructor.parameterization, **preoptimized)
        self.vae = vae
        self.folder = Path(folder)
        self.normalization_batches = normalization_batches
        self.opacity_weight = opacity_weight
        self.kl_weight = kl_weight
        self._kept: FittedScenes | None = None

    def on_fit_start(self) -> None:
        """Fit the training set, each process its share of it, and measure the normalisation."""
        trainer: Any = self.trainer
        data = trainer.datamodule
        if data.latent_cache is not None:
            raise CompleteSplatError("data.latent_cache is for model=latent_diffusion: set it to null")
        terms = {name: term.weight for name, term in self.loss.terms.items()}
        settings = f"{self.fitting} {terms} {self.background} {data.image_size}"
        stores = [data.store("val"), data.store("train")]
        self._kept = FittedScenes(self.folder, stores, super().fitted, settings)
        rank, count = processes()
        self._kept.complete(data.store("train").names[rank::count], progress=trainer.is_global_zero)
        trainer.strategy.barrier("FittedScenes")
        batches = islice(data.train_dataloader(), self.normalization_batches)
        self.vae.measure(self.splatter_image(scenes.to(self.device)) for scenes in batches)

    def on_fit_end(self) -> None:
        self._kept = None

    def fitted(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """While it is trained, what is kept of whole sequences; otherwise Gaussians fitted to the scenes' views."""
        if self._kept is None:
            gaussians = super().fitted(scenes, seed)
            return replace(gaussians, quaternions=normalize_quaternion(gaussians.quaternions))
        frames = zip(scenes.names, scenes.reference_frame.tolist(), strict=True)
        return stack([self._kept.seen_from(name, frame) for name, frame in frames]).to(self.device)

    def training_step(self, scenes: SceneBatch, index: int) -> Float[Tensor, ""]:
        truth = self.splatter_image(scenes)
        reconstruction = self.vae(truth)
        assert reconstruction.posterior is not None
        with torch.autocast(self.device.type, enabled=False):
            errors = self.vae.errors(reconstruction.splatter_image, truth)
            kl = reconstruction.posterior.kl().mean() / truth.raw[0].numel()
            opacity = errors.pop("opacity")
            values = torch.stack(list(errors.values())).mean()
            total: Tensor = values + self.opacity_weight * opacity + self.kl_weight * kl
        logged = {f"train/{name}": value.detach() for name, value in (errors | {"opacity": opacity, "kl": kl}).items()}
        self.log_step({"train/loss": total.detach(), **logged}, batch_size=len(scenes.names))
        return total

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Gaussians of the Splatter Images after they have passed through the VAE."""
        image: SplatterImage = self.vae(self.splatter_image(scenes, seed)).splatter_image
        return image.gaussians(scenes.reference.cameras, scenes.depth_range)
