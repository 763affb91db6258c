"""Small VAEs in diffusers' layout, and models that start from them."""

import torch
from diffusers import AutoencoderKL
from safetensors.torch import load_file, save_file

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.splatter_image import Parameterization

SHAPE = {"channels": (8, 8, 16, 16), "layers_per_block": 1, "norm_groups": 4}
SAFETENSORS, BIN = "diffusion_pytorch_model.safetensors", "diffusion_pytorch_model.bin"


def stable_diffusion_vae(channels=SHAPE["channels"], layers_per_block=1, norm_groups=4, **more) -> AutoencoderKL:
    blocks = {"down_block_types": ("DownEncoderBlock2D",) * 4, "up_block_types": ("UpDecoderBlock2D",) * 4}
    shape = {"block_out_channels": channels, "layers_per_block": layers_per_block, "norm_num_groups": norm_groups}
    return AutoencoderKL(**blocks, **shape, latent_channels=4, **more).eval()


def random_vae() -> AutoencoderKL:
    """A VAE of which no tensor, those of the norms included, has its initial value."""
    torch.manual_seed(1)
    vae = stable_diffusion_vae()
    with torch.no_grad():
        for parameter in vae.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return vae


def build(pretrained=None, **changes) -> VariationalAutoReconstructor:
    torch.manual_seed(0)
    shape = SHAPE | changes
    reconstructor = Reconstructor(Parameterization(), **shape, skip_levels=(0, 1))
    return VariationalAutoReconstructor(Encoder(**shape), reconstructor, pretrained=pretrained).eval()


def rewrite(folder, change):
    weights = load_file(folder / SAFETENSORS)
    change(weights)
    save_file(weights, folder / SAFETENSORS)
