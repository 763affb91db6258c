"""Baseline of the benchmark: the fastest tile-based CPU rasterizer that we could write with plain torch operations.

It composites dense [tile, entry, pixel] blocks that stay in cache. Exponents, blended colours and the moments of
gradients are matrix products; only a few in-place passes remain. The backward pass is analytic and recomputes the
alphas. Lists are exact and drawn in rounds, so that opaque tiles drop out. Alternatives that we measured: autograd
through padded lists takes 3 to 4 times as long; tiles of 4 x 4 or 8 x 8, rounds of 8, 16 or 64 entries and smaller
chunks are as fast or slower; chunks on two Python threads are slower.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from completesplat.benchmarks.torch_tiles import TILE_HEIGHT, TILE_WIDTH, Splats, TileLists, list_splats, project
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rendering, RenderingConstants

ROUND = 32  # entries of a tile's list that are drawn before a check whether any of its pixels needs more
CHUNK = 2048  # tiles at a time, in blocks of 8 MiB
# The columns of a splat's row: log opacity, root_x, root_y, the coefficients of x^2, x y and y^2, centre x and y,
# rest_y; the blended colour, depth and one; and two more to fill a cache line of 64 bytes.
SHAPE, BLENDED, ROW = slice(0, 9), slice(9, 14), 16


class TorchTiledRasterizer:
    """Rasterizer like `ReferenceRasterizer`, for float32 tensors on the CPU; gradients reach the cameras too."""

    def __init__(self, constants: RenderingConstants | None = None) -> None:
        self.constants = constants or RenderingConstants()

    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render scenes [batch] from cameras [batch view]."""
        batch, view = cameras.intrinsics.shape[:2]
        height, width = cameras.image_size
        splats = project(gaussians, cameras, self.constants)
        lists = list_splats(splats, batch * view, cameras.image_size, self.constants)
        rows, columns = lists.grid
        tiles = _Composite.apply(*vars(splats).values(), lists, self.constants)  # type: ignore[no-untyped-call]
        tiles = tiles.reshape(batch, view, rows, columns, 5, TILE_HEIGHT, TILE_WIDTH).permute(0, 1, 4, 2, 5, 3, 6)
        image = tiles.reshape(batch, view, 5, rows * TILE_HEIGHT, columns * TILE_WIDTH)[..., :height, :width]
        return Rendering(*torch.split(image, [3, 1, 1], dim=2))


@dataclass(frozen=True)
class _Board:
    """Tensors that both passes read."""

    rows: Float[Tensor, "splat 16"]
    windows: Int[Tensor, "start entry"]
    """The splats of a round, for each place in the lists where it may start."""
    starts: Int[Tensor, " tile"]
    lengths: Int[Tensor, " tile"]
    centers: Float[Tensor, "tile 2"]
    monomials: Float[Tensor, "6 pixel"]
    """1, x, y, x^2, x y, y^2 of a tile's pixel centres about its own centre."""
    constants: RenderingConstants
    clamped: bool
    """Whether any alpha may exceed max_alpha."""


def _board(splats: Splats, lists: TileLists, constants: RenderingConstants) -> _Board:
    x, y, one = splats.root_x, splats.root_y, torch.ones_like(splats.root_x)
    squares = (-x.square(), -2 * x * y, -y.square() - splats.rest_y)
    shape = (splats.log_opacities, x, y, *squares, splats.center_x, splats.center_y, splats.rest_y)
    starts = torch.cat([lists.ends.new_zeros(1), lists.ends[:-1]])
    return _Board(
        rows=torch.stack([*shape, *splats.colors, splats.depths, one, one, one], dim=-1),
        windows=torch.cat([lists.splats, lists.splats.new_zeros(ROUND)]).unfold(0, ROUND, 1),
        starts=starts,
        lengths=lists.ends - starts,
        centers=lists.centers(),
        monomials=_monomials(),
        constants=constants,
        clamped=bool((splats.log_opacities > math.log2(constants.max_alpha)).any()),
    )


def _monomials() -> Float[Tensor, "6 pixel"]:
    rows, columns = torch.arange(TILE_HEIGHT), torch.arange(TILE_WIDTH)
    y, x = torch.meshgrid(rows - (TILE_HEIGHT - 1) / 2, columns - (TILE_WIDTH - 1) / 2, indexing="ij")
    x, y = x.flatten(), y.flatten()
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


