"""What both training stages share: rendering a batch of scenes, scoring the renders, timing it."""

import statistics
import time
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import torch
from hydra.utils import instantiate
from jaxtyping import Float
from lightning import LightningModule
from lightning.pytorch.plugins import Precision
from lightning.pytorch.utilities.enums import GradClipAlgorithmType
from omegaconf import OmegaConf
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from completesplat.data.loading.distributed import gathered, mean_of_processes
from completesplat.errors import WeightsError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.metrics.images import psnr
from completesplat.metrics.scoring import MODEL, REGIONS, Evaluation
from completesplat.opening import check_names, without_training
from completesplat.rasterizers import Rasterizer, Rendering
from completesplat.scene import SceneBatch, Views
from completesplat.settings.schema import Share
from completesplat.weights.checkpoint_reading import load_part, read_checkpoint

Result = TypeVar("Result")
Renders = Float[Tensor, "batch view 3 height width"]

IN_THE_BAR = ("train/loss", "train/psnr")  # of training; with the figures of validation


def copy_reference(scenes: SceneBatch) -> Renders:
    """The reference image for every view. A model that does not beat this and `repeat_image` has learned nothing."""
    return scenes.reference.images[:, None].expand_as(scenes.all_views().images)


def repeat_image(image: Float[Tensor, "3 height width"], scenes: SceneBatch) -> Renders:
    """One image for every view: with the training set's mean image, the best constant prediction of the MSE."""
    return image.to(scenes.reference.images).expand_as(scenes.all_views().images)


class Timings:
    """Seconds for each scene, by the name of the work."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def of(self, name: str, work: Callable[[], Result], scenes: int = 1) -> Result:
        """Do the work, for this number of scenes at once."""
        start = now()
        result = work()
        self.seconds[name].append((now() - start) / scenes)
        return result

    def gather(self) -> None:
        """Know the durations of all processes; each of them must call it."""
        own, self.seconds = self.seconds, defaultdict(list)
        for other in gathered(dict(own)):
            for name, values in other.items():
                self.seconds[name] += values

    def results(self) -> dict[str, float]:
        """Medians; the first duration is left out where there are others: it includes what happens only once."""
        return {name: statistics.median(values[1:] or values) for name, values in self.seconds.items()}


def now() -> float:
    """Seconds, when the GPU, if there is one, has finished its work."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def prepare_network(network: nn.Module, channels_last: bool, compile: bool) -> None:
    """Order the weights of convolutions in NHWC (images should be too), compile on the first call; keys stay."""
    if channels_last:
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if compile:
        network.compile()


@dataclass(frozen=True)
class ScoredScene:
    """What a test makes of one scene: Gaussians, and their images as they are scored, the reference view first.

    The input is as the model sees it, the cameras those of the renders, whose pictures may be smaller.
    """

    name: str
    input: Float[Tensor, "3 _ _"]
    gaussians: Gaussians
    cameras: Cameras
    images: Float[Tensor, "sample view 3 height width"]
    truth: Views


