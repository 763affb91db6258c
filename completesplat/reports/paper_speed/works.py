"""The pieces of work that the paper gives durations of, on random weights: what pictures show does not change them.

Each function gives those of one stage, by their names in `figures.FIGURES`.
"""

from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor, nn

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.geometry.trajectories import orbit
from completesplat.reports.diffusion.training import Training, autocast
from completesplat.scene import SceneBatch
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.training.scene_module import SceneModule

VIEWS = 100

Works = dict[str, Callable[[], object]]


def stage1(module: ReconstructionModule, scenes: SceneBatch, precision: str) -> Works:
    """Of the autoreconstructor: the first scene from its picture, its views, and an optimizer step on all scenes."""
    scene = scenes[:1]

    @torch.no_grad()
    def reconstruct() -> Gaussians:
        with autocast(scene.depth_range.device, precision):
            return module.eval().reconstruct(scene)

    gaussians = reconstruct().map(Tensor.float)
    cameras = orbit_cameras(scene.reference.cameras[0], gaussians)

    @torch.no_grad()
    def render() -> Tensor:
        return module.rasterizer(gaussians, cameras).color

    return {"reconstruct": reconstruct, "render": render, "stage1_step": _step(module, scenes, precision)}


def stage2(module: LatentDiffusion, scenes: SceneBatch, precision: str, samples: int) -> Works:
    """Of latent diffusion: samples of the first picture, and an optimizer step on all, encoded within the time."""
    scene = scenes[:1]
    parts = module.completesplat

    def draw(count: int) -> Gaussians:
        with autocast(scene.depth_range.device, precision):
            reference = scene.reference
            return parts.eval().generate(reference.images, reference.cameras, scene.depth_range, samples=count)

    return {
        "sample": lambda: draw(1),
        "samples": lambda: draw(samples),
        "stage2_step": _step(module, scenes, precision),
    }


def networks(module: ReconstructionModule | LatentDiffusion) -> list[nn.Module]:
    """What can be compiled: the parts that are called as a whole."""
    if isinstance(module, ReconstructionModule):
        return [module.model.get_submodule("encoder"), module.model.get_submodule("reconstructor")]
    parts = module.completesplat
    frozen = parts.autoreconstructor
    return [frozen.encoder, frozen.reconstructor, parts.conditioning, parts.denoiser]


def orbit_cameras(camera: Cameras, gaussians: Gaussians) -> Cameras:
    """Cameras around the scene: [1, VIEWS]."""
    pivot = gaussians.means[0].mean(0)
    up = pivot.new_tensor([0.0, -1.0, 0.0])
    return orbit(camera, pivot, up, VIEWS).map(lambda tensor: tensor[None])


def _step(module: SceneModule, scenes: SceneBatch, precision: str) -> Callable[[], None]:
    @cache
    def training() -> Training:  # its optimizer's memory is not wanted before
        return Training(module, precision)

    def step() -> None:
        module.train()
        training().step(scenes)

    return step
