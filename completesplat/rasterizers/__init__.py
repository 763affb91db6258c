"""Interface and shared constants of the swappable rasterizers.

Each backend has a file. Every backend computes the same function, with gsplat's conventions:
alpha = min(max_alpha, opacity * exp(-sigma)), composited from front to back, with the constants of one shared config.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Protocol, TypeVar, cast, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import DirectionalGaussians, Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.tensors import TensorDataclass


@dataclass(frozen=True)
class RenderingConstants:
    """Constants on which all backends agree. The defaults are those compiled into the kernels of gsplat 1.5.

    Attributes:
        blur: added to the diagonal of the projected covariance, in px^2.
        near_plane: Gaussians whose centre is at this depth or nearer are culled, in world units.
        max_alpha: clamp on a Gaussian's alpha at a pixel.
        min_alpha: contributions below it are skipped.
        min_transmittance: a pixel stops before the Gaussian that would bring its transmittance to this or less.
        frustum_margin: the Jacobian is evaluated at a point clamped to this multiple of half the field of view
            beyond the image's border (`_torch_impl.py:105`).
    """

    blur: float = 0.3
    near_plane: float = 0.01
    max_alpha: float = 0.999
    min_alpha: float = 1 / 255
    min_transmittance: float = 1e-4
    frustum_margin: float = 0.3


@dataclass(frozen=True)
class Rendering(TensorDataclass):
    """Rendered views [batch view] without a background: sums weighted by each Gaussian's contribution.

    `depth` is the accumulated depth (gsplat's "D"): divide by alpha for the expected depth.
    """

    color: Float[Tensor, "*batch 3 height width"]
    depth: Float[Tensor, "*batch 1 height width"]
    alpha: Float[Tensor, "*batch 1 height width"]

    def over(
        self, background: Float[Tensor, "*#batch 3 #height #width"] | float
    ) -> Float[Tensor, "*batch 3 height width"]:
        """Composite the rendering over a background colour or image."""
        return self.color + (1 - self.alpha) * background

    def expected_depth(self) -> Float[Tensor, "*batch 1 height width"]:
        """Return the mean depth of what a pixel shows, and 0 where it shows nothing."""
        return self.depth / self.alpha.clamp(min=1e-10)

    def surface_depth(self) -> Float[Tensor, "*batch 1 height width"]:
        """Return the expected depth of pixels that are more than half opaque, and 0 elsewhere (no surface)."""
        return torch.where(self.alpha > 0.5, self.expected_depth(), 0)


@runtime_checkable
class Rasterizer(Protocol):
    """Function that renders a batch of scenes, each from several cameras."""

    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render Gaussians of batch shape [batch] from cameras of batch shape [batch view]."""


Render = TypeVar("Render", bound=Callable[..., Rendering])


def with_view_colors(render: Render) -> Render:
    """Decorate a backend's `__call__`, so that it draws `DirectionalGaussians` in the colours that each camera sees.

    Each view becomes a scene with one camera. Every backend has this decorator.
    """

    @wraps(render)
    def render_view_colors(backend: Rasterizer, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        if not isinstance(gaussians, DirectionalGaussians):
            return render(backend, gaussians, cameras)
        shape = cameras.world_to_camera.shape[:2]
        for_each_view = gaussians.map(lambda values: values.repeat_interleave(shape[1], dim=0))
        single = cameras.map(lambda values: values.flatten(0, 1)[:, None])
        rendering = render(backend, for_each_view.seen_from(cameras.centers.flatten(0, 1)), single)
        return rendering.map(lambda values: values.view(*shape, *values.shape[2:]))

    return cast(Render, render_view_colors)


def require_float32(name: str, gaussians: Gaussians, cameras: Cameras, device: torch.device) -> None:
    """Raise CompleteSplatError, naming the rasterizer, unless all tensors are float32 and on this device."""
    tensors = vars(gaussians) | {"world_to_camera": cameras.world_to_camera, "intrinsics": cameras.intrinsics}
    for key, tensor in tensors.items():
        if tensor.dtype != torch.float32 or tensor.device != device:
            message = f"{key} is {str(tensor.dtype).removeprefix('torch.')} on {tensor.device}"
            raise CompleteSplatError(f"the {name} rasterizer takes float32 tensors on {device}, but {message}")
