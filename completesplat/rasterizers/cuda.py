"""GPU backend: an adapter for gsplat, which is imported only when a rasterizer is made."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.installation import install_command
from completesplat.rasterizers import Rendering, RenderingConstants, require_float32, with_view_colors
from completesplat.rasterizers.reference import LARGEST_PROJECTION

DEVICE = "cuda"
WARP = 32
# Beyond this depth, the reciprocal of the cubed depth, a factor of gsplat's gradients, underflows float32. At 1e17,
# gradients through the depth image become NaN, because gsplat multiplies coordinates before it divides them.
FARTHEST = 1e12
SMALLEST_BLUR = 1e-5
SMALLEST_NEAR_PLANE = 1e-6
COMPILED = ("max_alpha", "min_alpha", "min_transmittance", "frustum_margin")  # the defaults are those of the kernels


class CudaRasterizer:
    """GPU rasterizer that computes the function of `ReferenceRasterizer` by gsplat's kernels, for float32 tensors.

    Gradients reach all parameters of the Gaussians and the poses of the cameras, not the intrinsics. Their last bits
    change from run to run, because sums have no fixed order. Four things differ from the reference:

    - gsplat takes one opacity for all views of a scene. If a Gaussian's projection may overflow in a view that does
      not cull it at the near plane, the Gaussian is therefore left out of all views of that scene.
    - Gaussians further away than 1e12 are not drawn.
    - An opacity above 1 is cut off at 3.33 standard deviations.
    - gsplat takes the determinant of the projected covariance as a difference in float32. Rounding
      loses it for thin Gaussians with a standard deviation over 1000 px, which can be missing, too thin or too wide.

    Raises:
        CompleteSplatError: no gsplat, no CUDA device, or constants other than those compiled into gsplat; on a call,
            tensors of another dtype or on several devices, or intrinsics that require a gradient.
    """

    def __init__(self, constants: RenderingConstants | None = None) -> None:
        self.constants = constants or RenderingConstants()
        if not torch.cuda.is_available():
            raise CompleteSplatError("the cuda rasterizer needs a CUDA device, and torch finds none")
        try:
            import gsplat
        except ImportError as error:
            message = f"the cuda rasterizer needs gsplat ({error}): {install_command('cuda')}"
            raise CompleteSplatError(message) from error
        for name in COMPILED:
            value = getattr(RenderingConstants, name)
            if not math.isclose(getattr(self.constants, name), value, rel_tol=1e-6):
                raise CompleteSplatError(
                    f"gsplat {gsplat.__version__} is compiled with {name} = {value:g}, not "
                    f"{getattr(self.constants, name):g}: set rasterizer.constants.{name}={value}"
                )
        if not (self.constants.blur >= SMALLEST_BLUR and self.constants.near_plane >= SMALLEST_NEAR_PLANE):
            least = f"a blur of at least {SMALLEST_BLUR} px^2 and a near_plane of at least {SMALLEST_NEAR_PLANE}"
            raise CompleteSplatError(f"the cuda rasterizer needs {least}")
        # gsplat culls depths below its near plane, the reference also those equal to it.
        self._near_plane = float(np.nextafter(np.float32(self.constants.near_plane), np.float32(np.inf)))
        self._rasterization = gsplat.rasterization

    @with_view_colors
    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render scenes [batch] from cameras [batch view].

        CPU tensors are copied to the GPU, and their images back.
        """
        home = gaussians.means.device
        if home.type != DEVICE:
            return self(gaussians.to(DEVICE), cameras.to(DEVICE)).to(home)
        require_float32("cuda", gaussians, cameras, home)
        if torch.is_grad_enabled() and cameras.intrinsics.requires_grad:
            message = "the cuda rasterizer has no gradient to the intrinsics: detach them, or take rasterizer=reference"
            raise CompleteSplatError(message)
        height, width = cameras.image_size
        prepared = padded(gaussians, drawable(gaussians, cameras, self.constants))
        images, alphas, _ = self._rasterization(
            means=prepared.means,
            quats=prepared.quaternions,
            scales=prepared.scales,
            opacities=prepared.opacities,
            colors=prepared.colors,
            viewmats=cameras.world_to_camera,
            Ks=cameras.intrinsics,
            width=width,
            height=height,
            near_plane=self._near_plane,
            far_plane=FARTHEST,
            eps2d=self.constants.blur,
            # Packing gains little, because views see nearly every Gaussian. And gsplat's packed kernels can add the
            # gradients of one scene to another's (https://github.com/nerfstudio-project/gsplat/pull/1059).
            packed=False,
            render_mode="RGB+D",
            rasterize_mode="classic",
        )
        images = images.movedim(-1, -3)
        return Rendering(images[:, :, :3], images[:, :, 3:], alphas.movedim(-1, -3))


