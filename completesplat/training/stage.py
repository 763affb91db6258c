"""Base class of what is trained: a scorer with an optimizer, a learning-rate schedule and weights to save."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast, get_args

import torch
from hydra.utils import instantiate
from jaxtyping import Float
from lightning.pytorch.callbacks import WeightAveraging
from lightning.pytorch.plugins import Precision
from lightning.pytorch.utilities.enums import GradClipAlgorithmType
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from completesplat.data.loading.distributed import mean_of_processes
from completesplat.errors import CompleteSplatError, WeightsError, own_errors
from completesplat.evaluation.scorer import Scorer
from completesplat.gaussians import Gaussians
from completesplat.metrics.images import psnr
from completesplat.quantities import Share
from completesplat.rasterizers import Rasterizer
from completesplat.scene import Batch, SceneBatch
from completesplat.settings import schema
from completesplat.weights.checkpoint_reading import load_tensors, read_checkpoint
from completesplat.weights.runs import CONFIG, config_of_checkpoint, with_overrides, without_training

# "cudagraphs" also records a call's operations on a GPU, to start them at once.
Compile = Literal[False, True, "cudagraphs"]


def prepare_network(network: nn.Module, channels_last: bool, compile: Compile) -> torch.memory_format:
    """Order convolution weights in NHWC, or let the network be compiled on its first call.

    Returns:
        The order that images should have.
    """
    if channels_last:
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if compile:
        network.compile(mode="reduce-overhead" if compile == "cudagraphs" else "default")
    return torch.channels_last if channels_last else torch.contiguous_format


class Stage(Scorer):
    """Base class of models that are trained to turn reference images into Gaussians.

    Args:
        schedule: optimizer and steps of the run -> learning-rate schedule, stepped every optimizer step.
        rasterizer, background: see `Scorer`.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        optimizer: Callable[[Iterable[Tensor]], Optimizer],
        schedule: Callable[[Optimizer, float], LRScheduler],
        background: Share = 0.5,
    ) -> None:
        super().__init__(rasterizer, background)
        self.optimizer = optimizer
        self.schedule = schedule
        self.config: Mapping[str, Any] | None = None
        self.gradient_norm: Tensor | None = None  # of this step, if `BadSteps` has computed it
        self._lr: float | None = None
        self.accumulated: list[int] = []  # numbers of scenes of the batches since the last step

    @property
    def lr(self) -> float | None:
        """Return the learning rate that Lightning's `LearningRateFinder` has set, None if the optimizer has its own."""
        return self._lr

    @lr.setter
    def lr(self, rate: float) -> None:
        self._lr = rate
        if self._trainer is None:  # no run has begun
            return
        for config in self._trainer.lr_scheduler_configs:
            config.scheduler.base_lrs = [rate] * len(config.scheduler.base_lrs)

    def latent_figures(self, scenes: SceneBatch) -> dict[str, float]:
        """Return figures of the scenes' latents to log, if the model has a posterior."""
        return {}

    def save_weights(self, folder: Path) -> None:
        """Write the weights that `predict` and `from_pretrained` read, if the model makes scenes from photos."""

    def predicts_finite(self, batch: Batch) -> bool:
        """Return whether a prediction for the batch's first scene is finite, for networks that could make others."""
        return True

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]
        cls,
        checkpoint_path: str | Path,
        map_location: torch.device | str | None = None,
        hparams_file: str | Path | None = None,
        strict: bool | None = None,
        weights_only: bool | None = None,
        trust: bool = False,
        **overrides: Any,
    ) -> Any:
        """Build the model of a checkpoint from the config in it (`hyper_parameters`), with its weights.

        Args:
            hparams_file: YAML file whose `model` replaces the config in the checkpoint, such as a run's `config.yaml`.
            strict: refuse tensors that only the checkpoint has or only the model; None: as `strict_loading` says, which
                is true by default. If false, tensors that the checkpoint lacks keep their initial values. Tensors of
                another size are always refused.
            weights_only: always true here.
            trust: the checkpoint names your own modules, and you trust its author; not needed below the working folder.
            **overrides: changes of the config, as the options `model.NAME` of `fit`: `background=0.0`,
                `optimizer={"lr": 1e-5}` or `**{"loss.terms.ssim.weight": 0.5}`. Mappings change only what they name.

        Raises:
            WeightsError: the checkpoint is missing, damaged or of another class, or `config_of_checkpoint` refuses it.
            CompleteSplatError: an override does not fit.
        """
        if weights_only is False:
            raise WeightsError(
                "weights_only=False: only tensors and plain values are read from checkpoints; leave it out"
            )
        path = Path(checkpoint_path)
        contents = read_checkpoint(path)
        hparams = None if hparams_file is None else Path(hparams_file)
        config = OmegaConf.create(config_of_checkpoint(path, contents, trust, hparams))
        model = with_overrides(without_training(config).model, overrides)
        with own_errors():
            module = instantiate(model, _convert_="all")
        if not isinstance(module, cls):
            raise WeightsError(f"{path}: holds a {type(module).__name__}, which is no {cls.__name__}")
        load_tensors(module, contents["state_dict"], path, module.strict_loading if strict is None else strict)
        module.keep_config(model)
        return module if map_location is None else module.to(map_location)

    def setup(self, stage: str) -> None:
        """Raise CompleteSplatError for a trainer or a compiled module with which training would fail or be wrong.

        Positions of Gaussians and the statistics of images need weights in float32.
        """
        precision = self.trainer.precision
        if precision not in get_args(schema.Precision):
            allowed = ", ".join(name for name in get_args(schema.Precision) if "-" in str(name))
            raise CompleteSplatError(f"Trainer(precision={precision!r}): choose one of {allowed}")
        if getattr(self, "_compiler_ctx", None) is not None:
            advice = "compile its network alone, by model.compile=true in its config"
            raise CompleteSplatError(f"torch.compile({type(self).__name__}) cannot be trained: {advice}")

    def keep_config(self, config: DictConfig) -> None:
        """Store a config of the model, resolved, for checkpoints and weights."""
        model = OmegaConf.create({"model": OmegaConf.to_container(config, resolve=True)})
        self.config = cast(dict[str, Any], OmegaConf.to_container(without_training(model)))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the config, which `load_from_checkpoint` reads."""
        if self.config is not None:
            checkpoint[CONFIG] = dict(self.config)

    def refuse_average(self) -> None:
        """Raise CompleteSplatError if weights are averaged, for a model whose number of weights changes in a run."""
        if any(isinstance(callback, WeightAveraging) for callback in self.trainer.callbacks):  # type: ignore[attr-defined]
            raise CompleteSplatError("callbacks=ema: the number of this model's weights changes; they have no average")

    def log_step(self, values: dict[str, Tensor], batch_size: int) -> None:
        """Log figures of a training step: their means over all processes, of the last of accumulated batches.

        They are sent in one message, because with Lightning's `sync_dist` processes would wait for each figure. With
        `prog_bar=True`, Lightning would wait for the GPU in every step; `Progress` shows them without.
        """
        self.log_dict(mean_of_processes(values), batch_size=batch_size)

    def novel_psnr(self, gaussians: Gaussians, scenes: SceneBatch) -> Float[Tensor, "batch target"]:
        novel = scenes.all_views()[:, self.first_novel :]
        images = self.render(gaussians, novel.cameras).clamp(0, 1)
        return psnr(images.flatten(0, 1), novel.images.flatten(0, 1)).view(images.shape[:2])

    def validation_step(self, scenes: SceneBatch, index: int) -> None:
        values = self.novel_psnr(self.reconstruct(scenes, seed=index), scenes)
        self.log("val/psnr_novel", values.mean(), prog_bar=True, batch_size=len(values))

    def on_train_batch_start(self, batch: Batch, index: int) -> None:
        """Note the number of scenes of this batch, whose gradient may be added to those of earlier ones."""
        if index % self.trainer.accumulate_grad_batches == 0:
            self.accumulated = []
        self.accumulated.append(len(batch.names))

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Give all scenes of accumulated batches the same weight, also in the incomplete group at an epoch's end.

        Lightning divides each batch's loss, a mean over its scenes, by the number of batches in a complete group.
        """
        counts = self.accumulated
        batches = self.trainer.accumulate_grad_batches
        super().backward(loss * (counts[-1] / counts[0]), *args, **kwargs)
        factor = batches * counts[0] / sum(counts)
        if factor != 1 and (len(counts) == batches or self.trainer.is_last_batch):
            torch._foreach_mul_([p.grad for p in self.parameters() if p.grad is not None], factor)

    def configure_gradient_clipping(
        self, optimizer: Optimizer, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        """Clip as Lightning does, but with the norm that `BadSteps` has computed, if it has.

        Gradients of fused optimizers in bfloat16 are clipped too, which Lightning refuses without loss scaling.
        """
        norm = self.gradient_norm
        self.gradient_norm = None
        if norm is not None and gradient_clip_val and gradient_clip_algorithm in (None, "norm"):
            torch.nn.utils.clip_grads_with_norm_(self.parameters(), gradient_clip_val, norm)
            return
        precision = self.trainer.precision_plugin
        scaled = getattr(precision, "scaler", None) is not None
        clip = precision.clip_gradients if scaled else partial(Precision.clip_gradients, precision)
        clip(optimizer, gradient_clip_val or 0.0, GradClipAlgorithmType(gradient_clip_algorithm or "norm"))

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Build the optimizer, and a schedule that spans the run, whether its length is given in steps or epochs."""
        optimizer = self.optimizer([p for p in self.parameters() if p.requires_grad])
        if self.lr is not None:
            for group in optimizer.param_groups:
                group["lr"] = self.lr
        schedule = self.schedule(optimizer, self.trainer.estimated_stepping_batches)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
