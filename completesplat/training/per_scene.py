"""Gaussians fitted to every scene separately, as they are, as Splatter Images, and as training data of a VAE."""

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from rich.progress import track
from safetensors.torch import load_file, save
from torch import Tensor

from completesplat.baselines.fitting import FittingSettings, fit_gaussians
from completesplat.baselines.preoptimized import SparseVAE, project_to_splatter_image
from completesplat.data.loading.distributed import gather_values, processes
from completesplat.data.loading.scenes import SceneStore
from completesplat.errors import CompleteSplatError
from completesplat.evaluation.naive_predictors import Renders
from completesplat.evaluation.scorer import Scorer
from completesplat.export.fitted_scene import FittedViews, write_fitted_scene
from completesplat.export.placed_scene import PlacedScene
from completesplat.files import make_folder, write_bytes
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.losses import WeightedSum
from completesplat.quantities import NonNegative
from completesplat.scene import SceneBatch, Views
from completesplat.splatter_image import Parameterization, SplatterImage
from completesplat.tensors import stack
from completesplat.training.stage import Stage
from completesplat.wording import counted, safe_name

logger = logging.getLogger(__name__)


class PerScene(Scorer):
    """Upper bound: Gaussians are fitted to all views of each scene, also to those that they are scored on.

    `loss` is that of the fit.

    Args:
        scenes_folder: folder for a folder of each test scene (`write_fitted_scene`); None: no scenes are written.
    """

    upper_bound = True
    fitted_to = "each scene's test views, the ones that it is scored on"
    unused_settings: tuple[str, ...] = ("optimizer", "schedule", "trainer.max_", "trainer.val_check")

    def __init__(
        self, loss: WeightedSum, fitting: FittingSettings, scenes_folder: str | None = None, **others: Any
    ) -> None:
        super().__init__(**others)
        self.loss = loss
        self.fitting = fitting
        self.scenes_folder = None if scenes_folder is None else Path(scenes_folder)

    def scene_scored(self, name: str, gaussians: Gaussians, cameras: Cameras, images: Renders, truth: Views) -> None:
        """Write the scene, or log a warning if it has nothing that can be written."""
        if self.scenes_folder is None:
            return
        folder = self.scenes_folder / safe_name(name)
        seed = self.evaluation.scene_seed(name)
        try:
            make_folder(self.scenes_folder)
            make_folder(folder)
            title = f"{name}: fitted to these views"
            scene = PlacedScene(gaussians[0], cameras[0])
            write_fitted_scene(folder, name, title, scene, FittedViews(images[0], truth.images), seed)
        except CompleteSplatError as error:
            logger.warning("%s: %s", folder, error)

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Fit each scene to its reference and all its targets."""
        views = scenes.all_views()
        generator = torch.Generator().manual_seed(seed)
        with torch.autocast(self.device.type, enabled=False):
            return fit_gaussians(
                views,
                scenes.depth_range,
                self.rasterizer,
                self.background,
                self.loss,
                self.fitting,
                generator,
            )


class Preoptimized(PerScene):
    """Fitted Gaussians, as many as a Splatter Image of the reference view has room for.

    Like `PerScene`, it has seen the views that it is scored on. The results of a test have the share of pixels without
    any Gaussian as `empty_pixels`, a mean over scenes. The paper reports 80 %.
    """

    def __init__(self, parameterization: Parameterization, **fitting_and_rendering: Any) -> None:
        super().__init__(**fitting_and_rendering)
        self.parameterization = parameterization
        self._empty: dict[str, float] = {}

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Fit each scene, and select the Gaussians that fit into its reference view's Splatter Image."""
        return self.splatter_image(scenes, seed).gaussians(scenes.reference.cameras, scenes.depth_range)

    def splatter_image(self, scenes: SceneBatch, seed: int = 0) -> SplatterImage:
        """Return each scene's fitted Gaussians in the pixels of its reference view."""
        gaussians = self.fitted(scenes, seed)
        cameras = scenes.reference.cameras
        image, empty = project_to_splatter_image(gaussians, cameras, scenes.depth_range, self.parameterization)
        shares = empty.float().mean(dim=(1, 2)).tolist()
        self._empty.update(zip(scenes.names, shares, strict=True))
        return image

    def fitted(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Return Gaussians fitted to each scene's reference and targets, in the reference camera's frame."""
        return super().reconstruct(scenes, seed)

    def on_test_start(self) -> None:
        super().on_test_start()
        self._empty = {}

    def test_results(self) -> dict[str, dict[str, Any]]:
        """Return the results of `Scorer` and `empty_pixels`, the mean over the scenes of all processes."""
        results = super().test_results()
        empty: dict[str, float] = {}
        for shares in gather_values(self._empty):
            empty.update(shares)
        results["model"]["empty_pixels"] = sum(empty.values()) / max(len(empty), 1)
        return results


class FittedScenes:
    """Store of Gaussians that are fitted to all images of a sequence when they are first needed.

    One sequence at a time is in memory (16 bytes a pixel, and Gaussians). A file takes 56 bytes for each Gaussian.

    Args:
        folder: folder of the files, which several processes may share. Scenes in it are not fitted again.
        fit: a batch of one scene -> its Gaussians, in the reference camera's frame.
        settings: text of all settings that the fit depends on. Another text means other files.
    """

    def __init__(
        self, folder: Path, stores: Sequence[SceneStore], fit: Callable[[SceneBatch], Gaussians], settings: str
    ) -> None:
        make_folder(folder)
        self.folder = folder
        self.stores: dict[str, SceneStore] = {}
        for store in stores:
            self.stores.update(dict.fromkeys(store.names, store))
        self.fit = fit
        self.settings = settings

    def complete(self, names: Sequence[str], progress: bool) -> None:
        """Fit the scenes that have no file.

        Raises:
            DataError: a sequence cannot be read.
        """
        missing = [name for name in names if not self._path(name).is_file()]
        for name in track(missing, "fitting Gaussians to scenes", disable=not progress):
            self._fitted(name)
        if missing:
            logger.info("fitted Gaussians to %s", counted(len(missing), "scene"))

    def seen_from(self, name: str, frame: int) -> Gaussians:
        """Return a sequence's Gaussians in the frame of one of its cameras, on the CPU."""
        cameras = self.stores[name].source.read(name).cameras
        to_frame = cameras[frame].relative_to(cameras[0]).world_to_camera
        return self._fitted(name).transform(to_frame.float())

    def _fitted(self, name: str) -> Gaussians:
        """Return a sequence's Gaussians in the frame of its first camera, fitted now if there is no file of them."""
        path = self._path(name)
        if not path.is_file():
            store = self.stores[name]
            sequence = store.source.read(name)
            scene = store.scene(sequence, 0, range(1, len(sequence.frames)))
            gaussians = self.fit(stack([scene]))[0]
            write_bytes(path, save({key: value.cpu().contiguous() for key, value in vars(gaussians).items()}))
        return Gaussians(**load_file(path))

    def _path(self, name: str) -> Path:
        """Return the file of a sequence, which is named by a hash because sequence names may have slashes."""
        key = hashlib.sha256(f"{name}\n{self.settings}".encode()).hexdigest()[:24]
        return self.folder / f"{key}.safetensors"


class PreoptimizedVAE(Preoptimized, Stage):
    """Training and test of a VAE on `Preoptimized`'s Splatter Images.

    Before training, Gaussians are fitted to each training sequence and stored in files (`FittedScenes`). Validation
    sequences are fitted when they are first used. A training step projects these Gaussians into the Splatter Images of
    its reference views, so image augmentation has no effect. Test scenes are fitted to the views they are scored on.

    The paper does not state the loss. Here it is the mean error of depth, offset, scale, rotation and colour, plus the
    weighted error of the opacity (`SparseVAE.errors`), plus the weighted KL. The KL is divided by the number of raw
    values, as `KullbackLeibler` divides it by that of an image.

    Args:
        folder: folder of the fitted Gaussians.
        normalization_batches: number of training batches on which the normalisation of raw values is measured.
        opacity_weight, kl_weight: weights in the loss.
        **preoptimized: see `Preoptimized`.
    """

    unused_settings = ()

    def __init__(
        self,
        vae: SparseVAE,
        folder: str,
        normalization_batches: int,
        opacity_weight: NonNegative,
        kl_weight: NonNegative,
        **preoptimized: Any,
    ) -> None:
        super().__init__(parameterization=vae.reconstructor.parameterization, **preoptimized)
        self.vae = vae
        self.folder = Path(folder)
        self.normalization_batches = normalization_batches
        self.opacity_weight = opacity_weight
        self.kl_weight = kl_weight
        self._stored: FittedScenes | None = None

    def on_fit_start(self) -> None:
        """Fit the training set, each process a share, and measure the normalisation."""
        data = self.data
        if data.latent_cache is not None:
            raise CompleteSplatError("data.latent_cache is for model=latent_diffusion: set it to null")
        terms = {name: term["weight"] for name, term in self.loss.terms.items()}
        images = (data.image_size, data.background, data.mask_threshold, data.packed_settings())
        settings = f"{self.fitting} {terms} {self.background} {images} {data.source('train').fingerprint()}"
        stores = [data.store("val"), data.store("train")]
        self._stored = FittedScenes(self.folder, stores, super().fitted, settings)
        rank, count = processes()
        self._stored.complete(data.store("train").names[rank::count], progress=rank == 0)
        self.trainer.strategy.barrier("FittedScenes")
        batches = islice(data.train_dataloader(), self.normalization_batches)
        self.vae.measure(self.splatter_image(scenes.to(self.device)) for scenes in batches)

    def on_fit_end(self) -> None:
        self._stored = None

    def fitted(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Return Gaussians of whole sequences from files in training, else Gaussians fitted to the scenes' views."""
        if self._stored is None:
            gaussians = super().fitted(scenes, seed)
            return replace(gaussians, quaternions=normalize_quaternion(gaussians.quaternions))
        parts = []
        for name, frame in zip(scenes.names, scenes.reference_frame.tolist(), strict=True):
            parts.append(self._stored.seen_from(name, frame))
        return stack(parts).to(self.device)

    def training_step(self, scenes: SceneBatch, index: int) -> Float[Tensor, ""]:
        truth = self.splatter_image(scenes)
        reconstruction = self.vae(truth)
        assert reconstruction.posterior is not None
        with torch.autocast(self.device.type, enabled=False):
            errors = self.vae.errors(reconstruction.splatter_image, truth)
            kl = reconstruction.posterior.kl().mean() / truth.raw[0].numel()
            values = torch.stack([error for name, error in errors.items() if name != "opacity"]).mean()
            total: Tensor = values + self.opacity_weight * errors["opacity"] + self.kl_weight * kl
        figures = {"train/loss": total.detach(), "train/kl": kl.detach()}
        for name, error in errors.items():
            figures[f"train/{name}"] = error.detach()
        self.log_step(figures, batch_size=len(scenes.names))
        return total

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Return the Gaussians of Splatter Images that have passed through the VAE."""
        image: SplatterImage = self.vae(self.splatter_image(scenes, seed)).splatter_image
        return image.gaussians(scenes.reference.cameras, scenes.depth_range)
