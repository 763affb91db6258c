"""Supplement's failed "Reconstructor-only without the Encoder": optimised latents (Park et al. 2019, "DeepSDF")."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.errors import CompleteSplatError
from completesplat.splatter_image import SplatterImage

Codes = Float[Tensor, "batch channel latent_height latent_width"]
INITIAL_STD = 0.01
"""Standard deviation of new codes, as in DeepSDF (Section 4.3)."""


class AutoDecoder(nn.Module):
    """Table of the training images' latent codes, and the reconstructor that they share.

    There is no prior on the codes. A code stands for one image with its camera, so colour augmentation and mirroring
    should be off. The table has `rows * latent_channels * (image_size / factor)^2` numbers, where `factor` is the
    reconstructor's enlargement, and thrice as many with Adam's moments.

    Args:
        rows: images that the table has room for. Loading weights resizes the table to theirs.

    Raises:
        CompleteSplatError: the reconstructor has skips, or its levels do not divide the image size.
    """

    def __init__(self, reconstructor: Reconstructor, image_size: int, rows: int = 0) -> None:
        super().__init__()
        factor = 2 ** (len(reconstructor.network.up_blocks) - 1)
        if len(reconstructor.skips) > 0:
            raise CompleteSplatError("a reconstructor without an encoder has no skips: set its skip_levels=[]")
        if image_size % factor:
            raise CompleteSplatError(f"image_size={image_size}: must be a multiple of {factor}")
        self.reconstructor = reconstructor
        self.shape = (reconstructor.post_quant_conv.in_channels, image_size // factor, image_size // factor)
        self.make_room(rows)

    def forward(self, codes: Codes) -> SplatterImage:
        """Reconstruct from codes."""
        return self.reconstructor(codes, ())

    def make_room(self, rows: int) -> None:
        """Replace the table by a new one for this number of images, with all rows free."""
        device = self.reconstructor.post_quant_conv.weight.device
        self.codes = nn.Parameter(INITIAL_STD * torch.randn(rows, *self.shape).to(device))
        self._rows: dict[tuple[str, int], int] = {}

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *others: object) -> None:
        codes = state_dict.get(f"{prefix}codes")
        if codes is not None and len(codes) != len(self.codes):
            self.make_room(len(codes))
        super()._load_from_state_dict(state_dict, prefix, *others)

    def codes_of(self, names: Sequence[str], frames: Int64[Tensor, " batch"]) -> Codes:
        """Return the codes of images, given by sequence and frame.

        Raises:
            CompleteSplatError: the table is full.
        """
        return self.codes[[self._row(*key) for key in zip(names, frames.tolist(), strict=True)]]

    def new_codes(self, count: int, seed: int) -> Codes:
        """Draw random codes that belong to no image yet."""
        generator = torch.Generator().manual_seed(seed)
        return INITIAL_STD * torch.randn(count, *self.shape, generator=generator).to(self.codes.device)

    def _row(self, name: str, frame: int) -> int:
        if (name, frame) not in self._rows and len(self._rows) == len(self.codes):
            raise CompleteSplatError(f"all {len(self.codes)} codes are taken: this is an image of another data set")
        return self._rows.setdefault((name, frame), len(self._rows))

    def get_extra_state(self) -> list[list[str | int]]:
        """Return the sequence and frame of each taken row, in order, in plain containers for checkpoints."""
        return [[name, frame] for name, frame in self._rows]

    def set_extra_state(self, state: Any) -> None:
        """Restore the rows of a checkpoint."""
        self._rows = {(name, frame): row for row, (name, frame) in enumerate(state)}


def optimize_codes(codes: Codes, loss: Callable[[Tensor], Float[Tensor, ""]], steps: int, rate: float) -> Codes:
    """Minimise a loss over the codes with Adam, whose rate falls to a tenth halfway (DeepSDF's `reconstruct.py`).

    This also works where autograd is off, as in `torch.inference_mode()`. Only the codes get gradients.
    """
    with torch.inference_mode(False), torch.enable_grad():
        codes = codes.clone().requires_grad_()
        optimizer = torch.optim.Adam([codes], lr=rate)
        for step in range(steps):
            optimizer.param_groups[0]["lr"] = rate if 2 * step < steps else 0.1 * rate
            (codes.grad,) = torch.autograd.grad(loss(codes), codes)
            optimizer.step()
        return codes.detach()
