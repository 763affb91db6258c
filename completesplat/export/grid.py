"""Images beside and below one another, as one picture to look at in a notebook."""

import torch
from einops import rearrange
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from completesplat.export.pixels import enlarge, to_bytes


def image_grid(*rows: Float[Tensor, "_ 3 height width"], factor: int = 3) -> Image.Image:
    """Images (sRGB, 0 to 1), each row from the left, white where a row is shorter than the longest.

    Args:
        rows: of images of one size.
        factor: every pixel becomes so many in both directions.

    Raises:
        ValueError: values that are not finite.
    """
    columns = max(len(row) for row in rows)
    filled = [torch.cat([row, torch.ones(columns - len(row), *row.shape[1:]).to(row)]) for row in rows]
    whole = rearrange(torch.stack(filled), "row column rgb height width -> rgb (row height) (column width)")
    return Image.fromarray(to_bytes(enlarge(whole, factor)))
