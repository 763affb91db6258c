"""Parameters, operations and memory of one optimizer step, counted on fake tensors, which have shapes but no values.

Each operation has its FLOPs (those of matrix products, convolutions and attention, as in `torch.utils.flop_counter`)
and the bytes that it reads and writes; the rasterizer has its Gaussians. Memory is what is alive at the same time: fake
tensors are freed when real ones would be.
"""

import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

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
from completesplat.rasterizers import Rendering, with_view_colors
from completesplat.scene import Batch, CachedScene, SceneBatch
from completesplat.training.capture_fit import CaptureFit
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.training.stage import Stage
from completesplat.training.steps import Training, synthetic_batch

T = TypeVar("T")
aten = torch.ops.aten
# torch's counter knows the attention kernels of GPUs only.
FORWARD: Any = flop_counter.sdpa_flop_count
BACKWARD: Any = flop_counter.sdpa_backward_flop_count
of_shapes: Any = flop_counter.shape_wrapper
FLOPS: dict[Any, Callable[..., int]] = {
    **flop_counter.flop_registry,
    aten._scaled_dot_product_flash_attention_for_cpu: of_shapes(lambda *shapes, **_: FORWARD(*shapes[:3])),
    aten._scaled_dot_product_flash_attention_for_cpu_backward: of_shapes(lambda *shapes, **_: BACKWARD(*shapes[:4])),
}
# Floats for each Gaussian and view: kept for the backward pass (gsplat: 2D mean, conic, depth, radii, colour, opacity,
# tiles), and added by it (their gradients). The CPU's were measured with bench rasterizers.
RASTERIZER_FLOATS = {"gpu": (16, 12), "cpu": (5, 40)}


class Operation(NamedTuple):
    """FLOPs of an operation of torch, and the bytes of the tensors that it reads and writes."""

    flops: float
    bytes: float


class StepCounts(NamedTuple):
    """Work and memory of one optimizer step of one process.

    Attributes:
        trained, frozen: numbers of parameters.
        forward, backward, update: operations of the passes of one batch, and of the optimizer.
        accumulated: number of batches.
        drawn: Gaussians of a batch, once for each view that they are drawn in.
        memory: bytes at the moment when most are in use, by kind.
        latent_bytes: bytes of one encoded image in a latent cache; None without latents.
    """

    trained: int
    frozen: int
    forward: list[Operation]
    backward: list[Operation]
    update: list[Operation]
    accumulated: int
    drawn: int
    memory: Mapping[str, int]
    latent_bytes: int | None

    @property
    def peak(self) -> int:
        return sum(self.memory.values())

    @property
    def operations(self) -> list[Operation]:
        """Return the operations of all accumulated batches and of the optimizer."""
        return (self.forward + self.backward) * self.accumulated + self.update

    @property
    def flops(self) -> float:
        return sum(operation.flops for operation in self.operations)


class WithoutInitialWeights(TorchFunctionMode):
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


def bytes_moved(arguments: object, results: object) -> int:
    """Return the bytes of all tensors read and written; an operation without results changes what it has read."""
    read, written = (
        [min(x.nbytes, x.untyped_storage().nbytes()) for x in tree_leaves(tree) if isinstance(x, Tensor)]
        for tree in (arguments, results)
    )
    return sum(read) + sum(written or read)


