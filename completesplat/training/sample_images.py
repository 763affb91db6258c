"""Samples of latent diffusion for a few fixed scenes while it trains, and the denoising of one sample."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from lightning import Trainer
from PIL import Image
from torch import Tensor

from completesplat.export.images import SheetCell, color_depth, image_sheet, write_png
from completesplat.gaussians import Gaussians
from completesplat.metrics.images import psnr
from completesplat.metrics.scoring import diversity
from completesplat.scene import SceneBatch
from completesplat.settings.schema import Natural, Positive
from completesplat.tensors import stack
from completesplat.training.fixed_scenes import DrawsFixedScenes, log_drawings
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.stage import Stage


class Samples(DrawsFixedScenes):
    """Callback that draws samples of each scene from its reference and target views; see `DrawsFixedScenes`.

    `folder/step_000500.png` has rows for each scene: true images (the input first), each sample, and the depth of the
    first sample. `folder/strip_000500.png` shows how the first sample is denoised: the scenes of the clean latent's
    estimates, from the reference and from the middle target. All loggers get metrics of the targets' views:
    `samples/diversity` (of two samples or more), `samples/psnr` (mean over the samples) and `samples/psnr_of_mean` (of
    their mean image). Weights & Biases gets both image files too.

    Args:
        samples: samples of a scene, always from the same noise.
        strip: the largest number of denoiser calls shown, evenly spaced from the first to the last.
    """

    def __init__(
        self,
        folder: str,
        every_n_steps: Positive = 2000,
        scenes: Natural = 2,
        samples: Positive = 4,
        views: Positive = 8,
        strip: Positive = 8,
    ) -> None:
        super().__init__(folder, every_n_steps, scenes, views)
        self.samples = samples
        self.strip = strip

    def draw(self, trainer: Trainer, module: Stage, scenes: list[SceneBatch]) -> None:
        assert isinstance(module, LatentDiffusion)
        drawn = [self._draw_scene(trainer, module, stack([scene]).to(module.device)) for scene in scenes]
        images = {"step": samples_sheet(drawn), "strip": strip_sheet(drawn)}
        for kind, image in images.items():
            write_png(self.folder / f"{kind}_{trainer.global_step:06}.png", image)
        scores = [scene.scores() for scene in drawn]
        figures = {f"samples/{name}": sum(values[name] for values in scores) / len(scores) for name in scores[0]}
        log_drawings(trainer, figures, {"samples": images["step"], "denoising": images["strip"]}, {})

    def _draw_scene(self, trainer: Trainer, module: LatentDiffusion, scene: SceneBatch) -> "SceneDrawings":
        views = scene.all_views()
        steps: dict[int, tuple[int, Gaussians]] = {}
        calls = evenly_spaced(len(module.completesplat.sampler.set_up().timesteps), self.strip)

        def store(call: int, timestep: int, estimates: Gaussians) -> None:
            if call in calls:
                # Samples that do not fit into memory together come in parts, the first sample in the first part.
                steps.setdefault(call, (timestep, estimates[:1]))

        with trainer.precision_plugin.forward_context():
            gaussians = module.reconstruct(scene, seed=0, samples=self.samples, on_step=store)
        pair = [0, 1 + (len(views.images[0]) - 1) // 2]  # the reference, and the middle one of the targets
        cameras = views.cameras[0]
        rendering = module.render_from(gaussians, cameras)
        denoising = [module.render_from(part, cameras[pair]).over(module.background)[0] for _, part in steps.values()]
        return SceneDrawings(
            views.images[0],
            rendering.over(module.background).clamp(0, 1),
            rendering.expected_depth()[:1],
            [timestep for timestep, _ in steps.values()],
            torch.stack([views.images[0, pair], *denoising]).clamp(0, 1),
        )


@dataclass(frozen=True)
class SceneDrawings:
    """True images and renders of one scene, the reference view first; the strip starts with true images."""

    true: Float[Tensor, "view 3 height width"]
    samples: Float[Tensor, "sample view 3 height width"]
    depth: Float[Tensor, "1 view 1 height width"]
    timesteps: list[int]
    strip: Float[Tensor, "call 2 3 height width"]

    def scores(self) -> dict[str, float]:
        """Score the targets' views."""
        images, true = self.samples[:, 1:], self.true[1:]
        scores = {
            "psnr": psnr(images.flatten(0, 1), true.expand_as(images).flatten(0, 1)).mean().item(),
            "psnr_of_mean": psnr(images.mean(0), true).mean().item(),
        }
        return scores | {"diversity": diversity(images)} if len(images) > 1 else scores


def evenly_spaced(count: int, most: int) -> list[int]:
    """Return at most `most` evenly spaced numbers below `count`, always with the last one."""
    return sorted({round(place) for place in np.linspace(count - 1, 0, most)})


def samples_sheet(drawn: list[SceneDrawings]) -> Image.Image:
    """Draw a sheet with a column for each view; views that a scene lacks stay white."""
    rows: list[list[SheetCell | None]] = []
    for scene in drawn:
        samples = [labelled(f"sample {i + 1}", images) for i, images in enumerate(scene.samples)]
        rows += [labelled("true", scene.true), *samples, labelled("depth of 1", color_depth(scene.depth[0])[0])]
    most = max(map(len, rows))
    return image_sheet(["input's view", *(f"target {i + 1}" for i in range(most - 1))], rows)


def strip_sheet(drawn: list[SceneDrawings]) -> Image.Image:
    """Draw a sheet with a column for each denoiser call in the strips."""
    views = ("input's view", "middle target")
    rows = [
        labelled(name, images) for scene in drawn for name, images in zip(views, scene.strip.unbind(1), strict=True)
    ]
    return image_sheet(["true", *(f"timestep {timestep}" for timestep in drawn[0].timesteps)], rows)


def labelled(name: str, images: Float[Tensor, "image 3 height width"]) -> list[SheetCell | None]:
    """Return a row of a sheet, with its name above the first image. Values that are not finite are black."""
    first, *others = images.nan_to_num()
    return [SheetCell(first, name), *map(SheetCell, others)]
