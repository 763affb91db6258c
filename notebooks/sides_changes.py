"""Changes of stage 1 and stage 2 that `sides_study.py` measures (experiments.md, "Sides and backs")."""

from dataclasses import replace
from itertools import pairwise

import torch
from torch import nn

from completesplat.autoreconstructor.view_encoders import sweep
from completesplat.losses.terms import Silhouettes
from completesplat.splatter_image import zeroed

# Changes of stage 1. Each is made to the module before training, when it has the weights to start from.


def unchanged(module, steps):
    """Change nothing."""


def silhouettes(module, steps):
    """Draw the object's own Gaussians against the masks, which are exact (the term that loss=things has)."""
    module.loss.terms["silhouettes"] = {"weight": 0.2, "term": Silhouettes(module.rasterizer)}


def noisy_latents(module, steps):
    """Add noise to half of the latents that the decoder is trained on, of up to half of their standard deviation."""

    def add_noise(reconstructor, inputs):
        latent, *others = inputs
        if not reconstructor.training:
            return None
        share = (torch.rand(len(latent), 1, 1, 1) - 0.5).clamp(min=0)
        return (latent + share * latent.detach().std((0, 2, 3), keepdim=True) * torch.randn(latent.shape), *others)

    module.model.reconstructor.register_forward_pre_hook(add_noise)


class SpreadSweep(nn.Module):
    """Plane sweep that also sees how far the views differ at each depth, which is little on a surface.

    Args:
        trained: the sweep to start from. The new inputs' weights are zero at first.
    """

    def __init__(self, trained):
        super().__init__()
        self.planes = trained.planes
        self.network = trained.network
        self.network.conv_in = with_inputs(self.network.conv_in, 2 * trained.planes)

    def forward(self, views, depth_range):
        """Return what to add to the moments, as `PlaneSweep` does."""
        with torch.autocast(views.images.device.type, enabled=False):
            swept = sweep(views, depth_range, self.planes)
            squares = sweep(replace(views, images=views.images.square()), depth_range, self.planes)
            colors = (swept[:, :, :, :3] + 1) / 2
            variance = (squares[:, :, :, :3] + 1) / 2 - colors.square()
            seen = swept[:, :, :, 3:] != 0
            spread = 4 * variance.clamp(min=0).mean(3, keepdim=True).sqrt() * seen
        reference = nn.functional.avg_pool2d(views.images[:, 0], 2) * 2 - 1
        return self.network(torch.cat([reference, swept.flatten(1, 3), spread.flatten(1, 3)], 1)).float()


def spread_of_views(module, steps):
    """Give the plane sweep the spread of the views beside their mean."""
    module.model.view_encoder = SpreadSweep(module.model.view_encoder)


@torch.no_grad()
def with_inputs(convolution, count, before=None):
    """Return a convolution with further inputs of weight zero, after the others or from the input `before` on."""
    weight = convolution.weight
    before = weight.shape[1] if before is None else before
    settings = {"kernel_size": convolution.kernel_size, "padding": convolution.padding}
    wider = zeroed(nn.Conv2d(weight.shape[1] + count, weight.shape[0], **settings))
    wider.weight[:, :before] = weight[:, :before]
    wider.weight[:, before + count :] = weight[:, before:]
    wider.bias.copy_(convolution.bias)
    return wider


