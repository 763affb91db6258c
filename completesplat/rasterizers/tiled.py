"""Fast CPU backend: compiled kernels with a hand-written backward pass, float32."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rendering, RenderingConstants, require_float32, with_view_colors
from completesplat.rasterizers.kernels import array_layout as layout
from completesplat.rasterizers.kernels.batch import BatchRendering, Parameters, RenderedImages

WIDTHS: dict[str, list[int]] = {"means": [3], "quaternions": [4], "scales": [3], "opacities": [], "colors": [3]}
SMALLEST_BLUR = 1e-5  # px^2; with it, the reference's clamp on the determinant (1e-10) never applies


class TiledRasterizer:
    """CPU rasterizer that computes the function of `ReferenceRasterizer` in float32, hundreds of times faster.

    Gradients reach all parameters of the Gaussians, not the cameras. Results do not depend on the number of threads
    (`torch.set_num_threads`). The kernels are compiled on first use, which takes some seconds once per machine.

    Raises:
        CompleteSplatError: constants that it does not support; on a call, tensors of another dtype, device or shape, or
            cameras that require a gradient.
    """

    def __init__(self, constants: RenderingConstants | None = None) -> None:
        self.constants = constants or RenderingConstants()
        if not self.constants.blur >= SMALLEST_BLUR:
            raise CompleteSplatError(f"the tiled rasterizer needs a blur of at least {SMALLEST_BLUR} px^2")
        if not (self.constants.near_plane >= 0 and self.constants.min_transmittance >= 0):
            raise CompleteSplatError("the tiled rasterizer needs near_plane and min_transmittance of at least 0")

    @with_view_colors
    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render scenes [batch] from cameras [batch view].

        A GPU's tensors are copied to the CPU, and their images back.
        """
        if gaussians.means.device.type != "cpu":
            return self(gaussians.to("cpu"), cameras.to("cpu")).to(gaussians.means.device)
        _check(gaussians, cameras)
        images = _Rasterize.apply(cameras, self.constants, *vars(gaussians).values())  # type: ignore[no-untyped-call]
        return Rendering(*images)


def _check(gaussians: Gaussians, cameras: Cameras) -> None:
    # The kernels do not check bounds: an array that is too small would be read beyond its end.
    for name, widths in WIDTHS.items():
        shape = [len(cameras.world_to_camera), gaussians.count, *widths]
        actual = list(getattr(gaussians, name).shape)
        if actual != shape:
            raise CompleteSplatError(f"{name} should have the shape {shape}, not {actual}")
    require_float32("tiled", gaussians, cameras, torch.device("cpu"))
    if torch.is_grad_enabled() and (cameras.world_to_camera.requires_grad or cameras.intrinsics.requires_grad):
        message = "the tiled rasterizer has no gradient to the cameras: detach them, or take rasterizer=reference"
        raise CompleteSplatError(message)


def pack_cameras(cameras: Cameras, frustum_margin: float) -> np.ndarray:
    """Return cameras in the layout of the kernels, [batch view 20] float64 (see `kernels/array_layout.py`)."""
    matrices = cameras.world_to_camera.detach().double().numpy()
    intrinsics = cameras.intrinsics.detach().double().numpy()
    packed = np.empty((*matrices.shape[:2], layout.CAMERA_WIDTH))
    packed[..., layout.ROTATION : layout.ROTATION + 9] = matrices[..., :3, :3].reshape(*matrices.shape[:2], 9)
    packed[..., layout.TRANSLATION : layout.TRANSLATION + 3] = matrices[..., :3, 3]
    height, width = cameras.image_size
    for axis, extent in ((0, width), (1, height)):
        focal = intrinsics[..., axis, axis]
        principal = intrinsics[..., axis, 2]
        beyond = frustum_margin * 0.5 * extent / focal
        packed[..., layout.FOCAL_X + axis] = focal
        packed[..., layout.PRINCIPAL_X + axis] = principal
        packed[..., layout.MIN_SLOPE_X + 2 * axis] = -principal / focal - beyond
        packed[..., layout.MAX_SLOPE_X + 2 * axis] = (extent - principal) / focal + beyond
    return packed


class _Rasterize(torch.autograd.Function):
    """Map (cameras, constants, means, quaternions, scales, opacities, colors) to images."""

    @staticmethod
    def forward(ctx: Any, cameras: Cameras, constants: RenderingConstants, *tensors: Tensor) -> tuple[Tensor, ...]:
        parameters = Parameters(*_arrays([tensor.detach().contiguous() for tensor in tensors]))
        packed = pack_cameras(cameras, constants.frustum_margin)
        rendering = BatchRendering(parameters, packed, cameras.image_size, constants, keep=any(ctx.needs_input_grad))
        images = tuple(torch.from_numpy(image) for image in rendering.render())
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors, *images)
        ctx.rendering = rendering
        return images

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *image_gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        images = ctx.saved_tensors[5:]
        filled = []
        for image, gradient in zip(images, image_gradients, strict=True):
            if gradient is None:
                # NumPy's zeros: torch would wake its threads, which then spin on the kernels' cores for a while.
                gradient = torch.from_numpy(np.zeros(image.shape, np.float32))
            filled.append(gradient.contiguous())
        gradients = ctx.rendering.backward(RenderedImages(*_arrays(images)), RenderedImages(*_arrays(filled)))
        return None, None, *(torch.from_numpy(gradient) for gradient in gradients)


def _arrays(tensors: Sequence[Tensor]) -> list[np.ndarray]:
    return [tensor.detach().numpy() for tensor in tensors]
