"""Denoisers eps_theta(h_t, phi_ref, t): Stable Diffusion's UNet on [conditioning, noisy latent]."""

from collections.abc import Sequence
from typing import Any

import torch
from diffusers import UNet2DConditionModel, UNet2DModel
from jaxtyping import Float, Int
from torch import Tensor, nn


class TextlessStableDiffusion(nn.Module):
    """Stable Diffusion 1's UNet, cross-attention included: 859.5 M parameters with 8 input channels.

    The paper follows Stable Diffusion's denoiser, trained from scratch, and does not say what takes the place of the
    text. Here it is one token of zeros: keys and values have no bias, so cross-attention adds its output layer's bias,
    a learned constant, and nothing else. The conditioning is concatenated before the noisy latent, as in Marigold.

    Args:
        latent_channels: channels of the latent.
        conditioning_channels: channels of phi_ref.
        channels: width of each level.
        attention_levels: levels with self- and cross-attention.
        layers_per_block: residual blocks per level.
        heads: attention heads, at every width (diffusers calls their number `attention_head_dim`).
        context_channels: channels of the token (CLIP's in Stable Diffusion 1).
        norm_groups: groups of the group normalisation.
        gradient_checkpointing: in training, recompute the blocks' activations in the backward pass: less memory for one
            more forward pass.
    """

    context: Tensor

    def __init__(
        self,
        latent_channels: int = 4,
        conditioning_channels: int = 4,
        channels: Sequence[int] = (320, 640, 1280, 1280),
        attention_levels: Sequence[int] = (0, 1, 2),
        layers_per_block: int = 2,
        heads: int = 8,
        context_channels: int = 768,
        norm_groups: int = 32,
        gradient_checkpointing: bool = False,
    ) -> None:
        super().__init__()
        self.latent_channels = latent_channels
        network: Any = UNet2DConditionModel(  # type: ignore[no-untyped-call]
            in_channels=conditioning_channels + latent_channels,
            out_channels=latent_channels,
            block_out_channels=tuple(channels),
            **_blocks("CrossAttn", len(channels), attention_levels),
            layers_per_block=layers_per_block,
            attention_head_dim=heads,
            cross_attention_dim=context_channels,
            norm_num_groups=norm_groups,
        )
        self.register_buffer("context", torch.zeros(1, 1, context_channels), persistent=False)
        if gradient_checkpointing:
            network.enable_gradient_checkpointing()
        self.network = network

    def forward(
        self,
        noisy_latent: Float[Tensor, "batch channel height width"],
        timestep: Int[Tensor, " batch"],
        conditioning: Float[Tensor, "batch features height width"],
    ) -> Float[Tensor, "batch channel height width"]:
        """Predict the noise in h_t (paper, Eq. 3), or what else it is trained for (`objective.target`), in float32."""
        context = self.context.expand(len(noisy_latent), -1, -1)
        inputs = torch.cat([conditioning, noisy_latent], dim=1)
        sample: Tensor = self.network(inputs, timestep, context).sample
        return sample.float()


class Denoiser(nn.Module):
    """UNet built from Stable Diffusion's blocks, without text: its attention is self-attention only.

    The other reading of a denoiser without text, and the smaller one: blocks without cross-attention (and without the
    feed-forward layers that come with it).

    Args:
        head_channels: channels of one attention head.
        latent_channels, conditioning_channels, channels, attention_levels, layers_per_block, norm_groups,
            gradient_checkpointing: see `TextlessStableDiffusion`.
    """

    def __init__(
        self,
        latent_channels: int = 4,
        conditioning_channels: int = 4,
        channels: Sequence[int] = (320, 640, 1280, 1280),
        attention_levels: Sequence[int] = (0, 1, 2),
        layers_per_block: int = 2,
        head_channels: int = 40,
        norm_groups: int = 32,
        gradient_checkpointing: bool = False,
    ) -> None:
        super().__init__()
        self.latent_channels = latent_channels
        network: Any = UNet2DModel(  # type: ignore[no-untyped-call]
            in_channels=conditioning_channels + latent_channels,
            out_channels=latent_channels,
            block_out_channels=tuple(channels),
            **_blocks("Attn", len(channels), attention_levels),
            layers_per_block=layers_per_block,
            attention_head_dim=head_channels,
            norm_num_groups=norm_groups,
        )
        if gradient_checkpointing:
            network.enable_gradient_checkpointing()
        self.network = network

    def forward(
        self,
        noisy_latent: Float[Tensor, "batch channel height width"],
        timestep: Int[Tensor, " batch"],
        conditioning: Float[Tensor, "batch features height width"],
    ) -> Float[Tensor, "batch channel height width"]:
        """As `TextlessStableDiffusion`."""
        sample: Tensor = self.network(torch.cat([conditioning, noisy_latent], dim=1), timestep).sample
        return sample.float()


def _blocks(attention: str, levels: int, attention_levels: Sequence[int]) -> dict[str, Any]:
    """Names of diffusers' blocks, from full resolution down and up again."""
    down = [f"{attention if level in attention_levels else ''}DownBlock2D" for level in range(levels)]
    up = tuple(name.replace("Down", "Up") for name in reversed(down))
    return {"down_block_types": tuple(down), "up_block_types": up}
