"""Base class of both training stages: it renders batches of scenes, scores the renders, and times the work."""

import statistics
import time
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from hydra.utils import instantiate
from jaxtyping import Float
from lightning import LightningModule
from lightning.pytorch.plugins import Precision
from lightning.pytorch.utilities.enums import GradClipAlgorithmType
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.distributed import gathered, mean_of_processes
from completesplat.data.loading.loader import SceneLoader
from completesplat.errors import WeightsError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.metrics.images import psnr
from completesplat.metrics.scoring import MODEL, REGIONS, Evaluation
from completesplat.opening import check_names, without_training
from completesplat.rasterizers import Rasterizer, Rendering
from completesplat.scene import Batch, SceneBatch, Views
from completesplat.settings.schema import Share
from completesplat.weights.checkpoint_reading import load_part, read_checkpoint

Result = TypeVar("Result")
Renders = Float[Tensor, "batch view 3 height width"]

IN_PROGRESS_BAR = ("train/loss", "train/psnr")


def copy_reference(scenes: SceneBatch) -> Renders:
    """Return the reference image for every view. A model that does not beat this and `repeat_image` learned nothing."""
    return scenes.reference.images[:, None].expand_as(scenes.all_views().images)


def mirror_reference(scenes: SceneBatch) -> Renders:
    """Return the reference image, flipped left to right, for every view: often the best naive guess of a back."""
    return copy_reference(scenes).flip(-1)


def repeat_image(image: Float[Tensor, "3 height width"], scenes: SceneBatch) -> Renders:
    """Return an image for every view; the training set's mean image is the best constant prediction of the MSE."""
    return image.to(scenes.reference.images).expand_as(scenes.all_views().images)


