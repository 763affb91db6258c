"""Supplement, "Reconstructor-only without the Encoder": codes of images are optimised, not predicted."""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.autoreconstructor.model import Reconstruction
from completesplat.baselines.autodecoder import AutoDecoder, Codes, optimize_codes
from completesplat.data.sequences import SequenceSource
from completesplat.errors import CompleteSplatError, DataError
from completesplat.gaussians import Gaussians
from completesplat.losses import Prediction, WeightedSum
from completesplat.scene import SceneBatch, Views
from completesplat.splatter_image import SplatterImage
from completesplat.training.reconstruction import ReconstructionModule


class ReconstructorOnly(ReconstructionModule):
    """Joint training of codes and reconstructor; a test image gets a new code for the fixed reconstructor.

    Args:
        loss: weighted terms by name; training uses all views, the test the reference alone.
        code_steps, code_rate: steps and learning rate of a new code's optimisation (800 and 0.005 in DeepSDF).
    """

    model: AutoDecoder

    def __init__(
        self, model: AutoDecoder, loss: WeightedSum, code_steps: int, code_rate: float, **reconstruction: Any
    ) -> None:
        super().__init__(model, loss, **reconstruction)
        self.code_steps = code_steps
        self.code_rate = code_rate

    def setup(self, stage: str) -> None:
        """Allocate a code for each training image, unless a checkpoint has codes."""
        if stage == "fit" and not len(self.model.codes):
            source = self.data.source("train")
            self.model.make_room(sum(_frames(source, name) for name in source.names))

    def on_fit_start(self) -> None:
        """Raise CompleteSplatError for several processes, because each would assign the codes to other images."""
        super().on_fit_start()
        if self.trainer.world_size > 1:
            raise CompleteSplatError("model=reconstructor_only trains in one process: set trainer.devices=1")

    def save_weights(self, folder: Path) -> None:
        """Write none, because a photo has no code."""

    def forward(self, scenes: SceneBatch, others: int = 0) -> Reconstruction:
        """Reconstruct training images from their codes; in evaluation, reconstruct any image from a new code."""
        if not self.training:
            return Reconstruction(self.model(self.infer_codes(scenes, seed=0)), None)
        return Reconstruction(self.model(self.model.codes_of(scenes.names, scenes.reference_frame)), None)

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Return Gaussians of new codes that are optimised for the reference view from seeded initial values."""
        return self.gaussians(self.infer_codes(scenes, seed), scenes)

    def infer_codes(self, scenes: SceneBatch, seed: int) -> Codes:
        """Optimise new codes for the reference views alone, at fixed weights."""
        with torch.inference_mode(False), torch.autocast(self.device.type, enabled=False):
            # Autograd cannot use tensors that were made in inference mode, but it can use copies.
            scenes = scenes.map(torch.clone)
            codes = self.model.new_codes(len(scenes.names), seed)
            return optimize_codes(codes, lambda x: self.reference_loss(x, scenes), self.code_steps, self.code_rate)

    def gaussians(self, codes: Codes, scenes: SceneBatch) -> Gaussians:
        """Decode codes to Gaussians."""
        image: SplatterImage = self.model(codes)
        return image.gaussians(scenes.reference.cameras, scenes.depth_range)

    def reference_loss(self, codes: Codes, scenes: SceneBatch) -> Float[Tensor, ""]:
        """Return the loss of the reference views alone, with the terms of the current training step."""
        views: Views = scenes.reference.map(lambda tensor: tensor[:, None])
        gaussians = self.gaussians(codes, scenes)
        images = self.rasterizer(gaussians, views.cameras).over(self.background)
        total, _ = self.loss(Prediction(images, gaussians, None), views, self.global_step)
        return total


def _frames(source: SequenceSource, name: str) -> int:
    """Return the number of a sequence's frames; 0 if it cannot be read."""
    try:
        return len(source.read(name).frames)
    except DataError:
        return 0
