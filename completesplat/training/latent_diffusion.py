"""Stage 2: latent diffusion over the frozen autoreconstructor's latents (paper, Section 3.3)."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from completesplat.autoreconstructor.posterior import Posterior
from completesplat.data.loading.distributed import gather_values
from completesplat.data.loading.latent_cache import LatentCache
from completesplat.diffusion.denoiser import Latents
from completesplat.diffusion.objective import target
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.evaluation.scorer import Scorer
from completesplat.gaussians import Gaussians
from completesplat.generator import CompleteSplat
from completesplat.quantities import Natural, Positive, Share
from completesplat.sampling_settings import Sampling
from completesplat.scene import Batch, SceneBatch
from completesplat.training.encoding import check_cache
from completesplat.training.stage import Compile, Stage, prepare_network
from completesplat.weights.checkpoint_reading import load_part

LOSS_BUCKETS = 4
"""Equal ranges of timesteps, for each of which the loss is logged."""


class DiffusionScorer(Scorer):
    """Scorer of the samples that a latent diffusion model draws.

    Args:
        **rendering: see `Scorer`.
    """

    draws_samples = True
    skip_weight = 1.0
    guidance_weight = 0.0
    color_fits = 0

    def __init__(self, completesplat: CompleteSplat, **rendering: Any) -> None:
        super().__init__(**rendering)
        self.completesplat = completesplat

    @property
    def method(self) -> str:
        """Return the name in tables, also for weights that were trained elsewhere."""
        return LatentDiffusion.__name__

    @property
    def up(self) -> Float[Tensor, "3"]:
        """Return the direction up in the reference camera's frame, as measured on the training set."""
        return self.completesplat.up

    def draw(self, scenes: SceneBatch, seeds: Sequence[int], samples: int, batch: int | None = None) -> Gaussians:
        """Draw samples as `Scorer.draw` does. The samples of an image depend on no other image."""
        return self.sample(scenes, Sampling(samples=samples, seed=seeds, batch=batch))

    def reconstruct(self, scenes: SceneBatch, seed: int) -> Gaussians:
        """Draw one sample for each reference image."""
        return self.sample(scenes, Sampling(seed=seed))

    def sample(self, scenes: SceneBatch, sampling: Sampling) -> Gaussians:
        """Draw samples for each reference image, with the weights and fits of this scorer."""
        sampling = replace(
            sampling,
            skip_weight=self.skip_weight,
            guidance_weight=self.guidance_weight,
            color_fits=self.color_fits,
        )
        reference = scenes.reference
        return self.completesplat.generate(
            reference.images, reference.cameras, scenes.depth_range, sampling, scenes.visible
        )


