"""Callbacks that draw a few fixed scenes while a model trains, and log figures of its Gaussians and samples."""

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import WandbLogger
from PIL import Image
from torch import Tensor

from completesplat.export.cleaning import storable, with_screen_space_dilation
from completesplat.export.description import plain_camera
from completesplat.export.images import Sheet, SheetCell, color_depth, image_sheet, write_png
from completesplat.export.ply import write_ply
from completesplat.files import make_folder, write_json
from completesplat.gaussians import Gaussians
from completesplat.metrics.images import psnr
from completesplat.metrics.scoring import diversity
from completesplat.rasterizers import Rasterizer, Rendering
from completesplat.scene import SceneBatch
from completesplat.settings.schema import Positive
from completesplat.tensors import stack
from completesplat.training.callbacks import ExponentialMovingAverage
from completesplat.training.stage import Stage

ERROR_GAIN = 4


class DrawsFixedScenes(Callback):
    """Base class of callbacks that draw the first scenes of the validation set, without an effect on training.

    The model is in evaluation mode, with averaged weights if training averages them.

    Args:
        folder, scenes: folder of the images, and the number of scenes in them.
        every_n_steps: optimizer steps between drawings; the last drawing is at the end of training.
        views: number of targets drawn for each scene, evenly spread over its targets; all if it has fewer.
    """

    def __init__(self, folder: str, every_n_steps: int, scenes: int, views: int) -> None:
        self.folder = Path(folder)
        self.every_n_steps = every_n_steps
        self.count = scenes
        self.views = views

    @abstractmethod
    def draw(self, trainer: Trainer, module: Stage, scenes: list[SceneBatch]) -> tuple[Image.Image, dict[str, float]]:
        """Return an image of the model's results for the scenes [view], which are on the CPU, and figures to log."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.scenes: list[SceneBatch] = []
        self.drawn = trainer.global_step
        if trainer.is_global_zero:
            make_folder(self.folder)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: object) -> None:
        if trainer.global_step % self.every_n_steps == 0:
            self._draw_once(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._draw_once(trainer, pl_module)

    def _draw_once(self, trainer: Trainer, module: LightningModule) -> None:
        if trainer.global_step == self.drawn:
            return
        assert isinstance(module, Stage)
        self.drawn = trainer.global_step
        if not trainer.is_global_zero:
            return
        with restored_afterwards(trainer, module):
            if not self.scenes:
                self.scenes = fixed_scenes(module.data.val_dataloader(), self.count, self.views)
            sheet, figures = self.draw(trainer, module, self.scenes)
        write_png(self.folder / f"step_{self.drawn:06}.png", sheet)
        for logger in trainer.loggers:
            # Lightning numbers a row by the optimizer steps before it.
            logger.log_metrics(figures, step=self.drawn - 1)
            if isinstance(logger, WandbLogger):
                import wandb

                media: dict[str, Any] = {self.folder.name: wandb.Image(sheet)}
                logger.log_metrics(media, step=self.drawn - 1)


@contextmanager
def restored_afterwards(trainer: Trainer, module: LightningModule) -> Iterator[None]:
    """Switch to evaluation mode and averaged weights, if any; then restore them and the random generators."""
    modes = {part: part.training for part in module.modules()}
    devices = [module.device] if module.device.type == "cuda" else []
    with torch.no_grad(), torch.random.fork_rng(devices), ExitStack() as contexts:
        for callback in trainer.callbacks:  # type: ignore[attr-defined]
            if isinstance(callback, ExponentialMovingAverage):
                contexts.enter_context(callback.in_place(module))
        module.eval()
        try:
            yield
        finally:
            for part, mode in modes.items():
                part.training = mode


def fixed_scenes(batches: Iterable[SceneBatch], count: int, views: int = 1) -> list[SceneBatch]:
    """Return the first `count` scenes of the batches, each with `views` of its targets."""
    scenes = (batch[index] for batch in batches for index in range(len(batch.names)))
    return [replace(scene, targets=scene.targets[_spread(scene, views)]) for scene in islice(scenes, count)]


def _spread(scene: SceneBatch, views: int) -> list[int]:
    targets = len(scene.targets.images)
    return [i * targets // views for i in range(views)] if targets > views else list(range(targets))


class FixedScenes(DrawsFixedScenes):
    """Callback that draws the first target of each scene and logs figures of its Gaussians; see `DrawsFixedScenes`.

    `folder/step_000500.png` has a row for each scene (`scene_panels`); `folder/newest/` holds the scenes
    themselves (`write_newest`). All loggers get `gaussian_figures`, `layer_figures` and the model's `latent_figures`;
    Weights & Biases also gets the image.
    """

    def __init__(self, folder: str, every_n_steps: Positive = 1000, scenes: Positive = 4) -> None:
        super().__init__(folder, every_n_steps, scenes, views=1)

    def draw(self, trainer: Trainer, module: Stage, scenes: list[SceneBatch]) -> tuple[Image.Image, dict[str, float]]:
        batch = stack(scenes).to(module.device)
        with trainer.precision_plugin.forward_context():
            gaussians = module.reconstruct(batch, seed=0)
            latents = module.latent_figures(batch)
        with torch.autocast(module.device.type, enabled=False):
            panels = scene_panels(module.rasterizer, gaussians, batch, module.background)
        sheet = image_sheet(list(panels), [list(map(SheetCell, row)) for row in zip(*panels.values(), strict=True)])
        write_newest(self.folder / "newest", trainer.global_step, gaussians, batch, module.up)
        return sheet, gaussian_figures(gaussians) | layer_figures(gaussians, batch) | latents


def write_newest(folder: Path, step: int, gaussians: Gaussians, scenes: SceneBatch, up: Float[Tensor, "3"]) -> None:
    """Write scenes [batch] as `scene_0.ply`, ..., and `scenes.json`, and replace those of an earlier step.

    The JSON holds `step`, `up`, and each file's name, `scene` and `reference_camera`. Gaussians are dilated as in
    predictions. A scene without storable Gaussians is left out.
    """
    make_folder(folder)
    entries = []
    for index, name in enumerate(scenes.names):
        scene = gaussians[index].to("cpu", torch.float32)
        camera = scenes.reference.cameras[index].to("cpu")
        selected = scene[storable(scene)]
        if selected.count:
            file = f"scene_{index}.ply"
            write_ply(folder / file, with_screen_space_dilation(selected, camera), [f"scene {name}", f"step {step}"])
            entries.append({"file": file, "scene": name, "reference_camera": plain_camera(camera)})
    write_json(folder / "scenes.json", {"step": step, "up": up.tolist(), "scenes": entries})


def scene_panels(
    rasterizer: Rasterizer, gaussians: Gaussians, scenes: SceneBatch, background: float
) -> dict[str, Float[Tensor, "batch 3 height width"]]:
    """Return input, first target, and renders of all Gaussians [batch] and of each layer from the target's camera.

    The error is the mean absolute difference of the colours, times 4. Each scene has a separate colour scale of depth.
    """
    target = scenes.targets[:, :1]

    def render(part: Gaussians) -> Rendering:
        return rasterizer(part, target.cameras)[:, 0]

    whole = render(gaussians)
    image = whole.over(background).clamp(0, 1)
    error = (image - target.images[:, 0]).abs().mean(1, keepdim=True)
    panels = {
        "input": scenes.reference.images,
        "target": target.images[:, 0],
        "render": image,
        f"error x{ERROR_GAIN}": (ERROR_GAIN * error).expand(-1, 3, -1, -1),
        "depth": torch.stack([color_depth(depth)[0] for depth in whole.expected_depth()]),
        "opacity": whole.alpha.expand(-1, 3, -1, -1),
    }
    pixels = scenes.reference.images.shape[-2] * scenes.reference.images.shape[-1]
    for layer in range(0 if gaussians.count % pixels else gaussians.count // pixels):  # captures have none
        part = gaussians[:, layer * pixels : (layer + 1) * pixels]
        panels[f"layer {layer + 1}"] = render(part).over(background)
    return {name: panel.clamp(0, 1).nan_to_num() for name, panel in panels.items()}


def layer_figures(gaussians: Gaussians, scenes: SceneBatch) -> dict[str, float]:
    """Return each layer's mean opacity on the object, and mean distance behind the first layer.

    Keys are `layers/opacity_1`, ... and `layers/behind_2`, ... (in scene units along the reference's optical axis). A
    layer whose opacity goes to zero is dead: it adds no hidden surfaces.
    """
    size = scenes.reference.images.shape[-2:]
    on_object = scenes.reference.masks[:, 0]
    if gaussians.count % size.numel():
        return {}  # no layers, but Gaussians that were fitted to a capture
    layers = gaussians.map(lambda tensor: tensor.view(len(tensor), -1, *size, *tensor.shape[2:]))  # by pixels
    figures = {}
    for layer in range(layers.opacities.shape[1]):
        behind = layers.means[:, layer, ..., 2] - layers.means[:, 0, ..., 2]
        values = {"opacity": layers.opacities[:, layer]} | ({"behind": behind} if layer else {})
        for name, value in values.items():
            figures[f"layers/{name}_{layer + 1}"] = ((value * on_object).sum() / on_object.sum().clamp(min=1)).item()
    return figures


def gaussian_figures(gaussians: Gaussians) -> dict[str, float]:
    """Return percentiles of the opacities, of log10 of the scales, and of the depths in the reference's frame.

    Keys are `gaussians/opacity_p10`, `gaussians/log10_scale_p50` and so on; depths are in scene units.
    """
    parts = {"opacity": gaussians.opacities, "log10_scale": gaussians.scales.log10(), "depth": gaussians.means[..., 2]}
    values = {name: tensor.float().flatten().cpu().numpy() for name, tensor in parts.items()}
    return {f"gaussians/{name}_p{p}": float(np.percentile(x, p)) for name, x in values.items() for p in (10, 50, 90)}


class Samples(DrawsFixedScenes):
    """Callback that draws samples of each scene from its reference and target views; see `DrawsFixedScenes`.

    `folder/step_000500.png` has rows for each scene: true images (the input first), each sample, and the depth of the
    first sample. All loggers get metrics of the target views: `samples/diversity` (of two samples or more),
    `samples/psnr` (mean over the samples) and `samples/psnr_of_mean` (of their mean image).

    Args:
        samples: number of samples of each scene, always from the same noise.
    """

    def __init__(
        self,
        folder: str,
        every_n_steps: Positive = 2000,
        scenes: Positive = 2,
        samples: Positive = 4,
        views: Positive = 8,
    ) -> None:
        super().__init__(folder, every_n_steps, scenes, views)
        self.samples = samples

    def draw(self, trainer: Trainer, module: Stage, scenes: list[SceneBatch]) -> tuple[Image.Image, dict[str, float]]:
        drawings = []
        for scene in (stack([scene]).to(module.device) for scene in scenes):
            views = scene.all_views()
            with trainer.precision_plugin.forward_context():
                gaussians = module.draw(scene, [0], self.samples)
            rendering = module.render_from(gaussians, views.cameras[0])
            images = rendering.over(module.background).clamp(0, 1)
            drawings.append(SceneDrawings(views.images[0], images, rendering.expected_depth()[:1]))
        scores = [drawing.scores() for drawing in drawings]
        means = {f"samples/{name}": sum(values[name] for values in scores) / len(scores) for name in scores[0]}
        return samples_sheet(drawings), means


@dataclass(frozen=True)
class SceneDrawings:
    """True images and renders of one scene, the reference view first."""

    true: Float[Tensor, "view 3 height width"]
    samples: Float[Tensor, "sample view 3 height width"]
    depth: Float[Tensor, "1 view 1 height width"]

    def scores(self) -> dict[str, float]:
        images = self.samples[:, 1:]
        true = self.true[1:]
        scores = {
            "psnr": psnr(images.flatten(0, 1), true.expand_as(images).flatten(0, 1)).mean().item(),
            "psnr_of_mean": psnr(images.mean(0), true).mean().item(),
        }
        return scores | {"diversity": diversity(images)} if len(images) > 1 else scores


def samples_sheet(drawings: list[SceneDrawings]) -> Image.Image:
    """Draw a sheet with a column for each view; views that a scene lacks stay white."""
    rows: Sheet = []
    for scene in drawings:
        labelled = {"true": scene.true, **{f"sample {n}": images for n, images in enumerate(scene.samples, 1)}}
        for name, images in (labelled | {"depth of 1": color_depth(scene.depth[0])[0]}).items():
            first, *others = images.nan_to_num()  # values that are not finite are black
            rows.append([SheetCell(first, name), *map(SheetCell, others)])
    return image_sheet(["input's view", *(f"target {i + 1}" for i in range(max(map(len, rows)) - 1))], rows)