class _Round:
    """The next entries of some tiles' lists: positions of their splats relative to the tiles' centres, and alphas."""

    def __init__(self, board: _Board, tiles: Int[Tensor, " tile"], step: int) -> None:
        first = board.starts.index_select(0, tiles) + step * ROUND
        self.left = board.lengths.index_select(0, tiles) - step * ROUND
        self.ids = board.windows.index_select(0, first).long()
        rows = board.rows.index_select(0, self.ids.flatten())
        self.blended = rows[:, BLENDED].reshape(*self.ids.shape, -1)
        # A product with the identity is the fastest way to turn columns into contiguous rows.
        fields = torch.mm(torch.eye(ROW)[SHAPE], rows.T).reshape(-1, *self.ids.shape)
        self.root_x, self.root_y, self.rest_y = fields[1].clone(), fields[2].clone(), fields[8]
        self.dx, self.dy = board.centers.index_select(0, tiles).T[:, :, None] - fields[6:8]
        self.root = (self.root_x * self.dx).addcmul_(self.root_y, self.dy)
        self.alphas = self._alphas(board, fields[:6])

    def _alphas(self, board: _Board, fields: Float[Tensor, "6 tile entry"]) -> Float[Tensor, "tile entry pixel"]:
        """Return alphas, with polynomial exponents -(root + root_x x + root_y y)^2 - rest_y (dy + y)^2 + log opacity.

        Cancellation loses nothing, because a splat that reaches a tile is few standard deviations from its centre.
        """
        constant, x, y = fields[:3]
        rest = self.rest_y * self.dy
        constant.addcmul_(self.root, self.root, value=-1).addcmul_(rest, self.dy, value=-1)
        constant.masked_fill_(torch.arange(ROUND) >= self.left[:, None], -math.inf)
        x.mul_(self.root).mul_(-2)
        y.mul_(self.root).add_(rest).mul_(-2)
        alphas = torch.mm(fields.flatten(1).T, board.monomials).exp2_()
        if board.clamped:
            alphas.clamp_(max=board.constants.max_alpha)
        below = float(np.nextafter(np.float32(board.constants.min_alpha), np.float32(0)))
        return torch.threshold_(alphas, below, 0.0).reshape(*self.ids.shape, -1)

    def transmittances(self, first: Float[Tensor, "tile pixel"]) -> Float[Tensor, "tile entry_and_one pixel"]:
        """Return transmittances before each entry, and after the last one."""
        result = first.new_empty(first.shape[0], ROUND + 1, first.shape[1])
        result[:, 0] = first
        steps = result.unbind(1)
        for entry, alpha in enumerate(self.alphas.unbind(1)):
            torch.addcmul(steps[entry], steps[entry], alpha, value=-1, out=steps[entry + 1])
        return result

    def gradients(
        self, board: _Board, d_exponents: Float[Tensor, "tile entry pixel"], out: Float[Tensor, "6 tile entry"]
    ) -> None:
        """Write sums over pixels to `out`, computed from the moments of d_exponents about the tile's centre.

        With g for d_exponents and (dx, dy) and root at the pixels: g, g root dx, g root dy, g dy^2, g root, g dy.
        """
        one, x, y, xx, xy, yy = torch.mm(board.monomials, d_exponents.flatten(0, 1).T).reshape(-1, *self.ids.shape)
        to_opacity, to_root_x, to_root_y, to_rest_y, root, dy = out
        to_opacity.copy_(one)
        torch.mul(self.root, one, out=root).addcmul_(self.root_x, x).addcmul_(self.root_y, y)
        torch.mul(self.root, x, out=to_root_x).addcmul_(self.root_x, xx).addcmul_(self.root_y, xy)
        torch.mul(self.root, y, out=to_root_y).addcmul_(self.root_x, xy).addcmul_(self.root_y, yy)
        to_root_x.addcmul_(self.dx, root)
        to_root_y.addcmul_(self.dy, root)
        torch.addcmul(y, self.dy, one, out=dy)
        torch.addcmul(yy, self.dy, dy + y, out=to_rest_y)


