"""Where samples stand, and from where the page looks at them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from completesplat.viewer.samples import Sample

GAP = 1.25
NARROWEST_WINDOW = 1.1
SAME = 0.15


@dataclass(frozen=True)
class Framing:
    """One row of samples. A single one is seen exactly as its reference camera sees it.

    Attributes:
        pivots: the point that each sample turns about, before it is moved to its place.
        right: the direction of the row.
        spacing: between neighbours, in scene units: 1.25 times the width of the picture at the pivot.
        position, look_at: of the page's camera.
        fov: vertical, of the page's camera, in radians.
    """

    pivots: list[Float[Tensor, "3"]]
    right: Float[np.ndarray, "3"]
    spacing: float
    position: Float[np.ndarray, "3"]
    look_at: Float[np.ndarray, "3"]
    fov: float

    @property
    def distance(self) -> float:
        """From the camera to what it looks at."""
        return float(np.linalg.norm(self.look_at - self.position))

    def shift(self, index: int) -> Float[np.ndarray, "3"]:
        """How a sample is moved: the row has its middle where the first sample was."""
        return self.right * self.spacing * (index - (len(self.pivots) - 1) / 2)

    def looks_like(self, other: "Framing") -> bool:
        """Whether a camera that was put there may stay: as many samples, about as far away."""
        apart = np.linalg.norm(self.look_at - other.look_at) + np.linalg.norm(self.position - other.position)
        return len(self.pivots) == len(other.pivots) and float(apart) < SAME * other.distance


def framing_of(samples: Sequence[Sample]) -> Framing:
    """The row of these samples, looked at by the first one's reference camera, moved back until all are seen."""
    reference = samples[0].reference
    pivots = [sample.pivot() for sample in samples]
    pose = reference.camera_to_world.cpu().numpy()
    pivot, eye = pivots[0].cpu().numpy(), pose[:3, 3]
    forward, distance = pose[:3, 2], float(np.linalg.norm(pivot - eye))
    height, width = reference.image_size
    tangent = height / 2 / reference.intrinsics[1, 1].item()
    picture = 2 * distance * width / 2 / reference.intrinsics[0, 0].item()
    spacing = GAP * picture
    if len(samples) > 1:
        distance = max(distance, len(samples) * spacing / 2 / (tangent * NARROWEST_WINDOW))
    return Framing(pivots, pose[:3, 0], spacing, pivot - forward * distance, pivot, 2 * math.atan(tangent))
