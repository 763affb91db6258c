"""Parameters, FLOPs and memory of one optimizer step, counted on fake tensors, which have shapes but no values.

Multiplications and additions of matrix products, convolutions and attention are counted, forward and backward, as by
`torch.utils.flop_counter`; elementwise operations and the rasterizer are not. Memory is what is alive at the same time:
fake tensors are freed when real ones would be.
"""

import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode
from torch.overrides import TorchFunctionMode
from torch.utils import flop_counter
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.losses.ssim import blur_matrix
from completesplat.rasterizers import Rendering
from completesplat.scene import CachedScene, SceneBatch
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.training.stage import Stage
from completesplat.training.steps import Training, synthetic_batch

aten = torch.ops.aten
# torch's counter knows the attention kernels of GPUs only.
FORWARD: Any = flop_counter.sdpa_flop_count
BACKWARD: Any = flop_counter.sdpa_backward_flop_count
ATTENTION: dict[Any, Callable[..., Any]] = {
    aten._scaled_dot_product_flash_attention_for_cpu: lambda *shapes, **_: FORWARD(*shapes[:3]),
    aten._scaled_dot_product_flash_attention_for_cpu_backward: lambda *shapes, **_: BACKWARD(*shapes[:4]),
}
# Floats for each Gaussian and view: kept for the backward pass (gsplat: 2D mean, conic, depth, radii, colour, opacity,
# tiles), and added by it (their gradients). The CPU's were measured with bench rasterizers.
RASTERIZER_FLOATS = {"gpu": (16, 12), "cpu": (5, 40)}


@dataclass(frozen=True)
class StepCounts:
    """Work and memory of one optimizer step of one process.

    Attributes:
        trained, frozen: numbers of parameters.
        flops: of all accumulated batches and the optimizer.
        operations: of all accumulated batches, each of which starts a kernel; the optimizer's few are left out.
        memory: bytes at the moment when most are in use, by kind.
        latent_bytes: bytes of one encoded image in a latent cache; None without latents.
    """

    trained: int
    frozen: int
    flops: int
    operations: int
    memory: Mapping[str, int]
    latent_bytes: int | None

    @property
    def peak(self) -> int:
        """Return the bytes of all kinds together."""
        return sum(self.memory.values())


class Unfilled(TorchFunctionMode):
    """Mode in which modules are built without initial weights; samplers, which read values, read ones."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if getattr(func, "__module__", None) == "torch.nn.init":
            return args[0] if args else kwargs["tensor"]
        return 1.0 if func is Tensor.item else func(*args, **(kwargs or {}))


def normalize_in_float32(module: nn.Module) -> None:
    """Make normalisations compute in float32 under autocast, as on GPUs, where they store more for the backward pass.

    Fake tensors are on the CPU, whose autocast leaves normalisations in bfloat16. See "CUDA Ops that can autocast to
    float32" in torch's documentation.
    """

    def cast(_: nn.Module, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...] | None:
        return tuple(x.float() for x in inputs) if torch.is_autocast_enabled("cpu") else None

    for part in module.modules():
        if isinstance(part, nn.GroupNorm | nn.LayerNorm):
            part.register_forward_pre_hook(cast)


class LiveMemory(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Mode that counts the bytes of all tensors that are alive, storages once, their maximum, and operations."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.bytes = self.peak = self.operations = 0
        self.known: weakref.WeakSet[Any] = weakref.WeakSet()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        results = func(*args, **(kwargs or {}))
        self.operations += func.namespace == "aten" and not func.is_view and "empty" not in func.name()
        for tensor in tree_leaves(results):
            if isinstance(tensor, Tensor) and (storage := tensor.untyped_storage()) not in self.known:
                self.known.add(storage)
                self.bytes += storage.nbytes()
                weakref.finalize(storage, self._free, storage.nbytes())
        self.peak = max(self.peak, self.bytes)
        return results

    def _free(self, size: int) -> None:
        self.bytes -= size

    def peak_since(self) -> int:
        """Return the maximum since the last call."""
        peak, self.peak = self.peak, self.bytes
        return peak


class _Store(torch.autograd.Function):
    """Images of the right shape, and the memory of a rasterizer's two passes."""

    @staticmethod
    def forward(ctx: Any, floats: tuple[int, int], cameras: Cameras, *gaussians: Tensor) -> Tensor:
        new, views = gaussians[0].new_empty, cameras.world_to_camera.shape[1]
        shape = (len(gaussians[0]), views, gaussians[0].shape[1])
        image = new(len(gaussians[0]), views, 5, *cameras.image_size)
        ctx.shape, ctx.added = shape, floats[1]
        ctx.save_for_backward(*gaussians, new(*shape, floats[0]), image)
        return image.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        added = gradients[0].new_empty(*ctx.shape, ctx.added)
        results = [torch.empty_like(tensor) for tensor in ctx.saved_tensors[:5]]
        del added
        return None, None, *results


