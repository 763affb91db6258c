"""Files of weights in the layout of torchvision's VGG16."""

import hashlib
from pathlib import Path

import torch

# torchvision's vgg16: index of each convolution in `features`, with its channels; "M" is a pooling.
CONVOLUTIONS = {0: (3, 64), 2: (64, 64), 5: (64, 128), 7: (128, 128), 10: (128, 256), 12: (256, 256), 14: (256, 256)}
CONVOLUTIONS |= {17: (256, 512), 19: (512, 512), 21: (512, 512), 24: (512, 512), 26: (512, 512), 28: (512, 512)}


def blank() -> dict[str, torch.Tensor]:
    """Weights of the right layout, all views of one zero: a file of a few kB."""
    shapes = {f"features.{i}.weight": (o, c, 3, 3) for i, (c, o) in CONVOLUTIONS.items()}
    shapes |= {f"features.{i}.bias": (o,) for i, (_, o) in CONVOLUTIONS.items()}
    return {name: torch.zeros(()).expand(shape) for name, shape in shapes.items()}


def saved(weights: dict[str, torch.Tensor], path: Path) -> Path:
    torch.save(weights, path)
    return path


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
