"""Gaussians fitted to the training frames of one capture, and scored on the frames that are held out."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from jaxtyping import Float
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.nn.functional import normalize
from torch.optim import Adam

from completesplat.baselines import fitting
from completesplat.data.packed.manifest import is_packed
from completesplat.data.sequences import PosedSequence, first_names
from completesplat.errors import CompleteSplatError
from completesplat.export.prediction import FileUnits, OutputFiles, Shot, write_fitted_scene, write_scene
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.losses import Prediction, WeightedSum
from completesplat.scene import Batch, SceneBatch, Views
from completesplat.settings.schema import CameraPath, Format, Positive, Range, Share
from completesplat.tensors import stack
from completesplat.training.optimization import Schedule, constant
from completesplat.training.scoring import Renders
from completesplat.training.stage import Stage

REFINED_SHARE = 0.8  # of the run, in which Gaussians move and are added (25,000 of 30,000 steps in 3DGS-MCMC)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of the Gaussians of a capture.

    Attributes:
        initial, most: numbers of Gaussians at the start (at most as many as there are points) and at most.
        opacity: initial opacity of all Gaussians.
        refine_every: steps between relocations of dead Gaussians, which add the share `growth` of new ones.
        opacity_weight, scale_weight: weights of mean opacity and mean scale in the loss.
        position_rate, other_rates: factors on 3DGS's learning rates, which are meant for 30,000 steps.
        opacity_rate: factor on the opacities' learning rate; with 4, captures of flat floors and walls collapse.
    """

    initial: fitting.Count = 20_000
    most: fitting.Count = 50_000
    opacity: fitting.Translucent = 0.1
    refine_every: Positive = 50
    growth: Share = 0.05
    opacity_weight: Annotated[float, Range(0)] = 0.01
    scale_weight: Annotated[float, Range(0)] = 0.01
    position_rate: Annotated[float, Range(1e-3)] = 10.0
    opacity_rate: Annotated[float, Range(0)] = 1.0
    other_rates: Annotated[float, Range(0)] = 4.0


