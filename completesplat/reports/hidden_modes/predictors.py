"""What a trained model puts where the reference view shows nothing: renders of samples, scene by scene."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.gaussians import Gaussians
from completesplat.scene import SceneBatch

Renders = Float[Tensor, "sample view 3 height width"]
Predictor = Callable[[SceneBatch, int], Renders]
"""Scene (a batch of one) and seed -> renders of all targets, in [0, 1]."""


def predictors(module: Any, samples: int, batch: int) -> dict[str, Predictor]:
    """`model`: as it is tested. `posterior_samples`, for a variational autoreconstructor: latents that are drawn.

    A model that draws nothing gives `samples` equal ones. Samples are computed and rendered `batch` at a time.
    """
    predict = _samples if module.draws_samples else _repeated
    found: dict[str, Predictor] = {"model": partial(predict, module, samples, batch)}
    if isinstance(getattr(module, "model", None), VariationalAutoReconstructor):
        found["posterior_samples"] = partial(_posterior_samples, module, samples, batch)
    return found


def _samples(module: Any, samples: int, batch: int, scene: SceneBatch, seed: int) -> Renders:
    gaussians = module.reconstruct(scene, seed=seed, samples=samples, batch=batch)
    return torch.cat([_render(module, gaussians[i : i + batch], scene) for i in range(0, samples, batch)])


def _repeated(module: Any, samples: int, batch: int, scene: SceneBatch, seed: int) -> Renders:
    image = _render(module, module.reconstruct(scene, seed=seed), scene)
    return image.expand(samples, *image.shape[1:])


def _posterior_samples(module: Any, samples: int, batch: int, scene: SceneBatch, seed: int) -> Renders:
    model: VariationalAutoReconstructor = module.model
    images = scene.reference.images * scene.visible if module.masked else scene.reference.images
    posterior, features = model.encoder(images)
    # On the CPU, so that a seed means the same on every device.
    noise = torch.randn(samples, *posterior.mean.shape[1:], generator=torch.Generator().manual_seed(seed))
    latents = posterior.mean + noise.to(posterior.mean) * posterior.std
    parts = [_decoded(model, part, features, scene) for part in latents.split(batch)]
    return torch.cat([_render(module, gaussians, scene) for gaussians in parts])


def _decoded(
    model: VariationalAutoReconstructor,
    latents: Float[Tensor, "sample channel _ _"],
    features: Sequence[Float[Tensor, "1 _ _ _"]],
    scene: SceneBatch,
) -> Gaussians:
    count = len(latents)
    splatter_image = model.reconstructor(latents, [feature.expand(count, -1, -1, -1) for feature in features])
    cameras = scene.reference.cameras.map(lambda tensor: tensor.expand(count, -1, -1))
    return splatter_image.gaussians(cameras, scene.depth_range.expand(count, -1))


def _render(module: Any, gaussians: Gaussians, scene: SceneBatch) -> Renders:
    return module.render_from(gaussians, scene.targets.cameras[0]).over(module.background).clamp(0, 1)
