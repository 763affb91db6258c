"""Each rasterizer against a picture that can be worked out by hand."""

import math

import torch

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers.protocol import Rasterizer, RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.selection import FASTER, TOLERANCE, failure
from completesplat.reports.doctor.finding import Finding

PART = "rasterizers"
GOOD = "a test rendering is as it should be"


def check() -> list[Finding]:
    """The backends, fastest first. The last one, which needs torch alone, must work; the others need not."""
    found = []
    for name, make in FASTER.items():
        reason = failure(name, None) or wrong(make(None))
        found.append(Finding(PART, name, "no" if reason else "yes", reason or GOOD))
    reason = wrong(ReferenceRasterizer())
    faster = any(finding.state == "yes" for finding in found)
    said = reason or (GOOD if faster else f"{GOOD}; with nothing else, predictions are very slow")
    return [*found, Finding(PART, "reference", "broken" if reason else "yes", said)]


@torch.no_grad()
def wrong(rasterizer: Rasterizer) -> str | None:
    """What is wrong with the picture of two round Gaussians, one behind the other on the optical axis; None if nothing.

    With focal length f, a Gaussian of size s at depth z is a disc of variance (f s / z)^2 and the blur's, in px^2: its
    alpha is its opacity in the middle, and exp(-1 / (2 variance)) of that one pixel aside. The front one covers the
    other (gsplat's conventions, see `completesplat.rasterizers`).
    """
    focal, depths, sizes, opacities = 40.0, (2.0, 4.0), (0.1, 0.4), (0.8, 0.5)
    colors = torch.tensor([[0.9, 0.5, 0.1], [0.2, 0.4, 1.0]])
    means = torch.tensor([[0.0, 0.0, depth] for depth in depths])
    scales, upright = torch.tensor(sizes)[:, None].expand(2, 3), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    intrinsics = torch.tensor([[focal, 0, 2.5], [0, focal, 2.5], [0, 0, 1]])
    cameras = Cameras(torch.eye(4)[None, None], intrinsics[None, None], (5, 5))
    drawn = rasterizer(Gaussians(means, upright, scales, torch.tensor(opacities), colors)[None], cameras).color[0, 0]
    variances = [(focal * s / z) ** 2 + RenderingConstants().blur for s, z in zip(sizes, depths, strict=True)]
    for aside in (0, 1):
        front, back = (o * math.exp(-(aside**2) / (2 * v)) for o, v in zip(opacities, variances, strict=True))
        true = front * colors[0] + (1 - front) * back * colors[1]
        difference = (drawn[:, 2, 2 + aside] - true).abs().max().item()
        if not difference <= TOLERANCE:  # not-a-number is wrong too
            return f"its test rendering is wrong by {difference:.2g}"
    return None
