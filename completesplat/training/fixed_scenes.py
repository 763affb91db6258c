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
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger
from PIL import Image
from torch import Tensor

from completesplat.export.cleaning import storable, with_screen_space_dilation
from completesplat.export.description import plain_camera
from completesplat.export.images import Sheet, SheetCell, color_depth, image_sheet, strip, write_png
from completesplat.export.placed_scene import PlacedScene
from completesplat.export.ply import write_ply
from completesplat.export.subject import all_around, subject_of
from completesplat.export.video import render_views, write_video
from completesplat.files import make_folder, write_json
from completesplat.gaussians import Gaussians
from completesplat.geometry.trajectories import orbit
from completesplat.metrics.images import psnr
from completesplat.metrics.sample_scores import diversity
from completesplat.quantities import Positive
from completesplat.rasterizers import Rasterizer, Rendering
from completesplat.scene import SceneBatch
from completesplat.tensors import stack
from completesplat.training.callbacks import ExponentialMovingAverage
from completesplat.training.stage import Stage

ERROR_GAIN = 4
TURN_FRAMES = 48  # two seconds


@dataclass(frozen=True)
class DrawnScenes:
    """Image of a model's results for fixed scenes, figures to log, and a scene that Weights & Biases shows turning."""

    sheet: Image.Image
    figures: dict[str, float]
    turning: PlacedScene | None = None


