"""Depth maps as colours, without a plotting library."""

import torch
from jaxtyping import Float
from torch import Tensor

NOTHING = 0.5
# Far to near; lightness rises steadily, so that the picture is also right in grey.
STOPS = [
    [0.05, 0.03, 0.20],
    [0.30, 0.08, 0.45],
    [0.62, 0.18, 0.45],
    [0.90, 0.40, 0.25],
    [0.98, 0.70, 0.20],
    [1.00, 0.98, 0.70],
]


def color_depth(
    depth: Float[Tensor, "*batch 1 height width"],
) -> tuple[Float[Tensor, "*batch 3 height width"], tuple[float, float]]:
    """Colours of depths, linear in inverse depth, far dark and near bright, on one scale for all pictures.

    The scale leaves out the nearest and the farthest 2 % of the pixels, so that stray Gaussians do not flatten the
    rest. A depth of 0 or less, or one that is not finite, means that nothing is seen there: grey.

    Returns:
        The pictures, and the depths at the ends of the scale (0, 0 if nothing is seen at all).
    """
    seen = depth.isfinite() & (depth > 0)
    if not seen.any():
        return torch.full_like(depth, NOTHING).expand(*depth.shape[:-3], 3, *depth.shape[-2:]), (0.0, 0.0)
    ordered = depth[seen].sort().values
    stray = len(ordered) // 50
    near, far = ordered[stray], ordered[-1 - stray]
    inverse = 1 / torch.where(seen, depth, far)
    span = (1 / near - 1 / far).clamp(min=1e-12)
    colors = ramp((inverse - 1 / far) / span)
    return torch.where(seen, colors, NOTHING), (near.item(), far.item())


def ramp(values: Float[Tensor, "*batch 1 height width"]) -> Float[Tensor, "*batch 3 height width"]:
    """Colours of values from 0 (dark) to 1 (bright); beyond these the ends' colours."""
    position = values.clamp(0, 1) * (len(STOPS) - 1)
    stops = torch.tensor(STOPS, dtype=values.dtype, device=values.device)
    lower = position.floor().clamp(max=len(STOPS) - 2)
    index = lower.long().squeeze(-3)
    mix = (position - lower).squeeze(-3)[..., None]
    return torch.lerp(stops[index], stops[index + 1], mix).movedim(-1, -3)
