"""External baseline of the benchmark: gsplat's torch implementation, with replacements for three of its parts.

gsplat 1.5.3 has torch versions of its kernels for its tests (`gsplat/cuda/_torch_impl.py`). This module calls their
projection and tile offsets unchanged. It replaces `_isect_tiles`, because that loops in Python over single Gaussians
(seconds for a splatter image). It also replaces two parts of `_rasterize_to_pixels`: the pairs of Gaussians and pixels
need a CUDA operator there, and the weights along rays need nerfacc.
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

    Unlike the other rasterizers, this one does not keep non-finite values from spreading.

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
            raise CompleteSplatError(f"frustum_margin: gsplat's torch implementation supports {FRUSTUM_MARGIN} only")

    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render scenes [batch] from cameras [batch view]."""
        return stack([self._render(gaussians[b], cameras[b]) for b in range(cameras.intrinsics.shape[0])])

    def _render(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        (height, width), view = cameras.image_size, cameras.intrinsics.shape[0]
        splats = self._project(gaussians, cameras)
        grid = -(-height // TILE_SIZE), -(-width // TILE_SIZE)
        keys, indices = intersect_tiles(splats, grid, view)
        offsets = self.gsplat._isect_offset_encode(keys, view, grid[1], grid[0]).flatten()
        numbers, pixels = pairs(splats.detach(), indices, offsets, grid, cameras.image_size, self.constants)

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
    """Gaussians projected into all views, [view gaussian] flattened; `channels` are colour, depth and one."""

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
    """Replace `_isect_tiles`: return sorted keys (view, tile, depth from the highest bit) and their splat indices."""
    rows, columns = grid
    none, limits = torch.tensor([0, 0]), torch.tensor([columns, rows])
    first = ((splats.centers - splats.radii) / TILE_SIZE).floor().long().clamp(none, limits)
    last = ((splats.centers + splats.radii) / TILE_SIZE).ceil().long().clamp(none, limits)
    wide, high = (last - first).unbind(1)
    counts = torch.where((splats.radii > 0).all(1), wide * high, 0)
    indices = torch.repeat_interleave(counts)
    rank = torch.arange(indices.numel()) - (counts.cumsum(0) - counts)[indices]
    x, y = first[indices, 0] + rank % wide[indices], first[indices, 1] + rank // wide[indices]
    view = indices // max(1, splats.depths.numel() // views)
    tile = (view << (rows * columns).bit_length()) | (y * columns + x)
    # Positive floats have the same order as their bits.
    keys, order = ((tile << 32) | splats.depths.view(torch.int32)[indices].long()).sort(stable=True)
    return keys, indices[order]


@torch.no_grad()
def pairs(
    splats: _Splats,
    indices: Int[Tensor, " entry"],
    offsets: Integer[Tensor, " tile"],
    grid: tuple[int, int],
    image_size: tuple[int, int],
    constants: RenderingConstants,
) -> tuple[Int[Tensor, " pair"], Int[Tensor, " pair"]]:
    """Replace `rasterize_to_indices_in_range`: return indices of blended splats and the pixels that they cover.

    The pairs of one pixel are adjacent, front to back. Pixels are numbered in the order [view height width].
    """
    (height, width), (rows, columns) = image_size, grid
    counts = torch.cat([offsets[1:], offsets.new_tensor([indices.numel()])]) - offsets
    inside = torch.arange(TILE_SIZE**2)
    blended = [(indices[:0], indices[:0])]
    for tiles in _chunks(counts):
        rank = torch.arange(int(counts[tiles].max()))
        numbers = indices[(offsets[tiles, None] + rank).clamp(max=indices.numel() - 1)]
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
    """Yield groups of tiles with lists of similar lengths, so that the padded lists stay within the budget."""
    lengths, order = counts.sort()
    tiles = order[lengths > 0]
    while tiles.numel():
        lengths = counts[tiles]
        size = torch.arange(1, tiles.numel() + 1) * lengths * TILE_SIZE**2
        count = max(1, int((size <= BUDGET).sum()))
        yield tiles[:count]
        tiles = tiles[count:]


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
    """Replace nerfacc's `render_weight_from_alpha`: return each alpha times the transmittance in front of it.

    Transmittances come from one running sum of logarithms, which is in float64 because it spans all pixels.
    """
    logs = torch.log1p(-alphas.double())
    before = logs.cumsum(0) - logs
    starts = torch.ones_like(pixels, dtype=torch.bool)
    starts[1:] = pixels[1:] != pixels[:-1]
    run = starts.cumsum(0) - 1
    return alphas * (before - before[starts][run]).exp().float()