@torch.no_grad()
def drawable(gaussians: Gaussians, cameras: Cameras, constants: RenderingConstants) -> Bool[Tensor, "batch gaussian"]:
    """Return a mask of the Gaussians that gsplat may see: finite ones that overflow in no view that can show them.

    gsplat itself culls those that are too transparent, or so far aside that only their centre overflows. Up to
    LARGEST_PROJECTION, radii fit its int32, and products of two variances have a reciprocal in fast arithmetic.
    """
    depths = transform_points(cameras.world_to_camera, gaussians.means[:, None])[..., 2]
    deviations = gaussians.scales.abs().amax(-1)[:, None] * _magnification(cameras, constants)[..., None] / depths
    # Comparisons with NaN are false.
    bounded = (depths <= constants.near_plane) | (deviations.square() <= LARGEST_PROJECTION)
    return gaussians.finite() & bounded.all(1)


def _magnification(cameras: Cameras, constants: RenderingConstants) -> Float[Tensor, "batch view"]:
    """Return an upper bound of the standard deviation (px, in x and y) of a Gaussian of unit scale at unit depth.

    A row of the Jacobian is (f, -f * slope) / depth, and the slope is limited to the frustum with its margin.
    """
    height, width = cameras.image_size
    focal = torch.diagonal(cameras.intrinsics, dim1=-2, dim2=-1)[..., :2]
    principal = cameras.intrinsics[..., :2, 2]
    extent = torch.stack([torch.full_like(focal[..., 0], side) for side in (width, height)], -1)  # without a copy
    slope = (torch.maximum(principal, extent - principal) + constants.frustum_margin * 0.5 * extent) / focal
    return (focal * (1 + slope.square()).sqrt()).amax(-1)


def padded(gaussians: Gaussians, mask: Bool[Tensor, "batch gaussian"]) -> Gaussians:
    """Return Gaussians that are safe for gsplat: unit quaternions, and zeros for those outside of the mask.

    Zero opacity keeps a Gaussian out of the image. Zeros for its other values keep NaN out of the gradients. The
    number of Gaussians is padded to a multiple of 32, at least 32, for two reasons. gsplat fails without Gaussians (a
    division by zero in `ProjectionEWA3DGSFused.cu`). And its backward pass sums over the lanes of a warp that agree in
    the index of the Gaussian or the view, whatever their scene, so no warp may reach into a second scene.
    """
    missing = max(WARP - gaussians.count, -gaussians.count % WARP)

    def clean(tensor: Tensor) -> Tensor:
        channels = tensor.shape[2:]
        values = torch.where(mask.view(*mask.shape, *(1 for _ in channels)), tensor, 0.0)
        zeros = values.new_zeros(len(values), missing, *channels)
        return torch.cat([values, zeros], dim=1)

    cleaned = gaussians.map(clean)
    # Scale components to at most 1 first, because the square of a long quaternion overflows.
    size = cleaned.quaternions.detach().abs().amax(-1, keepdim=True).clamp(min=1)
    return replace(cleaned, quaternions=normalize_quaternion(cleaned.quaternions / size))