class StoreOnly:
    """Rasterizer that takes the memory of the `cuda` backend on a GPU, or of `tiled`, and draws nothing."""

    def __init__(self, gpu: bool) -> None:
        self.floats = RASTERIZER_FLOATS["gpu" if gpu else "cpu"]

    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Return empty images of scenes [batch] from cameras [batch view]."""
        image = _Store.apply(self.floats, cameras, *vars(gaussians).values())  # type: ignore[no-untyped-call]
        return Rendering(image[:, :, :3], image[:, :, 3:4], image[:, :, 4:])


def count_step(
    build: Callable[[], Stage],
    image_size: int,
    batch: int,
    targets: int,
    precision: str,
    accumulated: int = 1,
    averaged: bool = False,
    distributed: bool = False,
    cached: bool = False,
    gpu: bool = True,
) -> StepCounts:
    """Count a step; a network of any size takes little memory and some seconds.

    Raises CompleteSplatError if a step has no loss, or decides by the values of tensors.

    Args:
        build: makes the module, whose rasterizer should be `StoreOnly`, without reading weights.
        image_size: side of the images in pixels.
        batch, targets: number of scenes of a batch of this process, and of target views of each.
        precision: precision in Lightning's notation.
        accumulated: number of batches of a step.
        averaged: whether a callback averages the weights.
        distributed: whether several processes share the step, so that each has a second copy of the gradients.
        cached: whether the batch has latents instead of images.
        gpu: whether to store what autocast stores on a GPU.
    """
    live, counter = LiveMemory(), flop_counter.FlopCounterMode(display=False, custom_mapping=ATTENTION)
    with fake_tensors(), live:
        with Unfilled():
            module = build()
        if gpu:
            normalize_in_float32(module)
        weights = live.bytes
        scenes = synthetic_batch(image_size, batch, targets)
        encoded = encode(module, scenes) if isinstance(module, LatentDiffusion) else None
        training, inputs = Training(module, precision), encoded if cached and encoded else scenes
        if isinstance(module, ReconstructionModule):
            module.draw_others = lambda targets: targets - 1  # type: ignore[method-assign]
        del scenes
        before, first = live.bytes, live.operations
        live.peak_since()
        with counter:
            loss = training.loss(inputs)
            if not isinstance(loss, Tensor):
                raise CompleteSplatError(
                    f"{type(module).__name__} has no loss in its steps: plan counts trained networks"
                )
            forward, kept = live.peak_since(), live.bytes - before
            torch.autograd.backward([loss])
            backward, flops, operations = live.peak_since(), counter.get_total_flops(), live.operations - first
            training.update()
        trained = [p for p in module.parameters() if p.requires_grad]
        states = [x for state in training.optimizer.state.values() for x in tree_leaves(state) if torch.is_tensor(x)]
        gradients, state = size_of(p.grad for p in trained if p.grad is not None), size_of(states)
        memory = {"weights": weights, "gradients": gradients, "optimizer": state}
        memory["averages"] = size_of([*module.parameters(), *module.buffers()]) if averaged else 0
        memory["copies for ddp"] = gradients if distributed else 0
        memory |= {"batch": before - weights, "activations": kept}
        # Gradients of the last step are alive during the forward pass: Lightning removes them before the backward pass.
        peak = max(forward + gradients + state, backward + state, live.peak_since())
        known = sum(memory.values()) - memory["averages"] - memory["copies for ddp"]
        memory["intermediate results"] = peak - known
        numbers = [sum(p.numel() for p in some) for some in (trained, module.parameters())]
        latent_bytes = None if encoded is None else row_bytes(encoded, module)
        flops = flops * (accumulated - 1) + counter.get_total_flops()
        return StepCounts(numbers[0], numbers[1] - numbers[0], flops, operations * accumulated, memory, latent_bytes)


@contextmanager
def fake_tensors() -> Iterator[None]:
    """Make fake tensors only, and leave none in the package's caches."""
    blur_matrix.cache_clear()
    try:
        with FakeTensorMode():
            yield
    except DataDependentOutputException as error:
        message = "a step decides by the values of tensors, which plan does not compute"
        raise CompleteSplatError(f"{message} ({error.func}): this model cannot be planned") from error
    finally:
        blur_matrix.cache_clear()


def size_of(tensors: Iterable[Tensor]) -> int:
    """Return the bytes of tensors."""
    return sum(tensor.nbytes for tensor in tensors)


@torch.no_grad()
def encode(module: LatentDiffusion, scenes: SceneBatch) -> CachedScene:
    """Return the scenes as a latent cache would give them."""
    parts, images = module.completesplat, scenes.reference.images
    latent = torch.zeros_like(module.inputs(scenes)[0])
    condition = parts.conditioning(images) if parts.conditioning.frozen else images
    return CachedScene(latent, latent.clone(), condition, scenes.reference_frame, scenes.names)


def row_bytes(encoded: CachedScene, module: Stage) -> int:
    """Return the bytes of one image in a latent cache in float32, where images have a byte for each value."""
    moments = encoded.mean[0].numel() + encoded.log_variance[0].numel()
    of_value = 4 if isinstance(module, LatentDiffusion) and module.completesplat.conditioning.frozen else 1
    return 4 * moments + of_value * encoded.condition[0].numel() + 4  # and a checksum