class LatentDiffusion(DiffusionScorer, Stage):
    """Train the denoiser and a learned conditioning to predict the noise in latents (paper, Eqs. 2 and 3).

    Batches are scenes, or scenes that were encoded beforehand. Both train the same.

    Args:
        completesplat: the whole generator, its autoreconstructor still without weights.
        autoreconstructor_checkpoint: checkpoint of stage 1 to start from.
        checkpoint: checkpoint of this stage to start from instead (for masked diffusion): all weights, the averaged
            ones if it has them, and all measured values.
        unconditional_probability: probability of zeroing phi_ref, for guidance (0.2 in the paper).
        noise_draws: timesteps and noises that are drawn for each scene of a batch, whose image is encoded once.
        skip_weight, guidance_weight, color_fits: settings of the samples drawn in validation and test.
        scale_batches: training batches on which the latents' mean and standard deviation are measured.
        channels_last, compile: of the denoiser, see `prepare_network`.
        **rendering_and_optimization: see `Stage`.

    Raises:
        WeightsError: a checkpoint is unusable, or both are given.
    """

    def __init__(
        self,
        completesplat: CompleteSplat,
        autoreconstructor_checkpoint: str | None = None,
        checkpoint: str | None = None,
        unconditional_probability: Share = 0.2,
        noise_draws: Positive = 1,
        skip_weight: Share = 1.0,
        guidance_weight: Share = 0.0,
        color_fits: Natural = 0,
        scale_batches: Positive = 50,
        channels_last: bool = False,
        compile: Compile = False,
        **rendering_and_optimization: Any,
    ) -> None:
        super().__init__(completesplat, **rendering_and_optimization)
        self.autoreconstructor_checkpoint = autoreconstructor_checkpoint
        self.checkpoint = checkpoint
        self.unconditional_probability = unconditional_probability
        self.noise_draws = noise_draws
        self.skip_weight = skip_weight
        self.guidance_weight = guidance_weight
        self.color_fits = color_fits
        self.logged_step = -1
        self.scale_batches = scale_batches
        if autoreconstructor_checkpoint is not None and checkpoint is not None:
            raise WeightsError("model.checkpoint holds stage 1 as well: set model.autoreconstructor_checkpoint=null")
        if autoreconstructor_checkpoint is not None:
            load_part(completesplat.autoreconstructor, autoreconstructor_checkpoint, prefix="model.")
        if checkpoint is not None:
            load_part(completesplat, checkpoint, prefix="completesplat.")
        self.memory_format = prepare_network(completesplat.denoiser, channels_last, compile)

    def save_weights(self, folder: Path) -> None:
        """Write the generator with facts about its training images."""
        self.completesplat.architecture["training"] = self.data.training_facts()
        self.completesplat.save_pretrained(folder)

    def on_fit_start(self) -> None:
        """Measure the latents' scale and the typical camera on the training set.

        Raises:
            WeightsError: frozen parts have no weights.
            CompleteSplatError: a posterior that sees views gets none.
        """
        if self.checkpoint is None and self.trainer.ckpt_path is None:
            self._refuse_random_parts()
        parts = self.completesplat
        data = self.data
        cache = None if data.latent_cache is None else data.cached_latents
        if cache is not None:
            check_cache(cache, parts.autoreconstructor, parts.conditioning)
        elif parts.autoreconstructor.sees_views and data.targets < 1:
            raise CompleteSplatError("latents of the reference alone hold nothing hidden: set data.targets (to 5, say)")
        if (parts.latent_std != 1).any():  # a resumed run keeps its measured values
            return
        self._measure_latents(data.train_dataloader(), cache)
        camera = data.typical_camera()
        parts.fov_degrees.fill_(camera.fov_degrees)
        parts.depth_range.copy_(torch.tensor(camera.depth_range))
        parts.up.copy_(torch.tensor(camera.up))

    def _refuse_random_parts(self) -> None:
        """Raise WeightsError if a frozen part has no checkpoint."""
        if self.autoreconstructor_checkpoint is None:
            raise WeightsError(
                "stage 2 needs weights: give model.autoreconstructor_checkpoint=FILE of stage 1, or "
                "model.checkpoint=FILE of an earlier part of stage 2"
            )
        conditioning = self.completesplat.conditioning
        if conditioning.frozen and conditioning.pretrained is None:
            raise WeightsError(
                "the frozen conditioning needs weights: give conditioning.pretrained=DIR (of Stable Diffusion's VAE), "
                "or train one with conditioning=learned"
            )

    @torch.no_grad()
    def _measure_latents(self, loader: Iterable[Batch], cache: LatentCache | None) -> None:
        """Measure mean and standard deviation of each latent channel, with which the denoiser's are standardised.

        The paper does not state how it scales latents. The values are stored with the weights. A cache has exact ones.
        """
        drawn = []
        for batch in islice(loader, self.scale_batches):
            latent, condition = self.inputs(batch.to(self.device))
            if latent.shape[-2:] != condition.shape[-2:]:
                raise CompleteSplatError(
                    f"latents are {_size(latent)} and the conditioning's features {_size(condition)} in size: "
                    "conditioning.channels and autoreconstructor.encoder.channels must have as many levels"
                )
            drawn.append(latent.cpu().double())
        latents = torch.cat(gather_values(torch.cat(drawn) if drawn else torch.zeros(1, 1, 1, 1)))
        mean = latents.mean((0, 2, 3))
        std = latents.std((0, 2, 3), correction=0)
        if not (std > 0).all():
            raise CompleteSplatError("the latents do not vary: no training images, or an encoder that ignores them")
        means = mean.tolist() if cache is None else cache.mean
        stds = std.tolist() if cache is None else cache.std
        self.completesplat.set_latent_moments(means, stds)
        figures = {f"latents/mean_{channel}": value for channel, value in enumerate(means)}
        figures.update({f"latents/std_{channel}": value for channel, value in enumerate(stds)})
        for logger in self.trainer.loggers:
            logger.log_metrics(figures, step=self.trainer.global_step)

    def inputs(self, batch: Batch) -> tuple[Latents, Float[Tensor, "batch features _ _"]]:
        """Return a draw of the scaled latents, and phi_ref.

        Encoded scenes have images for a conditioning that is trained, and features for one that is frozen.
        """
        parts = self.completesplat
        if isinstance(batch, SceneBatch):
            views = batch.all_views() if parts.autoreconstructor.sees_views else None
            latent = parts.encode(batch.reference.images, views, batch.depth_range)
            return latent, parts.conditioning(batch.reference.images * batch.visible)
        posterior = Posterior(batch.mean, batch.log_variance)
        latent = parts.standardised(parts.autoreconstructor.training_latent(posterior))
        return latent, batch.condition if parts.conditioning.frozen else parts.conditioning(batch.condition)

    @torch.no_grad()
    def predicts_finite(self, batch: Batch) -> bool:
        """Return whether the denoiser's output for the batch's first scene, which may be encoded, is finite."""
        latent, conditioning = self.inputs(batch[:1])
        timestep = torch.zeros(1, dtype=torch.int64, device=self.device)
        return bool(self.completesplat.denoiser(latent, timestep, conditioning).isfinite().all())

    def training_step(self, batch: Batch, index: int) -> Float[Tensor, ""]:
        errors, timestep = self.denoising_errors(batch, self.unconditional_probability)
        self.log_loss(errors.detach(), timestep)
        return errors.mean()

    def validation_step(self, scenes: SceneBatch, index: int) -> None:
        """Score novel views, and log the loss of conditional denoising, with the same noise in each validation."""
        super().validation_step(scenes, index)
        with torch.random.fork_rng([self.device] if self.device.type == "cuda" else []):
            torch.manual_seed(index)
            errors, _ = self.denoising_errors(scenes, unconditional_probability=0.0)
        self.log("val/loss", errors.mean(), batch_size=len(errors))

    def denoising_errors(
        self, batch: Batch, unconditional_probability: float
    ) -> tuple[Float[Tensor, " draw"], Int64[Tensor, " draw"]]:
        """Return squared errors of the denoiser for random timesteps and noise, and these timesteps."""
        parts = self.completesplat
        latent, conditioning = self.inputs(batch)
        latent = latent.repeat_interleave(self.noise_draws, 0)
        conditioning = conditioning.repeat_interleave(self.noise_draws, 0)
        conditioned = torch.rand(len(latent), device=self.device) >= unconditional_probability
        conditioning = conditioning * conditioned[:, None, None, None]
        noise = torch.randn(latent.shape, device=self.device)  # `randn_like` would depend on the memory layout
        timestep = parts.sampler.draw_timesteps(len(latent), self.device)
        noisy = parts.sampler.add_noise(latent, noise, timestep)
        noisy = noisy.contiguous(memory_format=self.memory_format)
        conditioning = conditioning.contiguous(memory_format=self.memory_format)
        predicted = parts.denoiser(noisy, timestep, conditioning)
        errors: Tensor = (predicted - target(parts.sampler.scheduler, latent, noise, timestep)).square().mean((1, 2, 3))
        return errors, timestep

    def log_loss(self, errors: Float[Tensor, " batch"], timestep: Int64[Tensor, " batch"]) -> None:
        """Log the mean of the samples' losses, and that of each quarter of the timesteps that is among them."""
        self.log_step({"train/loss": errors.mean()}, batch_size=len(errors))
        interval = self.trainer.log_every_n_steps  # type: ignore[attr-defined]
        if interval and (self.global_step + 1) % interval == 0 and self.logged_step != self.global_step:
            self.logged_step = self.global_step  # of accumulated batches, the first is logged
            errors = torch.cat(gather_values(errors.cpu()))
            timestep = torch.cat(gather_values(timestep.cpu()))
            values = losses_by_timestep(errors, timestep, self.completesplat.sampler.training_timesteps)
            # Lightning would repeat the loss of a quarter in the rows of later steps that have no sample in it.
            for logger in self.loggers:
                logger.log_metrics(values, step=self.global_step)


def _size(images: Float[Tensor, "batch channel height width"]) -> str:
    height, width = images.shape[-2:]
    return f"{height}x{width}"


def losses_by_timestep(errors: Float[Tensor, " n"], timestep: Int64[Tensor, " n"], timesteps: int) -> dict[str, float]:
    """Return the mean loss of the samples in each of four equal ranges of timesteps that has samples."""
    buckets = timestep.clamp(max=timesteps - 1) * LOSS_BUCKETS // timesteps
    return {f"train/loss_t{i}": errors[buckets == i].mean().item() for i in sorted(set(buckets.tolist()))}
