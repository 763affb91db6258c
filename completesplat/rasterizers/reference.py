"""Reference backend, which defines the others: dense, differentiable, in plain torch and any floating dtype."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pixel_centers, transform_points
from completesplat.rasterizers import Rendering, RenderingConstants, with_view_colors
from completesplat.tensors import stack

# In px and px^2. Products of two such numbers are still finite in float32.
LARGEST_PROJECTION = 1e15
Alphas = Float[Tensor, "gaussian pixel"]
PAIRS_AT_ONCE = 2**20  # Gaussian-pixel pairs; intermediate results of a few MB each stay in the cache


class ReferenceRasterizer:
    """Rasterizer that evaluates every Gaussian at every pixel, which suits tests and small scenes only.

    Gradients reach all parameters of the Gaussians and the cameras. Gaussians that are culled, not finite, or so
    large or far aside that their projection overflows are left out first, so their gradients are zero.
    """

    def __init__(self, constants: RenderingConstants | None = None) -> None:
        self.constants = constants or RenderingConstants()

    @with_view_colors
    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        batch, view = cameras.world_to_camera.shape[:2]
        scenes = []
        for b in range(batch):
            scenes.append(stack([self._render(gaussians[b], cameras[b, v]) for v in range(view)]))
        return stack(scenes)

    def _render(self, gaussians: Gaussians, camera: Cameras) -> Rendering:
        """Render one scene from one camera.

        The backward pass computes intermediate results again. Memory thus does not grow with the number of pixels, and
        computing results twice in the cache is faster than reading them from memory once.
        """
        visible, depth_order = visible_by_depth(gaussians, camera, self.constants)
        chosen = gaussians[visible][depth_order]
        centers, depths, covariances = project_gaussians(chosen, camera, self.constants)
        values = torch.cat([chosen.colors, depths[:, None], torch.ones_like(depths)[:, None]], dim=-1)
        pixels = pixel_centers(*camera.image_size, gaussians.means.device, gaussians.means.dtype).flatten(0, 1)
        chunks = torch.split(pixels, max(1, PAIRS_AT_ONCE // max(1, chosen.count)))
        inputs = (centers, covariances, chosen.opacities, values)
        columns = torch.cat([checkpoint(self._chunk, chunk, *inputs, use_reentrant=False) for chunk in chunks])
        image = columns.mT.reshape(5, *camera.image_size)
        return Rendering(image[:3], image[3:4], image[4:])

    def _chunk(self, pixels: Tensor, centers: Tensor, covariances: Tensor, opacities: Tensor, values: Tensor) -> Tensor:
        alphas = alphas_at(pixels, centers, covariances, opacities, self.constants)
        return composite(alphas, self.constants).mT @ values


def visible_by_depth(gaussians: Gaussians, camera: Cameras, constants: RenderingConstants) -> tuple[Tensor, Tensor]:
    """Return a mask of the Gaussians that can be drawn, and the order of those by depth (ties keep their order)."""
    with torch.no_grad():
        centers, depths, covariances = project_gaussians(gaussians, camera, constants)
    # Comparisons with NaN are false, so Gaussians whose bad values the projection turned into NaN are left out.
    drawable = (depths > constants.near_plane) & depths.isfinite() & (gaussians.opacities >= constants.min_alpha)
    bounded = torch.cat([centers, covariances.flatten(-2)], dim=-1).abs().le(LARGEST_PROJECTION).all(-1)
    visible = gaussians.finite() & drawable & bounded
    return visible, torch.argsort(depths[visible], stable=True)


def project_gaussians(
    gaussians: Gaussians, camera: Cameras, constants: RenderingConstants
) -> tuple[Float[Tensor, "gaussian 2"], Float[Tensor, " gaussian"], Float[Tensor, "gaussian 2 2"]]:
    """Return centres (px), depths and 2D covariances (px^2) of Gaussians in front of one camera.

    The covariance is J W Sigma W^T J^T (Zwicker et al., "EWA splatting", 2001, Eq. 31) plus the blur.
    """
    points = transform_points(camera.world_to_camera, gaussians.means)
    x, y, z = points.unbind(-1)
    k = camera.intrinsics
    fx = k[0, 0]
    fy = k[1, 1]
    cx = k[0, 2]
    cy = k[1, 2]
    centers = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)

    height, width = camera.image_size
    slope_x = _clamp_slope(x / z, fx, cx, width, constants.frustum_margin)
    slope_y = _clamp_slope(y / z, fy, cy, height, constants.frustum_margin)
    zero = torch.zeros_like(z)
    rows = ([fx / z, zero, -fx * slope_x / z], [zero, fy / z, -fy * slope_y / z])
    jacobian = torch.stack([torch.stack(row, -1) for row in rows], dim=-2)
    to_image = jacobian @ camera.world_to_camera[:3, :3]
    blur = constants.blur * torch.eye(2, dtype=z.dtype, device=z.device)
    return centers, z, to_image @ gaussians.covariances() @ to_image.mT + blur


def _clamp_slope(slope: Tensor, focal: Tensor, principal: Tensor, extent: int, margin: float) -> Tensor:
    """Limit x / z (or y / z) to the frustum with a margin: the Jacobian explodes far outside the image."""
    beyond = margin * 0.5 * extent / focal
    return slope.clamp(min=-principal / focal - beyond, max=(extent - principal) / focal + beyond)


def alphas_at(
    pixels: Float[Tensor, "pixel 2"], centers: Float[Tensor, "gaussian 2"],
    covariances: Float[Tensor, "gaussian 2 2"], opacities: Float[Tensor, " gaussian"], constants: RenderingConstants,
) -> Alphas:  # fmt: skip
    """Return min(max_alpha, opacity * exp(-d^T Sigma^-1 d / 2)) for every pair, zero below min_alpha."""
    a = covariances[:, 0, 0]
    b = covariances[:, 0, 1]
    c = covariances[:, 1, 1]
    # The determinant of M + blur * 1 is at least blur * (trace of M + blur) for a covariance M; the difference of
    # products loses that to rounding when a Gaussian is large and flat.
    determinant = torch.maximum(a * c - b * b, constants.blur * (a + c - constants.blur)).clamp(min=1e-10)
    a, b, c = (t[:, None] for t in (a / determinant, b / determinant, c / determinant))
    dx, dy = (pixels - centers[:, None]).unbind(-1)
    sigma = 0.5 * (c * dx * dx + a * dy * dy) - b * dx * dy
    alpha = (opacities[:, None] * torch.exp(-sigma)).clamp(max=constants.max_alpha)
    return torch.where((alpha >= constants.min_alpha) & (sigma >= 0), alpha, torch.zeros_like(alpha))


def composite(alphas: Alphas, constants: RenderingConstants) -> Alphas:
    """Return the weights alpha_i * prod_{j<i} (1 - alpha_j), front to back, until the transmittance is used up.

    The Gaussian that would bring it to min_transmittance or below has weight 0, as has every one behind it.
    """
    after = torch.cumprod(1 - alphas, dim=0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    return torch.where(after > constants.min_transmittance, alphas * before, torch.zeros_like(alphas))
