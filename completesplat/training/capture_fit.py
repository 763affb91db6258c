"""Gaussians fitted to the training frames of one capture, and scored on the frames that are held out."""

import logging
import math
from collections.abc import Callable, Sequence
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

from completesplat.baselines import densification, fitting
from completesplat.data.packed.manifest import is_packed
from completesplat.data.sequences import PosedSequence, first_names
from completesplat.errors import CompleteSplatError
from completesplat.evaluation.naive_predictors import Renders
from completesplat.export.fitted_scene import FittedViews, write_fitted_scene
from completesplat.export.placed_scene import FileCoordinates, PlacedScene
from completesplat.export.scene_files import OutputFiles, write_scene
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.losses import Prediction, WeightedSum
from completesplat.quantities import CameraPath, Format, NonNegative, Positive, Range, Share
from completesplat.scene import Batch, SceneBatch, Views
from completesplat.tensors import stack
from completesplat.training.optimization import Schedule, constant
from completesplat.training.stage import Stage

REFINED_SHARE = 0.8  # of the run, in which Gaussians move and are added (close to 25,000 of 30,000 steps in 3DGS-MCMC)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of the Gaussians of a capture.

    Attributes:
        initial, most: first and largest number of Gaussians. The first is at most that of the points.
        opacity: initial opacity of all Gaussians.
        refine_every: steps between relocations of dead Gaussians, which add the share `growth` of new ones.
        opacity_weight, scale_weight: weights of mean opacity and mean scale in the loss.
        position_rate, other_rates: factors on 3DGS's learning rates, which are meant for 30,000 steps.
        opacity_rate: factor on the opacities' learning rate. With 4, captures of flat floors and walls collapse.
    """

    initial: fitting.Count = 20_000
    most: fitting.Count = 50_000
    opacity: fitting.Translucent = 0.1
    refine_every: Positive = 50
    growth: Share = 0.05
    opacity_weight: NonNegative = 0.01
    scale_weight: NonNegative = 0.01
    position_rate: Annotated[float, Range(1e-3)] = 10.0
    opacity_rate: NonNegative = 1.0
    other_rates: NonNegative = 4.0


class CaptureFit(Stage):
    """Gaussians of one capture, fitted to its training frames (Kerbl et al. 2023, Kheradmand et al. 2024).

    All parameters have rows for `most` Gaussians, of which the first `count` are used, so that checkpoints and the
    optimizer's state keep their shapes while the number of Gaussians grows. They are in the data module's world.

    Args:
        scene_folder: folder of the result in the capture's own world and units, by `write_fitted_scene` and
            `write_scene`; None: nothing is written.
        formats, videos, frames: as in `OutputFiles`, without `ply`. A format whose writing fails is left out.
    """

    first_novel = 0  # every held-out photo, the reference too, is scored as a novel view
    unused_settings = ("optimizer", "schedule")

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
        self.outputs = OutputFiles(formats, videos, frames, self.background)
        self.raw = nn.ParameterDict(
            {
                "means": torch.zeros(fitting.most, 3),
                "log_scales": torch.zeros(fitting.most, 3),
                "quaternions": torch.zeros(fitting.most, 4),
                "logits": torch.zeros(fitting.most),
                "harmonics": torch.zeros(fitting.most, 3),
            }
        )
        self.count: Tensor
        self.register_buffer("count", torch.tensor(0))

    def gaussians(self) -> Gaussians:
        used = {name: tensor[None, : int(self.count)] for name, tensor in self.raw.items()}
        return fitting.RawGaussians(**used).gaussians()[0]

    def sequence(self, split: str) -> PosedSequence:
        """Return the frames of a split of the capture.

        Raises:
            CompleteSplatError: the data are not exactly one capture, as it was taken.
        """
        store = self.data.store(split)
        packed = is_packed(self.data.root)
        if packed or len(store.names) != 1 or not self.data.splits_share_sequences:
            state = "is prepared" if packed else f"has {len(store.names)} sequences ({first_names(store.names)})"
            advice = "model=capture fits one capture: give data=capture and its folder, as it was taken"
            raise CompleteSplatError(f"data.root={self.data.root} {state}; {advice}")
        return store.source.read(store.names[0])

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
        changed = self.data.augmentation.active()
        if changed:
            raise CompleteSplatError(f"data.{changed[0]}: model=capture fits the photos as they are; turn it off")
        sequence = self.sequence("train")
        if self.count:
            return
        generator = torch.Generator().manual_seed(0)
        opacity = self.fitting.opacity
        scene = stack([self.data.store("train").scene(sequence, 0, range(1, len(sequence.frames)))]).to(self.device)
        views = self.in_world(scene, "train")
        most = min(self.fitting.initial, self.fitting.most)
        if sequence.points is None or len(sequence.points) <= fitting.NEIGHBOURS:
            points = fitting.initial_gaussians(views, scene.depth_range, most, opacity, generator).means[0]
        else:
            chosen = torch.randperm(len(sequence.points), generator=generator)[:most]
            points = sequence.points[chosen].to(self.device)
        for name, tensor in vars(fitting.gaussians_at_points(points, views[0], opacity)).items():
            self.raw[name][: len(points)] = tensor[0]
        self.count.fill_(len(points))

    @torch.no_grad()
    def on_train_batch_start(self, batch: Batch, index: int) -> None:
        """Move dead Gaussians, add new ones, and disturb transparent ones, before all steps but the first."""
        super().on_train_batch_start(batch, index)
        step = self.global_step
        total = self.trainer.estimated_stepping_batches
        settings = self.fitting
        if step == 0 or index % self.trainer.accumulate_grad_batches:
            return
        (optimizer,) = self.trainer.optimizers
        count = int(self.count)
        rate = optimizer.param_groups[0]["lr"] / settings.position_rate
        self.raw["means"][:count] += densification.position_noise(self.gaussians(), rate)
        if step % settings.refine_every == 0 and step < REFINED_SHARE * total:
            grown = max(count, min(settings.most, int(count * (1 + settings.growth))))
            changed = densification.relocate(dict(self.raw.items()), count, grown)
            for state in optimizer.state.values():
                for key in ("exp_avg", "exp_avg_sq"):
                    state[key][changed] = 0
            self.count.fill_(grown if len(changed) else count)

    def training_step(self, scenes: SceneBatch, index: int) -> Float[Tensor, ""]:
        gaussians = self.gaussians()
        views = self.in_world(scenes, "train")
        settings = self.fitting
        with torch.autocast(self.device.type, enabled=False):
            rendering = self.rasterizer(gaussians[None], views.cameras)
        images = rendering.over(self.background)
        total, terms = self.loss(Prediction(images, gaussians[None], None), views, self.global_step)
        total = total + settings.opacity_weight * gaussians.opacities.mean()
        total = total + settings.scale_weight * gaussians.scales.mean()
        figures = {f"train/{name}": value for name, value in terms.items()}
        figures["train/loss"] = total.detach()
        figures["train/gaussians"] = self.count.float()
        self.log_step(figures, batch_size=len(scenes.names))
        return total

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Build Adam with 3DGS's rates and epsilon, where the rate of the positions decays to a hundredth."""
        depth_ranges = self.sequence("train").depth_ranges
        settings = self.fitting
        optimizer = fitting.adam(
            dict(self.raw.items()), depth_ranges, settings.position_rate, settings.opacity_rate, settings.other_rates
        )
        steps = max(1, self.trainer.estimated_stepping_batches)

        def decay(step: int) -> float:
            return fitting.POSITION_DECAY ** (step / steps)

        def constant_rate(step: int) -> float:
            return 1.0

        decays: list[Callable[[int], float]] = [constant_rate] * len(self.raw)
        decays[0] = decay
        schedule = Schedule(optimizer, decays)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Return the fitted Gaussians in the frame of each scene's reference, a held-out frame."""
        gaussians = self.gaussians()
        return stack([gaussians.transform(pose) for pose in self.reference_poses(scenes, "test")]).detach()

    def on_test_start(self) -> None:
        """Note for tables what the Gaussians were fitted to."""
        fitted = self.sequence("train").photos
        held_out = self.sequence("test").photos
        photos = len(fitted) + len(held_out)
        rule = self.data.describe()["split"]
        self.fitted_to = f"{len(fitted)} of {photos} photos; {rule}: {', '.join(held_out)}"
        super().on_test_start()

    def test_results(self) -> dict[str, dict[str, Any]]:
        """Return the scores, with the names of the photos, and warn if the photos' mean scores as well."""
        results = super().test_results()
        results["model"]["photos"] = {
            "fitted": list(self.sequence("train").photos),
            "held_out": list(self.sequence("test").photos),
        }
        psnr = results["model"]["full"]["novel"].get("psnr", math.nan)
        psnr_of_mean = results["mean_image"]["full"]["novel"].get("psnr", math.nan)
        if psnr <= psnr_of_mean:
            scores = f"{psnr:.2f} dB, the mean image {psnr_of_mean:.2f} dB"
            logger.warning("%s: are these the cameras of these photos, and are the steps enough?", scores)
        return results

    def scene_scored(self, name: str, gaussians: Gaussians, cameras: Cameras, images: Renders, truth: Views) -> None:
        """Write the scene, the held-out frames beside their renders, videos and other formats."""
        if self.scene_folder is None:
            return
        sequence = self.sequence("test")
        poses = cameras.world_to_camera @ sequence.cameras.world_to_camera[0].to(cameras.world_to_camera)
        placed = replace(cameras, world_to_camera=poses)
        up = normalize(-poses[:, 1, :3].mean(0), dim=-1)
        self.scene_folder.mkdir(parents=True, exist_ok=True)
        reference, targets = self.data.evaluation_views(sequence, "test")
        photos = tuple(sequence.photos[index] for index in (reference, *targets))
        coordinates = FileCoordinates(sequence.scale, sequence.origin)
        scene = PlacedScene(self.gaussians().detach(), placed[0], up, coordinates=coordinates)
        names = dict[str, str]()
        comments = [f"scene {name}"]
        on_file = partial(logger.info, "writing %s")
        # Each format is written on its own, so that one that fails leaves the others.
        parts = [replace(self.outputs, formats=())]
        for scene_format in self.outputs.formats:
            parts.append(replace(self.outputs, formats=[scene_format], videos=()))
        for part in parts:
            try:
                written = write_scene(self.scene_folder, "scene", "", scene, self.rasterizer, part, comments, on_file)
            except CompleteSplatError as error:
                logger.warning("left out: %s", error)
            else:
                names.update(written)
        title = f"{name}: held-out photos, Gaussians fitted to the {len(self.sequence('train').frames)} others"
        seed = self.evaluation.scene_seed(name)
        views = FittedViews(images[0], truth.images, photos)
        write_fitted_scene(self.scene_folder, name, title, scene, views, seed, names)
