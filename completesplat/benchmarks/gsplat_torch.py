"""External baseline of the benchmark: gsplat's torch implementation, with replacements for three of its parts.

gsplat 1.5.3 has torch versions of its kernels for its tests (`gsplat/cuda/_torch_impl.py`). Its projection and its
offsets of tiles are called unchanged. This module replaces `_isect_tiles`, because that is a Python loop over single
Gaussians (seconds for a splatter image), and two parts of `_rasterize_to_pixels`, because that needs a CUDA operator
for the pairs of Gaussians and pixels, and nerfacc for the weights along rays.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType

import torch
from jaxtyping import Float, Int, Integer
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rendering, RenderingConstants
from completesplat.tensors import TensorDataclass, stack

TILE_SIZE = 8  # px; a fifth faster on a CPU than gsplat's default of 16
FRUSTUM_MARGIN = 0.3  # in gsplat's `_persp_proj`
BUDGET = 2**20  # pairs of Gaussians and pixels that are examined at once


class GsplatTorchRasterizer:
    """gsplat's rasterizer for float32 tensors on the CPU, which renders all views of a scene together.

    Unlike in the other rasterizers, values that are not finite spread.

    Raises:
        CompleteSplatError: gsplat is not installed, or the frustum margin differs from the one built into gsplat.
    """

    def __init__(self, constants: RenderingConstants | None = None) -> None:
        try:
            from gsplat.cuda import _torch_impl
        except ImportError as error:
            raise CompleteSplatError("gsplat is not installed: pip install gsplat==1.5.3") from error
        self.gsplat: ModuleType = _torch_impl
        self.constants = constants or RenderingConstants()
        if self.constants.frustum_margin != FRUSTUM_MARGIN:
            raise CompleteSplatError(f"gsplat's torch implementation has a frustum_margin of {FRUSTUM_MARGIN} only")

    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render scenes [batch] from cameras [batch view]."""
        return stack([self._render(gaussians[b], cameras[b]) for b in range(cameras.intrinsics.shape[0])])

    def _render(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        (height, width), view = cameras.image_size, cameras.intrinsics.shape[0]
        splats = self._project(gaussians, cameras)
        grid = -(-height // TILE_SIZE), -(-width // TILE_SIZE)
        keys, listed = intersect_tiles(splats, grid, view)
        offsets = self.gsplat._isect_offset_encode(keys, view, grid[1], grid[0]).flatten()
        numbers, pixels = pairs(splats.detach(), listed, offsets, grid, cameras.image_size, self.constants)

        x, y = pixels % width, pixels // width % height
        deltas = torch.stack([x, y], dim=-1) + 0.5 - splats.centers[numbers]
        alphas = _alphas(deltas, splats.conics[numbers], splats.opacities[numbers], self.constants)
        weights = weights_along_rays(alphas, pixels)[:, None]
        image = torch.zeros(view * height * width, 5).index_add(0, pixels, weights * splats.channels[numbers])
        image = image.reshape(view, height, width, 5).permute(0, 3, 1, 2)
        return Rendering(*torch.split(image, [3, 1, 1], dim=1))

    def _project(self, gaussians: Gaussians, cameras: Cameras) -> "_Splats":
        covariances, _ = self.gsplat._quat_scale_to_covar_preci(
            gaussians.quaternions, gaussians.scales, compute_preci=False
        )
        (height, width), view = cameras.image_size, cameras.intrinsics.shape[0]
        radii, centers, depths, conics, _ = self.gsplat._fully_fused_projection(
            gaussians.means,
            covariances,
            cameras.world_to_camera,
            cameras.intrinsics,
            width,
            height,
            eps2d=self.constants.blur,
            near_plane=self.constants.near_plane,
        )
        depths = depths.flatten()
        channels = [gaussians.colors.repeat(view, 1), depths[:, None], torch.ones_like(depths)[:, None]]
        fields = centers.flatten(0, 1), radii.flatten(0, 1), depths, conics.flatten(0, 1)
        return _Splats(*fields, gaussians.opacities.repeat(view), torch.cat(channels, dim=-1))


@dataclass(frozen=True)
class _Splats(TensorDataclass):
    """Gaussians as seen by the cameras, [view gaussian] flattened; `channels` are blended: colour, depth and one."""

    centers: Float[Tensor, "splat 2"]
    radii: Integer[Tensor, "splat 2"]
    depths: Float[Tensor, " splat"]
    conics: Float[Tensor, "splat 3"]
    opacities: Float[Tensor, " splat"]
    channels: Float[Tensor, "splat 5"]


@torch.no_grad()
def intersect_tiles(
    splats: _Splats, grid: tuple[int, int], views: int
) -> tuple[Int[Tensor, " entry"], Int[Tensor, " entry"]]:
    """Replace `_isect_tiles`: return sorted keys (from the highest bit: view, tile, depth) and their splats."""
    rows, columns = grid
    none, limits = torch.tensor([0, 0]), torch.tensor([columns, rows])
    first = ((splats.centers - splats.radii) / TILE_SIZE).floor().long().clamp(none, limits)
    last = ((splats.centers + splats.radii) / TILE_SIZE).ceil().long().clamp(none, limits)
    wide, high = (last - first).unbind(1)
    counts = torch.where((splats.radii > 0).all(1), wide * high, 0)
    listed = torch.repeat_interleave(counts)
    rank = torch.arange(listed.numel()) - (counts.cumsum(0) - counts)[listed]
    x, y = first[listed, 0] + rank % wide[listed], first[listed, 1] + rank // wide[listed]
    view = listed // max(1, splats.depths.numel() // views)
    tile = (view << (rows * columns).bit_length()) | (y * columns + x)
    # Positive floats have the same order as their bits.
    keys, order = ((tile << 32) | splats.depths.view(torch.int32)[listed].long()).sort(stable=True)
    return keys, listed[order]


@torch.no_grad()
def pairs(
    splats: _Splats,
    listed: Int[Tensor, " entry"],
    offsets: Integer[Tensor, " tile"],
    grid: tuple[int, int],
    image_size: tuple[int, int],
    constants: RenderingConstants,
) -> tuple[Int[Tensor, " pair"], Int[Tensor, " pair"]]:
    """Replace `rasterize_to_indices_in_range`: return pairs of a blended splat and its pixel.

    The pairs of a pixel follow each other, front to back. Pixels are numbered [view height width].
    """
    (height, width), (rows, columns) = image_size, grid
    counts = torch.cat([offsets[1:], offsets.new_tensor([listed.numel()])]) - offsets
    inside = torch.arange(TILE_SIZE**2)
    blended = [(listed[:0], listed[:0])]
    for tiles in _chunks(counts):
        rank = torch.arange(int(counts[tiles].max()))
        numbers = listed[(offsets[tiles, None] + rank).clamp(max=listed.numel() - 1)]
        x = (tiles % columns * TILE_SIZE)[:, None] + inside % TILE_SIZE
        y = (tiles // columns % rows * TILE_SIZE)[:, None] + inside // TILE_SIZE
        deltas = torch.stack([x, y], dim=-1)[:, :, None] + 0.5 - splats.centers[numbers][:, None]
        alphas = _alphas(deltas, splats.conics[numbers][:, None], splats.opacities[numbers][:, None], constants)
        drawn = (alphas >= constants.min_alpha) & (rank < counts[tiles, None])[:, None]
        drawn &= ((x < width) & (y < height))[:, :, None]
        after = torch.where(drawn, 1 - alphas, 1).cumprod(-1)
        tile, pixel, entry = (drawn & (after > constants.min_transmittance)).nonzero().unbind(1)
        view = tiles[tile] // (rows * columns)
        blended.append((numbers[tile, entry], (view * height + y[tile, pixel]) * width + x[tile, pixel]))
    return torch.cat([pair[0] for pair in blended]), torch.cat([pair[1] for pair in blended])


def _chunks(counts: Integer[Tensor, " tile"]) -> Iterator[Int[Tensor, " t"]]:
    """Yield groups of tiles with lists of similar lengths, whose padded lists stay within the budget."""
    lengths, order = counts.sort()
    tiles = order[lengths > 0]
    while tiles.numel():
        lengths = counts[tiles]
        size = torch.arange(1, tiles.numel() + 1) * lengths * TILE_SIZE**2
        taken = max(1, int((size <= BUDGET).sum()))
        yield tiles[:taken]
        tiles = tiles[taken:]


def _alphas(
    deltas: Float[Tensor, "*#pair 2"],
    conics: Float[Tensor, "*#pair 3"],
    opacities: Float[Tensor, "*#pair"],
    constants: RenderingConstants,
) -> Float[Tensor, "*pair"]:
    """Return alphas as gsplat's `accumulate` does."""
    (x, y), (xx, xy, yy) = deltas.unbind(-1), conics.unbind(-1)
    sigmas = 0.5 * (xx * x**2 + yy * y**2) + xy * x * y
    return torch.clamp_max(opacities * torch.exp(-sigmas), constants.max_alpha)


def weights_along_rays(alphas: Float[Tensor, " pair"], pixels: Int[Tensor, " pair"]) -> Float[Tensor, " pair"]:
    """Replace nerfacc's `render_weight_from_alpha`: return alpha times the transmittance before it, per pixel.

    Transmittances are differences of one running sum of logarithms, in float64 because the sum spans all pixels.
    """
    logs = torch.log1p(-alphas.double())
    before = logs.cumsum(0) - logs
    starts = torch.ones_like(pixels, dtype=torch.bool)
    starts[1:] = pixels[1:] != pixels[:-1]
    run = starts.cumsum(0) - 1
    return alphas * (before - before[starts][run]).exp().float()
