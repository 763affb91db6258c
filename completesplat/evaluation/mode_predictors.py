"""Predictors of what the reference view hides: the tested model, and decodings of other latents for comparison."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.autoreconstructor.encoder import Features
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.posterior import Posterior
from completesplat.diffusion.sampling import in_parts
from completesplat.evaluation.records import MODEL
from completesplat.evaluation.scorer import Scorer
from completesplat.gaussians import Gaussians
from completesplat.generator import CompleteSplat
from completesplat.scene import SceneBatch
from completesplat.splatter_image import SplatterImage
from completesplat.tensors import concatenate

OTHER_SCENE = "other_scene"
Renders = Float[Tensor, "sample view 3 height width"]
Predictor = Callable[[SceneBatch, SceneBatch, int], Renders]
"""Function from a scene, another scene (batches of one) and a seed to renders of all targets in [0, 1]."""

Method = Callable[[SceneBatch, SceneBatch, int], Gaussians]
"""Function from the same arguments to Gaussians [sample], or [1] if it draws nothing."""


@dataclass(frozen=True)
class LatentDecoding:
    """Methods that decode different latents with the skips of the scene's image.

    A posterior that sees views takes all targets; `reference_only` is its mean without them.

    Args:
        samples: number of latents that are drawn from a posterior.
        batch: number of latents that are decoded at a time.
        masked: whether the model sees only the visible part of the reference image.
    """

    model: VariationalAutoReconstructor
    samples: int
    batch: int
    masked: bool = False

    def methods(self) -> dict[str, Method]:
        """Return the methods by the names of their rows."""
        methods: dict[str, Method] = {
            "posterior_mean": self.posterior_mean,
            "posterior_samples": self.posterior_samples,
            OTHER_SCENE: self.other_scene,
        }
        if self.model.sees_views:
            methods["reference_only"] = self.reference_only
        return methods

    def posterior_mean(self, scene: SceneBatch, other: SceneBatch, seed: int) -> Gaussians:
        """Decode the mean of the scene's posterior."""
        posterior, _ = self._encode(scene, self.model.sees_views)
        return self._decode(posterior.mean, scene)

    def posterior_samples(self, scene: SceneBatch, other: SceneBatch, seed: int) -> Gaussians:
        """Decode samples of the scene's posterior."""
        return self._decode_samples(scene, scene, seed)

    def other_scene(self, scene: SceneBatch, other: SceneBatch, seed: int) -> Gaussians:
        """Decode samples of another scene's posterior."""
        return self._decode_samples(scene, other, seed)

    def reference_only(self, scene: SceneBatch, other: SceneBatch, seed: int) -> Gaussians:
        """Decode the mean of the posterior that sees the reference image alone."""
        posterior, _ = self._encode(scene, False)
        return self._decode(posterior.mean, scene)

    def _encode(self, scene: SceneBatch, with_views: bool) -> tuple[Posterior, Features]:
        image = scene.reference.images
        if self.masked:
            image = image * scene.visible
        return self.model.posterior(image, scene.all_views() if with_views else None, scene.depth_range)

    def _decode(self, latents: Float[Tensor, "sample channel _ _"], scene: SceneBatch) -> Gaussians:
        _, features = self._encode(scene, False)

        def decode_part(part: slice) -> Gaussians:
            count = len(latents[part])
            skips = [feature.expand(count, -1, -1, -1) for feature in features]
            cameras = scene.reference.cameras[0].repeated(count)
            splatter_image: SplatterImage = self.model.reconstructor(latents[part], skips)
            return splatter_image.gaussians(cameras, scene.depth_range.expand(count, -1))

        return concatenate(in_parts(decode_part, len(latents), self.batch))

    def _decode_samples(self, scene: SceneBatch, encoded: SceneBatch, seed: int) -> Gaussians:
        posterior, _ = self._encode(encoded, self.model.sees_views)
        # On the CPU, so that a seed means the same on every device.
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(self.samples, *posterior.mean.shape[1:], generator=generator)
        # The variance of a posterior that was not variational is not trained; all its samples are the mode.
        std = posterior.std if self.model.variational else torch.zeros_like(posterior.mean)
        return self._decode(posterior.mean + noise.to(posterior.mean) * std, scene)


def predictors(module: Scorer, samples: int, batch: int) -> dict[str, Predictor]:
    """Return `model` as it is tested, and its autoreconstructor's `LatentDecoding`, which shows where modes are lost.

    A posterior that sees views knows the true mode. If the posterior's samples show the modes and the model's do not,
    stage 2 is at fault; if neither do, stage 1 is. A deterministic method returns `samples` equal renders. Samples are
    computed and rendered `batch` at a time.
    """
    methods: dict[str, Method] = {MODEL: lambda scene, other, seed: module.draw(scene, [seed], samples, batch)}
    network = _autoreconstructor_of(module)
    if network is not None:
        masked = getattr(module, "masked", False)
        methods |= LatentDecoding(network, samples, batch, masked).methods()
    return {name: partial(_render, module, method, samples, batch) for name, method in methods.items()}


def _autoreconstructor_of(module: Scorer) -> VariationalAutoReconstructor | None:
    """Return the variational autoreconstructor of a module of stage 1 or 2, or None if it has none."""
    generator = getattr(module, "completesplat", None)
    network = generator.autoreconstructor if isinstance(generator, CompleteSplat) else getattr(module, "model", None)
    return network if isinstance(network, VariationalAutoReconstructor) else None


def _render(
    module: Scorer, method: Method, samples: int, batch: int, scene: SceneBatch, other: SceneBatch, seed: int
) -> Renders:
    gaussians = method(scene, other, seed)
    cameras = scene.targets.cameras[0]
    parts = [gaussians[i : i + batch] for i in range(0, len(gaussians.means), batch)]
    renders = torch.cat([module.render_from(part, cameras).over(module.background) for part in parts])
    return renders.clamp(0, 1).expand(samples, -1, -1, -1, -1)