def now() -> float:
    """Return the time in seconds, after the GPU, if there is one, has finished its work."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def prepare_network(network: nn.Module, channels_last: bool, compile: bool) -> torch.memory_format:
    """Order convolution weights in NHWC, or compile on the first call; return the order that images should have."""
    if channels_last:
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if compile:
        network.compile()
    return torch.channels_last if channels_last else torch.contiguous_format


class Stage(LightningModule):
    """Base class of models that turn reference images into Gaussians.

    Args:
        schedule: optimizer and steps of the run -> learning-rate schedule, stepped every optimizer step.
        background: grey value (0 to 1) seen where the Gaussians leave a pixel open.
    """

    upper_bound = False
    """Whether the model has seen the views that it is scored on."""

    fitted_to: str | None = None
    """What Gaussians are fitted to, if scenes are fitted rather than predicted; for tables."""

    without_effect: tuple[str, ...] = ()
    """Beginnings of the names of settings that this model does not use, which are refused where a user gives them."""

    draws_samples = False
    """Whether the model has several answers for one image."""

    def __init__(
        self,
        rasterizer: Rasterizer,
        optimizer: Callable[[Iterable[Tensor]], Optimizer],
        schedule: Callable[[Optimizer, float], LRScheduler],
        background: Share = 0.5,
    ) -> None:
        super().__init__()
        self.rasterizer = rasterizer
        self.optimizer = optimizer
        self.schedule = schedule
        self.background = background
        self.evaluation = Evaluation()
        self.seconds: dict[str, list[float]] = defaultdict(list)  # for each scene, by the name of the work
        self.config: Mapping[str, Any] | None = None
        self.gradient_norm: Tensor | None = None  # of this step, if `BadSteps` has computed it
        self._lr: float | None = None
        self.accumulated: list[int] = []  # numbers of scenes of the batches since the last step
        # Lightning's name: some of several processes that test may have no scene.
        self.allow_zero_length_dataloader_with_multiple_devices = True

    @property
    def lr(self) -> float | None:
        """Return the learning rate that Lightning's `LearningRateFinder` has set, None if the optimizer has its own."""
        return self._lr

    @lr.setter
    def lr(self, rate: float) -> None:
        self._lr = rate
        for config in [] if self._trainer is None else self._trainer.lr_scheduler_configs:  # of a run that has begun
            config.scheduler.base_lrs = [rate] * len(config.scheduler.base_lrs)

    @abstractmethod
    def reconstruct(self, scenes: SceneBatch, seed: int) -> Gaussians:
        """Return one set of Gaussians [batch] for each reference image, in its camera's frame."""

    def draw(self, scenes: SceneBatch, seeds: Sequence[int], samples: int, batch: int | None = None) -> Gaussians:
        """Return `samples` sets for each image and its seed [batch * samples], but one each if nothing is drawn."""
        return self.reconstruct(scenes, seeds[0])

    @property
    def up(self) -> Float[Tensor, "3"]:
        """Return the direction up in the reference camera's frame: as measured on the training set, or the image's."""
        return torch.tensor((0.0, -1.0, 0.0))

    def latent_figures(self, scenes: SceneBatch) -> dict[str, float]:
        """Return figures of the scenes' latents to log, if the model has a posterior."""
        return {}

    def save_weights(self, folder: Path) -> None:
        """Write the weights that `predict` and `from_pretrained` read, if the model makes scenes from photos."""

    @property
    def data(self) -> SceneDataModule:
        """Return the trainer's data module."""
        return cast(SceneDataModule, self.trainer.datamodule)  # type: ignore[attr-defined]

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]
        cls, checkpoint_path: str | Path, map_location: torch.device | str | None = None, trust: bool = False
    ) -> Any:
        """Build the model of a checkpoint from the config in it (`hyper_parameters`), with its weights.

        Args:
            trust: the checkpoint names your own modules, and you trust its author; not needed below the working folder.

        Raises:
            WeightsError: the checkpoint is damaged, missing, of another class, has no config, or `check_names` fails.
        """
        path = Path(checkpoint_path)
        config = read_checkpoint(path).get("hyper_parameters")
        if not isinstance(config, dict) or not isinstance(config.get("model"), dict):
            raise WeightsError(f"{path}: has no config; train with `fit`, or with what completesplat.instantiate gives")
        check_names(config, path, path.resolve().parent.parent, trust)
        module = instantiate(without_training(OmegaConf.create(config)).model, _convert_="all")
        if not isinstance(module, cls):
            raise WeightsError(f"{path}: holds a {type(module).__name__}, which is no {cls.__name__}")
        load_part(module, path, prefix="")
        module.config = config
        return module if map_location is None else module.to(map_location)

    def keep_config(self, config: DictConfig) -> None:
        """Store a config of the model, resolved, for checkpoints and weights."""
        model = OmegaConf.create({"model": OmegaConf.to_container(config, resolve=True)})
        self.config = cast(dict[str, Any], OmegaConf.to_container(without_training(model)))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the config, which `load_from_checkpoint` reads."""
        if self.config is not None:
            checkpoint["hyper_parameters"] = dict(self.config)

    @property
    def method(self) -> str:
        """Return the model's name in tables."""
        return type(self).__name__

    def render_from(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render several sets of Gaussians [sample], each from the same cameras [view]: [sample view]."""
        count = len(gaussians.means)
        repeated = cameras.map(lambda tensor: tensor.expand(count, *tensor.shape))
        with torch.autocast(self.device.type, enabled=False):
            return self.rasterizer(gaussians, repeated)

    def render(self, gaussians: Gaussians, cameras: Cameras) -> Renders:
        """Render scenes [batch] from cameras [batch view], in full precision even if the network runs in less."""
        with torch.autocast(self.device.type, enabled=False):
            return self.rasterizer(gaussians, cameras).over(self.background)

    def log_step(self, values: dict[str, Tensor], batch_size: int) -> None:
        """Log figures of a training step: their means over all processes.

        They are sent in one message, because with Lightning's `sync_dist` processes would wait for each figure.
        """
        for name, value in mean_of_processes(values).items():
            self.log(name, value, prog_bar=name in IN_PROGRESS_BAR, batch_size=batch_size)

    def novel_psnr(self, gaussians: Gaussians, scenes: SceneBatch) -> Float[Tensor, "batch target"]:
        """Return the PSNR of the target views, in dB."""
        images, truth = self.render(gaussians, scenes.targets.cameras).clamp(0, 1), scenes.targets.images
        return psnr(images.flatten(0, 1), truth.flatten(0, 1)).view(images.shape[:2])

    def validation_step(self, scenes: SceneBatch, index: int) -> None:
        values = self.novel_psnr(self.reconstruct(scenes, seed=index), scenes)
        self.log("val/psnr_novel", values.mean(), prog_bar=True, batch_size=len(values))

    def on_test_start(self) -> None:
        self.evaluation.reset()
        self.seconds = defaultdict(list)
        self.mean_image = self.data.mean_image()
        if self.mean_image is None:
            self.evaluation.missing["mean_image"] = "missing: these data have no training images"

    def test_step(self, scenes: SceneBatch, index: int) -> None:
        evaluation, names = self.evaluation, scenes.names
        seen = scenes if scenes.seen is None else scenes.seen
        seeds = [evaluation.scene_seed(name) for name in names]
        gaussians = self.timed("inference", lambda: self.draw(seen, seeds, evaluation.samples), len(names))
        truth, cameras = scenes.all_views(), seen.all_views().cameras
        for b, name in enumerate(names):
            samples = gaussians[b * evaluation.samples : (b + 1) * evaluation.samples]
            rendered = self.timed("rendering", partial(self.render_from, samples, cameras[b]), evaluation.samples)
            images = upsampled(rendered.over(self.background), truth.cameras.image_size)
            evaluation.update_samples(name, images, truth[b])
            depths = truth.depths
            if depths is not None and depths.shape[-2:] == rendered.alpha.shape[-2:]:
                evaluation.update_depth(name, rendered[0].expected_depth(), truth[b])
            self.scene_scored(name, samples, cameras[b], images, truth[b])
        if self.mean_image is not None:
            evaluation.update("mean_image", repeat_image(self.mean_image, scenes), scenes)
        evaluation.update("copy_reference", copy_reference(scenes), scenes)
        evaluation.update("mirrored_reference", mirror_reference(scenes), scenes)

    def timed(self, name: str, work: Callable[[], Result], scenes: int) -> Result:
        """Do the work for this number of scenes, and note its seconds for each."""
        start = now()
        result = work()
        self.seconds[name].append((now() - start) / scenes)
        return result

    def scene_scored(self, name: str, gaussians: Gaussians, cameras: Cameras, images: Renders, truth: Views) -> None:
        """Write the result of a test for a scene: Gaussians [sample], and their images, as they are scored.

        The cameras are those of the renders, which may be smaller than the scored images.
        """

    def on_test_epoch_end(self) -> None:
        """Log every score: the model's as `test/REGION/VIEW/METRIC`, a predictor's as `test/PREDICTOR/REGION/...`.

        Every process gathers the scores of all, so all log the same.
        """
        loader = cast(SceneLoader, self.trainer.test_dataloaders)
        self.evaluation.skipped = {str(error.sequence) for error in loader.refused}
        if loader.refused_depths:
            self.evaluation.missing["depth"] = f"missing: {loader.refused_depths[-1]}"
        self.evaluation.gather()
        local, self.seconds = dict(self.seconds), defaultdict(list)
        for name, values in (item for seconds in gathered(local) for item in seconds.items()):
            self.seconds[name] += values
        for predictor, scores in self.test_results().items():
            prefix = "test" if predictor == MODEL else f"test/{predictor}"
            for region, view in product(REGIONS, ("novel", "reference")):
                values = scores.get(region, {}).get(view, {})
                self.log_dict({f"{prefix}/{region}/{view}/{name}": x for name, x in values.items() if x is not None})

    def test_results(self) -> dict[str, dict[str, Any]]:
        """Return `Evaluation.results` of the last test, with the model's seconds for a scene."""
        # The first duration includes work that is done once.
        seconds = {name: statistics.median(values[1:] or values) for name, values in self.seconds.items()}
        results = self.evaluation.results()
        results["model"] |= {"upper_bound": self.upper_bound, "fitted_to": self.fitted_to, "seconds": seconds}
        return results

    def predict_step(self, scenes: SceneBatch, index: int) -> Gaussians:
        """Return one set of Gaussians for each reference image, in its camera's frame."""
        return self.reconstruct(scenes, seed=index)

    def on_train_batch_start(self, batch: Batch, index: int) -> None:
        """Note the number of scenes of this batch, whose gradient may be added to those of earlier ones."""
        self.accumulated = self.accumulated if index % self.trainer.accumulate_grad_batches else []
        self.accumulated.append(len(batch.names))

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Give all scenes of accumulated batches the same weight, also in the incomplete group at an epoch's end.

        Lightning divides each batch's loss, a mean over its scenes, by the number of batches in a complete group.
        """
        counts, batches = self.accumulated, self.trainer.accumulate_grad_batches
        super().backward(loss * (counts[-1] / counts[0]), *args, **kwargs)
        factor = batches * counts[0] / sum(counts)
        if factor != 1 and (len(counts) == batches or self.trainer.is_last_batch):
            torch._foreach_mul_([p.grad for p in self.parameters() if p.grad is not None], factor)

    def configure_gradient_clipping(
        self, optimizer: Optimizer, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        """Clip as Lightning does, but with the norm that `BadSteps` has computed, if it has.

        Fused optimizers in bfloat16, too, which Lightning refuses without loss scaling.
        """
        norm, self.gradient_norm = self.gradient_norm, None
        if norm is not None and gradient_clip_val and gradient_clip_algorithm in (None, "norm"):
            return torch.nn.utils.clip_grads_with_norm_(self.parameters(), gradient_clip_val, norm)
        precision = self.trainer.precision_plugin
        scaled = getattr(precision, "scaler", None) is not None
        clip = precision.clip_gradients if scaled else partial(Precision.clip_gradients, precision)
        clip(optimizer, gradient_clip_val or 0.0, GradClipAlgorithmType(gradient_clip_algorithm or "norm"))

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Build the optimizer, and a schedule that spans the run, whether its length is given in steps or epochs."""
        optimizer = self.optimizer([p for p in self.parameters() if p.requires_grad])
        for group in optimizer.param_groups:
            group["lr"] = group["lr"] if self.lr is None else self.lr
        schedule = self.schedule(optimizer, self.trainer.estimated_stepping_batches)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def upsampled(images: Float[Tensor, "batch view 3 _ _"], size: tuple[int, int]) -> Renders:
    """Resize images to the size (height, width) of true images (paper, Table 3: "by upsampling")."""
    if images.shape[-2:] == size:
        return images
    resized = torch.nn.functional.interpolate(images.flatten(0, 1), size, mode="bilinear", align_corners=False)
    return resized.view(*images.shape[:2], *resized.shape[1:])
