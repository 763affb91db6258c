"""U-Net of Splatter Image with its authors' tensor names, so that their weights load.

It is EDM's version of DDPM++ (Karras et al. 2022; Song et al. 2021) without a noise level, implemented anew after
`scene/gaussian_predictor.py` of szymanowiczs/splatter-image at commit 78a6ad0. `regressor.SplatterImageUNet` is a
similar network of diffusers' blocks, for training.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

MULTIPLES = (1, 2, 2, 2)
HALF = math.sqrt(0.5)


def _norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(min(32, channels // 4), channels, eps=1e-6)


class ScaledConvolution(nn.Conv2d):
    """Convolution after doubling ("up"), halving ("down") or keeping ("") the image's size.

    Both resampling filters are a box of two pixels. Published weights contain the filter, so it is a buffer.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, scale: str = "") -> None:
        super().__init__(inputs, outputs, kernel, padding=kernel // 2)
        self.scale = scale
        self.register_buffer("resample_filter", torch.full((1, 1, 2, 2), 0.25) if scale else None)

    def forward(self, x: Tensor) -> Tensor:
        if self.scale == "up":
            x = functional.interpolate(x, scale_factor=2, mode="nearest")
        elif self.scale == "down":
            x = functional.avg_pool2d(x, 2)
        return super().forward(x)


class ResidualBlock(nn.Module):
    """Two convolutions beside a shortcut, then optional attention with one head. Each sum is scaled by sqrt(1/2)."""

    def __init__(self, inputs: int, outputs: int, scale: str = "", attends: bool = False) -> None:
        super().__init__()
        self.inputs = inputs
        self.norm0 = _norm(inputs)
        self.conv0 = ScaledConvolution(inputs, outputs, 3, scale)
        self.norm1 = _norm(outputs)
        self.conv1 = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.dropout = nn.Dropout(0.1)
        self.skip = ScaledConvolution(inputs, outputs, 1, scale) if scale or inputs != outputs else None
        self.attends = attends
        if attends:
            self.norm2 = _norm(outputs)
            self.qkv = nn.Conv2d(outputs, 3 * outputs, 1)
            self.proj = nn.Conv2d(outputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.skip is None else self.skip(x)
        x = self.conv0(functional.silu(self.norm0(x)))
        x = self.conv1(self.dropout(functional.silu(self.norm1(x))))
        x = (x + shortcut) * HALF
        return (x + self.proj(self._attention(x))) * HALF if self.attends else x

    def _attention(self, x: Tensor) -> Tensor:
        # Query, key and value of a channel are next to each other.
        parts = self.qkv(self.norm2(x)).flatten(2).unflatten(1, (-1, 3)).unbind(2)
        # One head has an axis of its own, which the export to ONNX needs.
        attended = functional.scaled_dot_product_attention(*(part.mT[:, None] for part in parts))
        return attended[:, 0].mT.reshape(x.shape)


class SongUNet(nn.Module):
    """U-Net from square images to maps of the same size.

    Args:
        size: side of the images in pixels, a multiple of 8; levels are named after their sizes.
        width: channels of the first level. All others have twice as many.
        blocks: residual blocks per level on the way down. The way up has one more.
        attention: sizes of levels with attention: in every block on the way down, in the last on the way up.
    """

    def __init__(self, size: int, inputs: int, outputs: int, width: int, blocks: int, attention: Sequence[int]) -> None:
        super().__init__()
        self.enc = nn.ModuleDict()
        self.dec = nn.ModuleDict()
        levels = [(f"{size >> level}x{size >> level}", width * multiple) for level, multiple in enumerate(MULTIPLES)]
        attending = [size >> level in attention for level in range(len(MULTIPLES))]
        self.enc[f"{levels[0][0]}_conv"] = nn.Conv2d(inputs, width, 3, padding=1)
        channels = width
        skips = [width]
        for level, (name, outer) in enumerate(levels):
            if level:
                self.enc[f"{name}_down"] = ResidualBlock(channels, channels, "down")
                skips.append(channels)
            for index in range(blocks):
                self.enc[f"{name}_block{index}"] = ResidualBlock(channels, outer, attends=attending[level])
                channels = outer
                skips.append(channels)
        name = levels[-1][0]
        self.dec[f"{name}_in0"] = ResidualBlock(channels, channels, attends=True)
        self.dec[f"{name}_in1"] = ResidualBlock(channels, channels)
        for level in reversed(range(len(levels))):
            name, outer = levels[level]
            if level < len(levels) - 1:
                self.dec[f"{name}_up"] = ResidualBlock(channels, channels, "up")
            for index in range(blocks + 1):
                attends = index == blocks and attending[level]
                self.dec[f"{name}_block{index}"] = ResidualBlock(channels + skips.pop(), outer, attends=attends)
                channels = outer
        self.dec[f"{name}_aux_norm"] = _norm(channels)
        self.dec[f"{name}_aux_conv"] = nn.Conv2d(channels, outputs, 3, padding=1)

    def forward(self, x: Float[Tensor, "batch inputs size size"]) -> Float[Tensor, "batch outputs size size"]:
        skips = []
        for block in self.enc.values():
            x = block(x)
            skips.append(x)
        for name, block in self.dec.items():
            if isinstance(block, ResidualBlock) and block.inputs != x.shape[1]:
                x = torch.cat([x, skips.pop()], dim=1)
            x = block(functional.silu(x) if name.endswith("aux_conv") else x)
        return x
