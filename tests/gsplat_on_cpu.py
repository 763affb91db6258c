"""Stand-ins on the CPU for two parts of gsplat's torch version of its rasterizer.

gsplat 1.5.3 has torch versions of its kernels for its tests (`gsplat/cuda/_torch_impl.py`). In `_rasterize_to_pixels`
the pairs of Gaussians and pixels need a CUDA operator, and the weights along rays need nerfacc.
"""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int, Integer
from torch import Tensor

from completesplat.rasterizers import RenderingConstants

TILE_SIZE = 16  # px
BUDGET = 2**20  # pairs of Gaussians and pixels that are examined at once


@torch.no_grad()
def pairs(
    centers: Float[Tensor, "splat 2"],
    conics: Float[Tensor, "splat 3"],
    opacities: Float[Tensor, " splat"],
    indices: Integer[Tensor, " entry"],
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
        deltas = torch.stack([x, y], dim=-1)[:, :, None] + 0.5 - centers[numbers][:, None]
        alphas = _alphas(deltas, conics[numbers][:, None], opacities[numbers][:, None], constants)
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
