"""Which of the surfaces that one camera sees another camera sees too, by true depth."""

from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.geometry.cameras import Cameras, pixel_centers, project, unproject

TOLERANCE = 0.03
"""Of the depth: more is another surface. A pixel of a slanted surface spans less."""


def hidden_from(
    reference: Cameras,
    reference_depth: Float[Tensor, "1 height width"],
    cameras: Cameras,
    depths: Float[Tensor, "view 1 height width"],
) -> tuple[Bool[Tensor, "view height width"], Bool[Tensor, "view height width"]]:
    """Pixels of the cameras' pictures whose surface the reference does not show, and those of which this is known.

    A surface is hidden outside of the reference picture, behind its camera, and behind what it shows there. Unknown is
    what has no depth (0), in its own picture or in the reference's.
    """
    height, width = reference.image_size
    pixels = pixel_centers(height, width, depths.device, depths.dtype).flatten(0, 1)
    points = unproject(cameras, pixels, depths.flatten(1))
    places, ahead = project(reference, points)
    inside = (ahead > 0) & (places >= 0).all(-1) & (places < places.new_tensor([width, height])).all(-1)
    # The furthest of the four pixels around the point: at an edge it may belong to either side.
    corners = places.new_tensor([[0, 0], [0, 1], [1, 0], [1, 1]])
    around = (places - 0.5 + corners[:, None, None]).floor()
    columns, rows = around.nan_to_num().long().unbind(-1)
    shown = reference_depth[0][rows.clamp(0, height - 1), columns.clamp(0, width - 1)]
    hidden = ~inside | (ahead > (1 + TOLERANCE) * shown.amax(0))
    known = (depths.flatten(1) > 0) & (~inside | (shown > 0).all(0))
    return (hidden & known).view(-1, height, width), known.view(-1, height, width)