class CaptureFit(Stage):
    """Gaussians of one capture, fitted to its training frames (Kerbl et al. 2023; Kheradmand et al. 2024).

    All parameters have rows for `most` Gaussians, of which the first `count` are used, so that checkpoints and the
    optimizer's state keep their shapes while the number of Gaussians grows. They are in the data module's world.

    Args:
        scene_folder: folder of the result in the capture's own world and units, by `write_fitted_scene` and
            `write_scene`; None: nothing is written.
        formats, videos, frames: as in `OutputFiles`, without `ply`. A format whose writing fails is left out.
    """

    first_novel = 0  # all held-out photos count as one
    without_effect = ("optimizer", "schedule")

    def __init__(
        self,
        loss: WeightedSum,
        fitting: CaptureSettings,
        scene_folder: str | None = None,
        formats: Sequence[Format] = (),
        videos: Sequence[CameraPath] = ("orbit",),
        frames: Positive = 96,
        **rendering: Any,
    ) -> None:
        super().__init__(optimizer=Adam, schedule=constant, **rendering)
        self.loss = loss
        self.fitting = fitting
        self.scene_folder = None if scene_folder is None else Path(scene_folder)
        self.wanted = OutputFiles(formats, videos, frames, self.background)
        shapes = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "logits": (), "harmonics": (3,)}
        self.raw = nn.ParameterDict({name: torch.zeros(fitting.most, *shape) for name, shape in shapes.items()})
        self.count: Tensor
        self.register_buffer("count", torch.tensor(0))

    def gaussians(self) -> Gaussians:
        used = {name: tensor[None, : int(self.count)] for name, tensor in self.raw.items()}
        return fitting.RawGaussians(**used).gaussians()[0]

    def sequence(self, split: str) -> PosedSequence:
        """Return the frames of a split of the capture; raise CompleteSplatError unless there is exactly one capture."""
        names = self.data.store(split).names
        if len(names) != 1 or not self.data.splits_share_sequences or is_packed(self.data.root):
            state = "is prepared" if is_packed(self.data.root) else f"has {len(names)} sequences ({first_names(names)})"
            advice = "model=capture fits one capture: give data=capture and its folder, as it was taken"
            raise CompleteSplatError(f"data.root={self.data.root} {state}; {advice}")
        return self.data.store(split).source.read(names[0])

    def reference_poses(self, scenes: SceneBatch, split: str) -> Float[Tensor, "batch 4 4"]:
        """Return `world_to_camera` of the scenes' references in the capture's world."""
        poses = self.sequence(split).cameras.world_to_camera
        return poses[scenes.reference_frame.cpu()].to(scenes.depth_range)

    def in_world(self, scenes: SceneBatch, split: str) -> Views:
        """Return all views of the scenes [1 view], with cameras in the capture's world."""
        views = scenes.all_views()
        poses = views.cameras.world_to_camera @ self.reference_poses(scenes, split)[:, None]
        placed = replace(views, cameras=replace(views.cameras, world_to_camera=poses))
        return placed.map(lambda tensor: tensor.flatten(0, 1)[None])

    @torch.no_grad()
    def on_fit_start(self) -> None:
        """Place the first Gaussians, unless a run is continued."""
        self.refuse_average()
        if changed := [key for key, value in self.data.augment.keywords.items() if value]:
            raise CompleteSplatError(f"data.{changed[0]}: model=capture fits the photos as they are; turn it off")
        sequence = self.sequence("train")
        if self.count:
            return
        generator, settings = torch.Generator().manual_seed(0), self.fitting
        scene = stack([self.data.store("train").scene(sequence, 0, range(1, len(sequence.frames)))]).to(self.device)
        views, most = self.in_world(scene, "train"), min(settings.initial, settings.most)
        if sequence.points is None or len(sequence.points) <= fitting.NEIGHBOURS:
            points = fitting.initial_gaussians(views, scene.depth_range, most, settings.opacity, generator).means[0]
        else:
            points = sequence.points[torch.randperm(len(sequence.points), generator=generator)[:most]].to(self.device)
        for name, tensor in vars(fitting.gaussians_at_points(points, views[0], settings.opacity)).items():
            self.raw[name][: len(points)] = tensor[0]
        self.count.fill_(len(points))

    @torch.no_grad()
    def on_train_batch_start(self, batch: Batch, index: int) -> None:
        """Move dead Gaussians, add new ones, and disturb transparent ones, before all steps but the first."""
        super().on_train_batch_start(batch, index)
        step, total, settings = self.global_step, self.trainer.estimated_stepping_batches, self.fitting
        if step == 0 or index % self.trainer.accumulate_grad_batches:
            return
        (optimizer,) = self.trainer.optimizers
        count, rate = int(self.count), optimizer.param_groups[0]["lr"] / settings.position_rate
        self.raw["means"][:count] += fitting.position_noise(self.gaussians(), rate)
        if step % settings.refine_every == 0 and step < REFINED_SHARE * total:
            grown = max(count, min(settings.most, int(count * (1 + settings.growth))))
            changed = fitting.relocate(dict(self.raw.items()), count, grown)
            for state in optimizer.state.values():
                for key in ("exp_avg", "exp_avg_sq"):
                    state[key][changed] = 0
            self.count.fill_(grown if len(changed) else count)

    def training_step(self, scenes: SceneBatch, index: int) -> Float[Tensor, ""]:
        gaussians, views, settings = self.gaussians(), self.in_world(scenes, "train"), self.fitting
        with torch.autocast(self.device.type, enabled=False):
            rendering = self.rasterizer(gaussians[None], views.cameras)
        images = rendering.over(self.background)
        prediction = Prediction(images, rendering.alpha, gaussians[None], None)
        total, terms = self.loss(prediction, views, self.global_step)
        total = total + settings.opacity_weight * gaussians.opacities.mean()
        total = total + settings.scale_weight * gaussians.scales.mean()
        logged = {f"train/{name}": value for name, value in terms.items()}
        logged |= {"train/loss": total.detach(), "train/gaussians": self.count.float()}
        self.log_step(logged, batch_size=len(scenes.names))
        return total

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Build Adam with 3DGS's rates and epsilon; the rate of the positions decays to a hundredth."""
        depth_ranges, settings = self.sequence("train").depth_ranges, self.fitting
        rates = settings.position_rate, settings.opacity_rate, settings.other_rates
        optimizer = fitting.adam(dict(self.raw.items()), depth_ranges, *rates)
        steps = max(1, self.trainer.estimated_stepping_batches)
        decays = [lambda step: fitting.POSITION_DECAY ** (step / steps), *[lambda step: 1.0] * (len(self.raw) - 1)]
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": Schedule(optimizer, decays), "interval": "step"}}

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Return the fitted Gaussians in the frame of each scene's reference, a held-out frame."""
        return stack([self.gaussians().transform(pose) for pose in self.reference_poses(scenes, "test")]).detach()

    def on_test_start(self) -> None:
        """Note for tables what the Gaussians were fitted to."""
        fitted, held_out = (self.sequence(split).photos for split in ("train", "test"))
        photos, rule = len(fitted) + len(held_out), self.data.describe()["split"]
        self.fitted_to = f"{len(fitted)} of {photos} photos; {rule}: {', '.join(held_out)}"
        super().on_test_start()

    def test_results(self) -> dict[str, dict[str, Any]]:
        """Return the scores, with the names of the photos; warn if the photos' mean scores as well."""
        results, parts = super().test_results(), {"fitted": "train", "held_out": "test"}
        results["model"]["photos"] = {part: list(self.sequence(split).photos) for part, split in parts.items()}
        fitted, mean = (results[name]["full"]["novel"].get("psnr", math.nan) for name in ("model", "mean_image"))
        if fitted <= mean:
            scores = f"{fitted:.2f} dB, the mean image {mean:.2f} dB"
            logger.warning("%s: are these the cameras of these photos, and are the steps enough?", scores)
        return results

    def scene_scored(self, name: str, gaussians: Gaussians, cameras: Cameras, images: Renders, truth: Views) -> None:
        """Write the scene, the held-out frames beside their renders, videos and other formats."""
        if self.scene_folder is None:
            return
        sequence, scene, wanted = self.sequence("test"), self.gaussians().detach(), self.wanted
        poses = cameras.world_to_camera @ sequence.cameras.world_to_camera[0].to(cameras.world_to_camera)
        placed, up = replace(cameras, world_to_camera=poses), normalize(-poses[:, 1, :3].mean(0), dim=-1)
        self.scene_folder.mkdir(parents=True, exist_ok=True)
        reference, targets = self.data.evaluation_views(sequence, "test")
        photos = tuple(sequence.photos[index] for index in (reference, *targets))
        shot = Shot(scene, placed[0], up, FileUnits(sequence.scale, sequence.origin), photos)
        files, comments, on_file = dict[str, str](), [f"scene {name}"], partial(logger.info, "writing %s")
        for part in (replace(wanted, formats=()), *(replace(wanted, formats=[x], videos=()) for x in wanted.formats)):
            try:
                files |= write_scene(self.scene_folder, "scene", "", shot, self.rasterizer, part, comments, on_file)[-1]
            except CompleteSplatError as error:
                logger.warning("left out: %s", error)
        title = f"{name}: held-out photos, Gaussians fitted to the {len(self.sequence('train').frames)} others"
        seed = self.evaluation.scene_seed(name)
        write_fitted_scene(self.scene_folder, name, title, shot, images[0], truth.images, seed, files)
