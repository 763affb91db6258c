"""Supplement's second failed approach as a whole: fit Gaussians, project them, train a VAE on the projections."""

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

from completesplat.baselines.sparse_vae import SparseVAE
from completesplat.data.loading.distributed import processes
from completesplat.data.loading.scenes import SceneStore
from completesplat.errors import CompleteSplatError
from completesplat.files import atomic_path, make_folder
from completesplat.gaussians import Gaussians
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.scene import SceneBatch
from completesplat.settings.schema import Range
from completesplat.splatter_image import SplatterImage
from completesplat.tensors import stack
from completesplat.training.per_scene import Preoptimized

logger = logging.getLogger(__name__)


class FittedScenes:
    """Store of Gaussians that are fitted to all images of a sequence when it is first asked for.

    One sequence at a time is in memory: its images and masks (16 bytes a pixel) and its Gaussians. A file takes 56
    bytes for each Gaussian, so 1,000 sequences with 4,000 Gaussians each take 224 MB.

    Args:
        folder: folder of the files, which several processes may share; scenes in it are not fitted again.
        fit: a batch of one scene -> its Gaussians, in the reference camera's frame.
        settings: text of all that the fit depends on besides the images; another text means other files.
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
        """Fit missing scenes, with a bar or ten log lines; raise DataError if a sequence cannot be read."""
        missing = [name for name in names if not self._path(name).is_file()]
        bar = progress and get_console().is_terminal
        for done, name in enumerate(track(missing, "fitting Gaussians to scenes", disable=not bar), start=1):
            self._make(name)
            if progress and not bar and done * 10 // len(missing) > (done - 1) * 10 // len(missing):
                logger.info("fitted Gaussians to %d of %d scenes", done, len(missing))

    def seen_from(self, name: str, frame: int) -> Gaussians:
        """Return a sequence's Gaussians in the frame of one of its cameras, on the CPU."""
        if not self._path(name).is_file():
            self._make(name)
        cameras = self.stores[name].source.read(name).cameras
        to_frame = cameras[frame].relative_to(cameras[0]).world_to_camera
        return Gaussians(**load_file(self._path(name))).transform(to_frame.float())

    def _make(self, name: str) -> None:
        """Fit a sequence in the frame of its first camera, and write its file."""
        store = self.stores[name]
        sequence = store.source.read(name)
        gaussians = self.fit(stack([store.scene(sequence, 0, range(1, len(sequence.frames)))]))[0]
        with atomic_path(self._path(name)) as temporary:
            save_file({key: value.cpu().contiguous() for key, value in vars(gaussians).items()}, temporary)

    def _path(self, name: str) -> Path:
        """Return the file of a sequence, named by a hash because names of sequences may have slashes."""
        key = hashlib.sha256(f"{name}\n{self.settings}".encode()).hexdigest()[:24]
        return self.folder / f"{key}.safetensors"


class PreoptimizedVAE(Preoptimized):
    """Training and test of a VAE on `Preoptimized`'s Splatter Images.

    Before training, Gaussians are fitted to each training sequence and stored in files (`FittedScenes`). Validation
    sequences are fitted when they are first used. A training step projects these Gaussians into the Splatter Images of
    its reference views, so image augmentation has no effect. Test scenes are fitted when they are tested, to the views
    that they are scored on.

    The paper does not state the loss. Here it is the mean error of depth, offset, scale, rotation and colour, plus the
    weighted error of the opacity (`SparseVAE.errors`), plus the weighted KL. The KL is divided by the number of raw
    values, as `KullbackLeibler` divides it by that of an image.

    Args:
        folder: folder of the fitted Gaussians.
        normalization_batches: number of training batches on which the normalisation of raw values is measured.
        opacity_weight, kl_weight: weights in the loss.
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
        """Fit the training set, each process a share, and measure the normalisation."""
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
        """Return stored Gaussians of whole sequences during training; otherwise fit Gaussians to the scenes' views."""
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
        """Return the Gaussians of Splatter Images that have passed through the VAE."""
        image: SplatterImage = self.vae(self.splatter_image(scenes, seed)).splatter_image
        return image.gaussians(scenes.reference.cameras, scenes.depth_range)