def _keep_where_above(values: Tensor, compared: Tensor, threshold: float) -> Tensor:
    """Zero `values` where `compared` is not above the threshold, in one pass (the kernel of ReLU's backward)."""
    masked: Tensor = torch.ops.aten.threshold_backward.grad_input(values, compared, threshold, grad_input=values)
    return masked


class _Composite(torch.autograd.Function):
    """Map from (fields of the splats, lists, constants) to [tile, (colour, depth, alpha), pixel]."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Float[Tensor, "tile 5 pixel"]:
        board, stop = _board(Splats(*arguments[:-2]), *arguments[-2:]), arguments[-1].min_transmittance
        transmittance = torch.ones(board.lengths.numel(), TILE_HEIGHT * TILE_WIDTH)
        image = torch.zeros(board.lengths.numel(), 5, TILE_HEIGHT * TILE_WIDTH)
        active, step, rounds = board.lengths.nonzero().squeeze(1), 0, []
        while active.numel():
            unfinished = []
            for tiles in torch.split(active, CHUNK):
                entries, before = _Round(board, tiles, step), transmittance.index_select(0, tiles)
                transmittances = entries.transmittances(before)
                weights = entries.alphas.mul_(transmittances[:, :-1])
                _keep_where_above(weights, transmittances[:, 1:], stop)
                image.index_add_(0, tiles, torch.bmm(entries.blended.mT, weights))
                after = torch.threshold(transmittances[:, -1], stop, 0.0)
                transmittance.index_copy_(0, tiles, after)
                unfinished.append(tiles[(entries.left > ROUND) & after.any(1)])
                if any(ctx.needs_input_grad):
                    rounds.append((tiles, step, before))
            active, step = torch.cat(unfinished), step + 1
        ctx.board, ctx.rounds = board, rounds
        return image

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        board, stop, gradient = ctx.board, ctx.board.constants.min_transmittance, gradient.contiguous()
        # The gradient's product with everything behind, as if nothing were in front of that.
        behind = torch.zeros_like(gradient[:, 0])
        sums, rows = torch.zeros_like(board.rows), torch.zeros(CHUNK * ROUND, ROW)
        for tiles, step, before in reversed(ctx.rounds):
            entries, gradients = _Round(board, tiles, step), gradient.index_select(0, tiles)
            transmittances = entries.transmittances(before)
            alphas = _keep_where_above(entries.alphas, transmittances[:, 1:], stop)
            weights = alphas * transmittances[:, :-1]
            products, rest = torch.bmm(entries.blended, gradients), transmittances
            rest[:, -1] = behind.index_select(0, tiles)
            steps, values, factors = rest.unbind(1), products.unbind(1), alphas.unbind(1)
            for entry in reversed(range(ROUND)):
                torch.lerp(steps[entry + 1], values[entry], factors[entry], out=steps[entry])
            behind.index_copy_(0, tiles, steps[0])
            d_exponents = products.sub_(rest[:, 1:]).mul_(weights)
            if board.clamped:
                d_exponents.masked_fill_(alphas >= board.constants.max_alpha, 0.0)
            sums_of_round = torch.empty(10, *entries.ids.shape)
            entries.gradients(board, d_exponents, sums_of_round[:6])
            sums_of_round[6:] = torch.bmm(gradients[:, :4], weights.mT).transpose(0, 1)
            count = entries.ids.numel()
            rows[:count, :10] = sums_of_round.flatten(1).T
            sums.index_add_(0, entries.ids.flatten(), rows[:count])
        return *_to_fields(sums[:, :10].T.contiguous(), board), None, None, None


def _to_fields(sums: Float[Tensor, "10 splat"], board: _Board) -> tuple[Tensor, ...]:
    """Return gradients of the splats' fields in their order, by the chain rule through the exponent."""
    to_opacity, to_root_x, to_root_y, to_rest_y, root, dy = sums[:6] * math.log(2)
    root_x, root_y, rest_y = board.rows[:, 1], board.rows[:, 2], board.rows[:, 8]
    to_center = 2 * root_x * root, 2 * (root_y * root + rest_y * dy)
    return to_opacity, -2 * to_root_x, -2 * to_root_y, -to_rest_y, *to_center, sums[9], sums[6:9]