class Stage(LightningModule):
    """A model that turns reference images into Gaussians.

    Args:
        schedule: optimizer and steps of the run -> learning-rate schedule, stepped every optimizer step.
        background: grey value (0 to 1) seen where the Gaussians leave a pixel open.
    """

    upper_bound = False
    """Whether the model has seen the views that it is scored on."""

    draws_samples = False
    """Whether it has several answers for one image."""

    networks: tuple[str, ...] = ()
    """Names of the trained networks, which are called as a whole: `trainer=fsdp` divides each over the processes."""

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
        self.timings = Timings()
        self.on_scene_scored: Callable[[ScoredScene], None] | None = None
        self.config: Mapping[str, Any] | None = None
        # Lightning's name: of several processes that test, some may have no scene.
        self.allow_zero_length_dataloader_with_multiple_devices = True

    @abstractmethod
    def reconstruct(self, scenes: SceneBatch, seed: int) -> Gaussians:
        """One set of Gaussians [batch] for each reference image, in its camera's frame."""

    def draw(self, scenes: SceneBatch, seeds: Sequence[int], samples: int) -> Gaussians:
        """`samples` sets of Gaussians for each reference image and its seed, next to each other: [batch * samples]."""
        return self.reconstruct(scenes, seeds[0])

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]
        cls, checkpoint_path: str | Path, map_location: Any = None, trust: bool = False
    ) -> Any:
        """Build the model of a checkpoint from the config in it (`hyper_parameters`), with its weights.

        Args:
            trust: the checkpoint names modules of your own, and you trust who made it; not needed below the working
                folder.

        Raises:
            WeightsError: the checkpoint is missing, damaged, without a config, names what `check_names` refuses, or is
                of another class.
        """
        path = Path(checkpoint_path)
        config = read_checkpoint(path).get("hyper_parameters")
        if not isinstance(config, dict) or not isinstance(config.get("model"), dict):
            raise WeightsError(
                f"{path}: holds no config; train with `fit`, or with what completesplat.instantiate gives"
            )
        check_names(config, path, path.resolve().parent.parent, trust)
        module = instantiate(without_training(OmegaConf.create(config)).model, _convert_="all")
        if not isinstance(module, cls):
            raise WeightsError(f"{path}: holds a {type(module).__name__}, which is no {cls.__name__}")
        load_part(module, path, prefix="")
        module.config = config
        return module if map_location is None else module.to(map_location)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the config, which `load_from_checkpoint` reads."""
        if self.config is not None:
            checkpoint["hyper_parameters"] = dict(self.config)

    @property
    def method(self) -> str:
        """What it is called in tables."""
        return type(self).__name__

    def render_from(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Several sets of Gaussians [sample], each from the same cameras [view]: [sample view]."""
        count = len(gaussians.means)
        everywhere = cameras.map(lambda tensor: tensor.expand(count, *tensor.shape))
        with torch.autocast(self.device.type, enabled=False):
            return self.rasterizer(gaussians, everywhere)

    def render(self, gaussians: Gaussians, scenes: SceneBatch) -> Renders:
        """The reference view and all targets, in full precision even where the network runs in less."""
        with torch.autocast(self.device.type, enabled=False):
            return self.rasterizer(gaussians, scenes.all_views().cameras).over(self.background)

    def log_step(self, values: dict[str, Tensor], batch_size: int) -> None:
        """Log figures of a training step: their means over all processes, as the step takes that of gradients.

        One message has them all; Lightning's `sync_dist` would make processes wait for each other for each of them.
        """
        for name, value in mean_of_processes(values).items():
            self.log(name, value, prog_bar=name in IN_THE_BAR, batch_size=batch_size)

    def novel_psnr(self, gaussians: Gaussians, scenes: SceneBatch) -> Float[Tensor, "batch target"]:
        """Of the targets' views, in dB."""
        images, truth = self.render(gaussians, scenes).clamp(0, 1)[:, 1:], scenes.targets.images
        return psnr(images.flatten(0, 1), truth.flatten(0, 1)).view(images.shape[:2])

    def validation_step(self, scenes: SceneBatch, index: int) -> None:
        values = self.novel_psnr(self.reconstruct(scenes, seed=index), scenes)
        self.log("val/psnr_novel", values.mean(), prog_bar=True, batch_size=len(values))

    def on_test_start(self) -> None:
        self.evaluation.reset()
        self.timings = Timings()
        self.mean_image = self.trainer.datamodule.mean_image()  # type: ignore[attr-defined]

    def test_step(self, scenes: SceneBatch, index: int) -> None:
        evaluation, names = self.evaluation, scenes.names
        seen = scenes if scenes.seen is None else scenes.seen
        seeds = [evaluation.scene_seed(name) for name in names]
        gaussians = self.timings.of("inference", lambda: self.draw(seen, seeds, evaluation.samples), len(names))
        truth, cameras = scenes.all_views(), seen.all_views().cameras
        for b, name in enumerate(names):
            own = gaussians[b * evaluation.samples : (b + 1) * evaluation.samples]
            rendered = self.timings.of("rendering", partial(self.render_from, own, cameras[b]), evaluation.samples)
            images = upsampled(rendered.over(self.background), truth.cameras.image_size)
            evaluation.update_samples(name, images, truth[b])
            depths = truth.depths
            if depths is not None and depths.shape[-2:] == rendered.alpha.shape[-2:]:
                evaluation.update_depth(name, rendered[0].expected_depth(), truth[b])
            shown = seen.reference.images[b] * seen.visible[b]
            self.scene_scored(ScoredScene(name, shown, own, cameras[b], images, truth[b]))
        evaluation.update("mean_image", repeat_image(self.mean_image, scenes), scenes)
        evaluation.update("copy_reference", copy_reference(scenes), scenes)

    def scene_scored(self, scene: ScoredScene) -> None:
        """Pass on what a test made of a scene."""
        if self.on_scene_scored is not None:
            self.on_scene_scored(scene)

    def on_test_epoch_end(self) -> None:
        """Log every score: the model's as `test/REGION/VIEW/METRIC`, a predictor's as `test/PREDICTOR/REGION/...`.

        All processes know the scores of all, and log the same.
        """
        loader: Any = self.trainer.test_dataloaders
        self.evaluation.skipped = {str(error.sequence) for error in loader.refused}
        if loader.refused_depths:
            self.evaluation.missing["depth"] = f"missing: {loader.refused_depths[-1]}"
        self.evaluation.gather()
        self.timings.gather()
        for predictor, scores in self.test_results().items():
            place = "test" if predictor == MODEL else f"test/{predictor}"
            for region, view in product(REGIONS, ("novel", "reference")):
                values = scores.get(region, {}).get(view, {})
                self.log_dict({f"{place}/{region}/{view}/{name}": x for name, x in values.items() if x is not None})

    def test_results(self) -> dict[str, Any]:
        """Return `Evaluation.results` of the last test, with the model's seconds for a scene."""
        results = self.evaluation.results()
        results["model"] |= {"upper_bound": self.upper_bound, "seconds": self.timings.results()}
        return results

    def predict_step(self, scenes: SceneBatch, index: int) -> Gaussians:
        """Return one set of Gaussians for each reference image, in its camera's frame."""
        return self.reconstruct(scenes, seed=index)

    def configure_gradient_clipping(
        self, optimizer: Optimizer, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        """As Lightning, but for fused optimizers in bfloat16, too: it refuses them for what only loss scaling needs."""
        precision: Any = self.trainer.precision_plugin
        scaled = getattr(precision, "scaler", None) is not None
        clip = precision.clip_gradients if scaled else partial(Precision.clip_gradients, precision)
        clip(optimizer, gradient_clip_val or 0.0, GradClipAlgorithmType(gradient_clip_algorithm or "norm"))

    def configure_optimizers(self) -> Any:
        """The schedule spans the run, whether its length is given in steps or epochs."""
        optimizer = self.optimizer([p for p in self.parameters() if p.requires_grad])
        schedule = self.schedule(optimizer, self.trainer.estimated_stepping_batches)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def upsampled(
    images: Float[Tensor, "sample view 3 _ _"], size: tuple[int, int]
) -> Float[Tensor, "sample view 3 height width"]:
    """Images at the size (height, width) of those that they are compared with (paper, Table 3: "by upsampling")."""
    if images.shape[-2:] == size:
        return images
    resized = torch.nn.functional.interpolate(images.flatten(0, 1), size, mode="bilinear", align_corners=False)
    return resized.view(*images.shape[:2], *resized.shape[1:])