@torch.no_grad()
def eight_channels(module, steps):
    """Give the latent four more channels. They get random features at first, which the decoder does not use."""
    model, old = module.model, 4
    encoder, decoder, views = model.encoder, model.reconstructor, model.view_encoder
    last = encoder.network.conv_out
    wider = nn.Conv2d(last.weight.shape[1], 4 * old, 3, padding=1)
    wider.weight[: 2 * old], wider.bias[: 2 * old] = last.weight, last.bias
    encoder.network.conv_out = wider
    quant = zeroed(nn.Conv2d(4 * old, 4 * old, 1))
    mean_rows, variance_rows = slice(0, old), slice(2 * old, 3 * old)
    for rows, source in ((mean_rows, slice(0, old)), (variance_rows, slice(old, 2 * old))):
        quant.weight[rows, : 2 * old] = encoder.quant_conv.weight[source]
        quant.bias[rows] = encoder.quant_conv.bias[source]
    quant.weight[old : 2 * old, 2 * old : 3 * old, 0, 0] = torch.eye(old)
    quant.bias[3 * old :] = -4
    encoder.quant_conv = quant
    last = views.network.conv_out
    wider = nn.Conv2d(last.weight.shape[1], 4 * old, 3, padding=1)
    wider.weight[mean_rows], wider.bias[mean_rows] = last.weight[:old], last.bias[:old]
    wider.weight[variance_rows], wider.bias[variance_rows] = last.weight[old:], last.bias[old:]
    wider.weight[3 * old :], wider.bias[3 * old :] = 0, 0
    views.network.conv_out = wider
    post = zeroed(nn.Conv2d(2 * old, 2 * old, 1))
    post.weight[:old, :old], post.bias[:old] = decoder.post_quant_conv.weight, decoder.post_quant_conv.bias
    post.weight[old:, old:, 0, 0] = torch.eye(old)
    decoder.post_quant_conv = post
    decoder.network.conv_in = with_inputs(decoder.network.conv_in, old)


class Adversary:
    """Patch discriminator of 0.5 M parameters on novel views, trained on the way, with hinge losses.

    Until the step `start` it only learns. From then on its gradient in the images has half the length of that of the
    mean square error.
    """

    def __init__(self, start, module):
        self.start = start
        self.module = module
        widths = (3, 56, 112, 224)
        layers = []
        for inputs, outputs in pairwise(widths):
            stride = 1 if outputs == widths[-1] else 2
            layers += [nn.Conv2d(inputs, outputs, 4, stride, 1), nn.LeakyReLU(0.2)]
        self.network = nn.Sequential(*layers, nn.Conv2d(widths[-1], 1, 4, 1, 1))
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=4e-4, betas=(0.5, 0.9))

    def __call__(self, prediction, truth):
        """Train the discriminator, and return the weighted loss of the images, or 0 before the start."""
        drawn = prediction.images[:, 1:].flatten(0, 1)
        true = truth.images[:, 1:].flatten(0, 1)
        with torch.enable_grad():
            scores = self.network(torch.cat([drawn.detach(), true]))
            fake, real = scores.chunk(2)
            loss = (1 + fake).relu().mean() + (1 - real).relu().mean()
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
        if self.module.global_step < self.start:
            return drawn.new_zeros(())
        deceived = -self.network(drawn).mean()
        (gradient,) = torch.autograd.grad(deceived, drawn, retain_graph=True)
        squares = 2 * 0.8 * (drawn - true).detach() / prediction.images.numel()
        return deceived * (0.5 * squares.norm() / gradient.norm().clamp(min=1e-12))


def patch_discriminator(module, steps):
    """Train a patch discriminator in the second half, and the decoder alone with it in the last quarter."""
    start = steps - steps // 4
    adversary = Adversary(start, module)
    module.loss.terms["adversary"] = {"weight": 1.0, "term": adversary, "start_step": steps // 2}

    def detach(reconstructor, inputs):
        latent, features, *others = inputs
        if module.global_step < start or not reconstructor.training:
            return None
        return (latent.detach(), [feature.detach() for feature in features], *others)

    module.model.reconstructor.register_forward_pre_hook(detach)


# Changes of stage 2.


class FeatureConditioning(nn.Module):
    """Learned conditioning, and beside it the frozen encoder's features of the lowest resolution, in fewer channels."""

    frozen = False

    def __init__(self, learned, encoder, channels=32):
        super().__init__()
        self.learned = learned
        self.encoder = encoder
        self.levels = len(encoder.network.down_blocks)
        self.narrow = nn.Sequential(nn.GroupNorm(8, 192), nn.Conv2d(192, channels, 1))

    def forward(self, images):
        """Return features of sRGB images in [0, 1], at the latent's resolution."""
        with torch.no_grad():
            features = self.encoder.features(images * 2 - 1, self.levels)[-1]
        return torch.cat([self.learned(images), self.narrow(features)], 1)


def encoder_features(parts):
    """Condition the denoiser on the frozen encoder's features, too; the new inputs' weights are zero at first."""
    parts.conditioning = FeatureConditioning(parts.conditioning, parts.autoreconstructor.encoder)
    network = parts.denoiser.network
    network.conv_in = with_inputs(network.conv_in, 32, before=16)