class LiveMemory(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Mode that counts the bytes of all tensors that are alive, storages once, their maximum, and lists operations."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.bytes = self.peak = 0
        self.operations: list[Operation] = []
        self.known: weakref.WeakSet[Any] = weakref.WeakSet()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        results = func(*args, **kwargs)
        if func.namespace == "aten" and not func.is_view and "empty" not in func.name():
            flops = FLOPS[func.overloadpacket](*args, **kwargs, out_val=results) if func.overloadpacket in FLOPS else 0
            self.operations.append(Operation(flops, bytes_moved((args, kwargs), results)))
        for tensor in tree_leaves(results):
            if isinstance(tensor, Tensor) and (storage := tensor.untyped_storage()) not in self.known:
                self.known.add(storage)
                self.bytes += storage.nbytes()
                weakref.finalize(storage, self._free, storage.nbytes())
        self.peak = max(self.peak, self.bytes)
        return results

    def _free(self, size: int) -> None:
        self.bytes -= size

    def during(self, work: Callable[[], T]) -> tuple[T, int, list[Operation]]:
        """Do some work; return its result, the maximum meanwhile, and its operations."""
        self.peak = self.bytes
        self.operations = []
        return work(), self.peak, self.operations


class _Store(torch.autograd.Function):
    """Images of the right shape, and the memory of a rasterizer's two passes."""

    @staticmethod
    def forward(ctx: Any, floats: tuple[int, int], cameras: Cameras, *gaussians: Tensor) -> Tensor:
        new = gaussians[0].new_empty
        views = cameras.world_to_camera.shape[1]
        shape = (len(gaussians[0]), views, gaussians[0].shape[1])
        image = new(*shape[:2], 5, *cameras.image_size)
        ctx.shape = (*shape, floats[1])
        ctx.save_for_backward(*gaussians, new(*shape, floats[0]), image)
        return image.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        added = gradients[0].new_empty(ctx.shape)
        results = [torch.empty_like(tensor) for tensor in ctx.saved_tensors[:5]]
        del added
        return None, None, *results


class MemoryOnlyRasterizer:
    """Rasterizer that takes the memory of the `cuda` backend on a GPU, or of `tiled`, and counts what it draws."""

    def __init__(self, gpu: bool) -> None:
        self.floats = RASTERIZER_FLOATS["gpu" if gpu else "cpu"]
        self.drawn = 0

    @with_view_colors
    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Return empty images of scenes [batch] from cameras [batch view]."""
        self.drawn += gaussians.opacities.numel() * cameras.intrinsics.shape[1]
        image = _Store.apply(self.floats, cameras, *vars(gaussians).values())  # type: ignore[no-untyped-call]
        return Rendering(image[:, :, :3], image[:, :, 3:4], image[:, :, 4:])


def count_step(
    build: Callable[[], Stage],
    image_size: int,
    batch: int,
    targets: int,
    precision: str,
    accumulated: int = 1,
    cached: bool = False,
    gpu: bool = True,
) -> StepCounts:
    """Count a step; a network of any size takes little memory and some seconds.

    Raises CompleteSplatError if nothing is trained, or a step decides by the values of tensors.

    Args:
        build: makes the module, whose rasterizer should be `MemoryOnlyRasterizer`, without reading weights.
        batch, targets: number of scenes of a batch of this process, and of target views of each.
        precision: precision in Lightning's notation.
        accumulated: number of batches of a step.
        cached: whether the batch has latents instead of images.
        gpu: whether to store what autocast stores on a GPU.
    """
    with fake_tensors(), LiveMemory() as live:
        with WithoutInitialWeights():
            module = build()
        if not any(parameter.requires_grad for parameter in module.parameters()):
            raise CompleteSplatError(f"{type(module).__name__} has nothing to train in steps: nothing to plan")
        if isinstance(module, CaptureFit):
            raise CompleteSplatError("CaptureFit fits Gaussians, not a network: nothing to plan")
        if gpu:
            normalize_in_float32(module)
        if isinstance(module, ReconstructionModule):
            module.draw_others = lambda targets: targets - 1  # type: ignore[method-assign]
        weights = live.bytes
        latent_bytes = None
        inputs: Batch = synthetic_batch(image_size, batch, targets)
        if isinstance(module, LatentDiffusion) and isinstance(inputs, SceneBatch):
            encoded = with_latents(module, inputs)  # rows of a cache are in float32 with a checksum, images in bytes
            part = 4 if module.completesplat.conditioning.frozen else 1
            latent_bytes = 8 * encoded.mean[0].numel() + part * encoded.condition[0].numel() + 4
            inputs = encoded if cached else inputs
            del encoded
        (forward, backward, update), memory = _count(Training(module, precision), inputs, live)
        memory = {"weights": weights, **memory, "batch": memory["batch"] - weights}
        trained = sum(p.numel() for p in module.parameters() if p.requires_grad)
        frozen = sum(p.numel() for p in module.parameters()) - trained
        drawn = getattr(module.rasterizer, "drawn", 0)
        return StepCounts(trained, frozen, forward, backward, update, accumulated, drawn, memory, latent_bytes)


def _count(training: Training, inputs: Batch, live: LiveMemory) -> tuple[list[list[Operation]], dict[str, int]]:
    """Return the operations of both passes and the update, and the memory; the weights are part of the batch's."""
    before = live.bytes
    loss, forward, of_forward = live.during(lambda: training.loss(inputs))
    kept = live.bytes - before
    _, backward, of_backward = live.during(lambda: torch.autograd.backward([loss]))
    _, changed, _ = live.during(training.update)  # which also makes the optimizer's state
    _, _, of_update = live.during(training.update)
    gradients = sum(p.grad.nbytes for p in training.module.parameters() if p.grad is not None)
    states = tree_leaves(list(training.optimizer.state.values()))
    state = sum(x.nbytes for x in states if isinstance(x, Tensor))
    # Gradients of the last step are alive during the forward pass: Lightning removes them before the backward pass.
    peak = max(forward + gradients + state, backward + state, changed)
    memory = {"gradients": gradients, "optimizer": state, "batch": before, "activations": kept}
    memory["intermediate results"] = peak - sum(memory.values())
    return [of_forward, of_backward, of_update], memory


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


@torch.no_grad()
def with_latents(module: LatentDiffusion, scenes: SceneBatch) -> CachedScene:
    """Return the scenes as a latent cache would give them."""
    parts = module.completesplat
    images = scenes.reference.images
    latent = torch.zeros_like(module.inputs(scenes)[0])
    condition = parts.conditioning(images) if parts.conditioning.frozen else images
    return CachedScene(latent, latent.clone(), condition, scenes.reference_frame, scenes.names)