class DrawsFixedScenes(Callback):
    """Base class of callbacks that draw the first scenes of the validation set, without an effect on training.

    The model is in evaluation mode, with averaged weights if training averages them.

    Args:
        folder, scenes: folder of the images, and the number of scenes in them.
        every_n_steps: optimizer steps between drawings. The last drawing is at the end of training.
        views: number of targets drawn for each scene, evenly spread over its targets; all if it has fewer.
    """

    def __init__(self, folder: str, every_n_steps: int, scenes: int, views: int) -> None:
        self.folder = Path(folder)
        self.every_n_steps = every_n_steps
        self.count = scenes
        self.views = views
        self.scenes: list[SceneBatch] = []
        self.last_step = 0

    @abstractmethod
    def draw(self, trainer: Trainer, module: Stage, scenes: list[SceneBatch]) -> DrawnScenes:
        """Draw the model's results for the scenes [view], which are on the CPU."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.scenes = []
        self.last_step = trainer.global_step
        if trainer.is_global_zero:
            make_folder(self.folder)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: object) -> None:
        if trainer.global_step % self.every_n_steps == 0:
            self._draw_once(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._draw_once(trainer, pl_module)

    def _draw_once(self, trainer: Trainer, module: LightningModule) -> None:
        if trainer.global_step == self.last_step:
            return
        assert isinstance(module, Stage)
        self.last_step = trainer.global_step
        if not trainer.is_global_zero:
            return
        with restored_afterwards(trainer, module):
            if not self.scenes:
                self.scenes = fixed_scenes(module.data.val_dataloader(), self.count, self.views)
            drawing = self.draw(trainer, module, self.scenes)
        write_png(self.folder / f"step_{self.last_step:06}.png", drawing.sheet)
        row = self.last_step - 1  # Lightning numbers a row by the optimizer steps before it
        for logger in trainer.loggers:
            logger.log_metrics(drawing.figures, step=row)
            if isinstance(logger, WandbLogger):
                logger.log_metrics(self._media(module, drawing), step=row)
            elif isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image(self.folder.name, np.asarray(drawing.sheet), row, dataformats="HWC")

    def _media(self, module: Stage, drawing: DrawnScenes) -> dict[str, Any]:
        """Return the image, and the video if a scene turns, as Weights & Biases takes them."""
        import wandb

        media: dict[str, Any] = {self.folder.name: wandb.Image(drawing.sheet)}
        if drawing.turning is not None:
            path = self.folder / "newest/turn.mp4"
            write_turn(path, drawing.turning, module.rasterizer, module.background)
            media["turn"] = wandb.Video(str(path), format="mp4")
        return media


@contextmanager
def restored_afterwards(trainer: Trainer, module: LightningModule) -> Iterator[None]:
    """Switch to evaluation mode and averaged weights, if any, and restore modes, weights and random generators."""
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
    return [_with_targets(scene, views) for scene in islice(scenes, count)]


def _with_targets(scene: SceneBatch, views: int) -> SceneBatch:
    """Return a scene with `views` of its targets, evenly spread, or with all if it has fewer."""
    count = len(scene.targets.images)
    views = min(views, count)
    return replace(scene, targets=scene.targets[[i * count // views for i in range(views)]])


class FixedScenes(DrawsFixedScenes):
    """Callback that draws the first target of each scene and logs figures of its Gaussians (`DrawsFixedScenes`).

    `folder/step_000500.png` has a row for each scene (`scene_panels`); `folder/newest/` holds the scenes
    themselves (`write_newest`). All loggers get `gaussian_figures`, `layer_figures` and the model's `latent_figures`.
    Weights & Biases and TensorBoard get the image, Weights & Biases also a video of the first scene (`write_turn`).
    """

    def __init__(self, folder: str, every_n_steps: Positive = 1000, scenes: Positive = 4) -> None:
        super().__init__(folder, every_n_steps, scenes, views=1)

    def draw(self, trainer: Trainer, module: Stage, scenes: list[SceneBatch]) -> DrawnScenes:
        batch = stack(scenes).to(module.device)
        with trainer.precision_plugin.forward_context():
            gaussians = module.reconstruct(batch, seed=0)
            latents = module.latent_figures(batch)
        with torch.autocast(module.device.type, enabled=False):
            panels = scene_panels(module.rasterizer, gaussians, batch, module.background)
        rows: Sheet = []
        for scene in range(len(batch.names)):
            rows.append([SheetCell(images[scene]) for images in panels.values()])
        sheet = image_sheet(list(panels), rows)
        write_newest(self.folder / "newest", trainer.global_step, gaussians, batch, module.up)
        figures = gaussian_figures(gaussians) | layer_figures(gaussians, batch) | latents
        first = gaussians[0].map(Tensor.float)
        selected = first[storable(first)]
        if not selected.count:
            return DrawnScenes(sheet, figures)
        turning = PlacedScene(selected, batch.reference.cameras[0], module.up.to(module.device))
        return DrawnScenes(sheet, figures, turning)


def write_turn(path: Path, scene: PlacedScene, rasterizer: Rasterizer, background: float) -> None:
    """Write a video of a scene that makes one turn around the object in its camera's image."""
    subject = subject_of(scene, rasterizer)
    cameras = orbit(all_around(scene.camera, subject), subject.center, scene.up, TURN_FRAMES)
    frames, _ = render_views(rasterizer, scene.gaussians, cameras, background)
    write_video(path, frames.clamp(0, 1))


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
    pixels = scenes.reference.images.shape[-2:].numel()
    if gaussians.count % pixels == 0:  # Gaussians that were fitted to a capture have no layers
        for layer in range(gaussians.count // pixels):
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

    def mean_on_object(values: Float[Tensor, "batch height width"]) -> float:
        return ((values * on_object).sum() / on_object.sum().clamp(min=1)).item()

    figures = {}
    for layer in range(layers.opacities.shape[1]):
        figures[f"layers/opacity_{layer + 1}"] = mean_on_object(layers.opacities[:, layer])
        if layer > 0:
            behind = layers.means[:, layer, ..., 2] - layers.means[:, 0, ..., 2]
            figures[f"layers/behind_{layer + 1}"] = mean_on_object(behind)
    return figures


def gaussian_figures(gaussians: Gaussians) -> dict[str, float]:
    """Return percentiles of the opacities, of log10 of the scales, and of the depths in the reference's frame.

    Keys are `gaussians/opacity_p10`, `gaussians/log10_scale_p50` and so on. Depths are in scene units.
    """
    tensors = {
        "opacity": gaussians.opacities,
        "log10_scale": gaussians.scales.log10(),
        "depth": gaussians.means[..., 2],
    }
    figures = {}
    for name, tensor in tensors.items():
        values = tensor.float().flatten().cpu().numpy()
        for percentile in (10, 50, 90):
            figures[f"gaussians/{name}_p{percentile}"] = float(np.percentile(values, percentile))
    return figures


class Samples(DrawsFixedScenes):
    """Callback that draws samples of each scene from its reference and target views (`DrawsFixedScenes`).

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

    def draw(self, trainer: Trainer, module: Stage, scenes: list[SceneBatch]) -> DrawnScenes:
        drawings = []
        for scene in scenes:
            batch = stack([scene]).to(module.device)
            views = batch.all_views()
            with trainer.precision_plugin.forward_context():
                gaussians = module.draw(batch, [0], self.samples)
            rendering = module.render_from(gaussians, views.cameras[0])
            images = rendering.over(module.background).clamp(0, 1)
            drawings.append(SceneDrawings(views.images[0], images, rendering.expected_depth()[:1]))
        scores = [drawing.scores() for drawing in drawings]
        means = {}
        for name in scores[0]:
            means[f"samples/{name}"] = sum(values[name] for values in scores) / len(scores)
        return DrawnScenes(samples_sheet(drawings), means)


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
        if len(images) > 1:
            scores["diversity"] = diversity(images)
        return scores


def samples_sheet(drawings: list[SceneDrawings]) -> Image.Image:
    """Draw a sheet with a column for each view, which stays white where a scene lacks it."""
    rows: Sheet = []
    for drawing in drawings:
        rows.append(_row("true", drawing.true))
        for number, images in enumerate(drawing.samples, start=1):
            rows.append(_row(f"sample {number}", images))
        depth, _ = color_depth(drawing.depth[0])
        rows.append(_row("depth of 1", depth))
    targets = max(map(len, rows)) - 1
    headings = ["input's view"] + [f"target {i + 1}" for i in range(targets)]
    return image_sheet(headings, rows)


def _row(label: str, images: Float[Tensor, "view 3 height width"]) -> list[SheetCell | None]:
    """Return a sheet's row of images, in which values that are not finite are black."""
    return strip(images.nan_to_num(), label)
