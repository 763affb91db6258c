"""Denoisers eps_theta(h_t, phi_ref, t): Stable Diffusion's UNet on [conditioning, noisy latent]."""

from collections.abc import Callable
from typing import Any, TypedDict, Unpack

import torch
from diffusers import UNet2DConditionModel, UNet2DModel
from diffusers.models.attention import BasicTransformerBlock
from diffusers.models.attention_processor import Attention, AttnProcessor2_0
from jaxtyping import Float, Int
from torch import Tensor, nn

from completesplat.quantities import Few, Levels, Width, Widths

Latents = Float[Tensor, "batch channel height width"]
Conditioning = Float[Tensor, "batch feature height width"]
Denoise = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Denoiser: (noisy latent, timestep, conditioning) -> predicted noise."""


class Sizes(TypedDict, total=False):
    """Sizes of both denoisers, and whether to save memory (see `TextlessStableDiffusion`)."""

    latent_channels: Width
    conditioning_channels: Width
    channels: Widths
    attention_levels: Levels
    layers_per_block: Few
    norm_groups: Width
    gradient_checkpointing: bool


class ConditionalUNet(nn.Module):
    """Base class of both denoisers: a UNet of diffusers on [conditioning, noisy latent].

    Args:
        kind, attention: diffusers' network, and the name prefix of its blocks with attention.
        attention_settings: further arguments of the network.
    """

    def __init__(
        self,
        kind: Any,
        attention: str,
        attention_settings: dict[str, int],
        latent_channels: int = 4,
        conditioning_channels: int = 4,
        channels: Widths = (320, 640, 1280, 1280),
        attention_levels: Levels = (0, 1, 2),
        layers_per_block: int = 2,
        norm_groups: int = 32,
        gradient_checkpointing: bool = False,
    ) -> None:
        super().__init__()
        self.latent_channels = latent_channels
        prefixes = [attention if level in attention_levels else "" for level in range(len(channels))]
        down = [f"{prefix}DownBlock2D" for prefix in prefixes]
        self.network = kind(
            in_channels=conditioning_channels + latent_channels,
            out_channels=latent_channels,
            block_out_channels=tuple(channels),
            down_block_types=tuple(down),
            up_block_types=tuple(name.replace("Down", "Up") for name in reversed(down)),
            layers_per_block=layers_per_block,
            norm_num_groups=norm_groups,
            **attention_settings,
        )
        if gradient_checkpointing:
            self.network.enable_gradient_checkpointing()

    def forward(self, noisy_latent: Latents, timestep: Int[Tensor, " batch"], conditioning: Conditioning) -> Latents:
        """Predict the noise in h_t (paper, Eq. 3), or another target of training (`objective.target`), in float32."""
        inputs = torch.cat([conditioning, noisy_latent], dim=1)
        return self.network(inputs, timestep, **self.context_of(inputs.shape[0])).sample.float()

    def context_of(self, batch: int) -> dict[str, Tensor]:
        return {}


class ZeroTokenAttention(AttnProcessor2_0):
    """Cross-attention to one token of zeros.

    Without gradients, it computes the same values without queries and keys. In training, queries and keys are computed
    because DDP waits for every weight's gradient, even if it is zero.
    """

    def __call__(
        self, attn: Attention, hidden_states: Tensor, *inputs: Tensor | None, **settings: Tensor | None
    ) -> Tensor:
        """Attend like diffusers' `AttnProcessor2_0`, from and to [batch, place, channel]."""
        if torch.is_grad_enabled():
            return super().__call__(attn, hidden_states, *inputs, **settings)
        return attn.to_out[0](hidden_states.new_zeros(1, 1, attn.inner_dim)).expand_as(hidden_states)


class TextlessStableDiffusion(ConditionalUNet):
    """Stable Diffusion 1's UNet, cross-attention included: 859.5 M parameters with 8 input channels.

    The paper follows Stable Diffusion's denoiser, trained from scratch, and does not say what takes the place of the
    text. Here it is one token of zeros: keys and values have no bias, so cross-attention adds only the bias of its
    output layer, a learned constant. The conditioning is concatenated before the noisy latent, as in Marigold.

    Args:
        heads: attention heads, at every width (diffusers calls their number `attention_head_dim`).
        context_channels: channels of the token (CLIP's in Stable Diffusion 1).
        latent_channels, conditioning_channels: channels of the latent and of phi_ref.
        channels: width of each level.
        attention_levels: levels with self- and cross-attention.
        layers_per_block: residual blocks per level.
        norm_groups: groups of the group normalisation.
        gradient_checkpointing: in training, recompute the blocks' activations in the backward pass, which saves
            memory and costs one more forward pass.
    """

    context: Tensor

    def __init__(self, heads: Width = 8, context_channels: Width = 768, **sizes: Unpack[Sizes]) -> None:
        attention = {"attention_head_dim": heads, "cross_attention_dim": context_channels}
        super().__init__(UNet2DConditionModel, "CrossAttn", attention, **sizes)
        for module in self.network.modules():
            if isinstance(module, BasicTransformerBlock):
                crossing: Any = module.attn2
                crossing.set_processor(ZeroTokenAttention())  # type: ignore[no-untyped-call]
        self.register_buffer("context", torch.zeros(1, 1, context_channels), persistent=False)

    def context_of(self, batch: int) -> dict[str, Tensor]:
        """Return the token of zeros for each latent."""
        return {"encoder_hidden_states": self.context.expand(batch, -1, -1)}


class Denoiser(ConditionalUNet):
    """UNet of Stable Diffusion's blocks without text: its attention is self-attention only.

    This is the other, smaller reading of a denoiser without text: its blocks have neither cross-attention nor the
    feed-forward layers that come with it.

    Args:
        head_channels: channels of one attention head.
        **sizes: see `TextlessStableDiffusion`.
    """

    def __init__(self, head_channels: Width = 40, **sizes: Unpack[Sizes]) -> None:
        super().__init__(UNet2DModel, "Attn", {"attention_head_dim": head_channels}, **sizes)
