"""Scene of the viewer's tests: four balls of known colours."""

import torch

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.viewer.sample import Sample

# Of two steps, which draw quickly.
SETTINGS = {
    "samples": 2,
    "skip_weight": 1.0,
    "guidance_weight": 0.0,
    "color_fits": 0,
    "detail": 0,
    "steps": 2,
    "seed": 0,
}
START = SETTINGS | {"crop": "whole", "remove_background": False}  # of the page's controls
BALLS = {
    "red": ((0.0, 0.0, 4.0), (0.9, 0.1, 0.1)),
    "green": ((0.0, -0.8, 4.0), (0.1, 0.8, 0.1)),
    "blue": ((0.8, 0.0, 4.0), (0.1, 0.2, 0.9)),
    "yellow": ((-0.5, 0.7, 5.0), (0.9, 0.9, 0.2)),
}


def balls(points: int = 150, radius: float = 0.25) -> Gaussians:
    """Red in the middle, green above it, blue to its right, yellow below, to the left and behind."""
    draws = torch.Generator().manual_seed(0)
    means, colors = [], []
    for center, color in BALLS.values():
        directions = torch.nn.functional.normalize(torch.randn(points, 3, generator=draws), dim=-1)
        means.append(torch.tensor(center) + radius * directions)
        colors.append(torch.tensor(color).expand(points, 3))
    count = points * len(BALLS)
    quaternions = torch.randn(count, 4, generator=draws)
    scales = 0.03 + 0.05 * torch.rand(count, 3, generator=draws)
    return Gaussians(torch.cat(means), quaternions, scales, torch.full((count,), 0.8), torch.cat(colors))


def reference_camera(fov_degrees: float = 50.0, size: int = 64) -> Cameras:
    return Cameras(torch.eye(4), pinhole(fov_degrees, size), (size, size))


def balls_sample(layers: int = 4) -> Sample:
    """Each ball a layer of its own."""
    return Sample(balls(), layers, reference_camera())
