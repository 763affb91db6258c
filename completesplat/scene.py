"""Batches of a data module: reference and target images with their cameras, or cached latents."""

from dataclasses import dataclass, replace

from jaxtyping import Float, Int64
from torch import Tensor

from completesplat.geometry.cameras import Cameras
from completesplat.tensors import TensorDataclass, concatenate


@dataclass(frozen=True)
class Views(TensorDataclass):
    """Images (sRGB, 0 to 1), their cameras and foreground probabilities (0 to 1).

    `depths` are true depths along the optical axes in the cameras' units, 0 where unknown; None if not loaded.
    """

    images: Float[Tensor, "*batch 3 height width"]
    cameras: Cameras
    masks: Float[Tensor, "*batch 1 height width"]
    depths: Float[Tensor, "*batch 1 height width"] | None = None


@dataclass(frozen=True)
class SceneBatch(TensorDataclass):
    """Scenes with one reference view and several target views each.

    World coordinates are the reference camera's frame, after scaling; `depth_range` is (near, far) along its
    optical axis in those units. Without a batch axis this is one scene and `names` is a single string.
    `visible` is 1 where the conditioning may see the reference image, 0 within the boxes of masked diffusion.
    `names` are the sequences' names, and `reference_frame` is the reference's index in its sequence. `low_resolution`
    holds the same scenes with the smaller images that the model takes, if its renders are compared with larger ones.
    """

    reference: Views
    targets: Views
    depth_range: Float[Tensor, "*batch 2"]
    visible: Float[Tensor, "*batch 1 height width"]
    reference_frame: Int64[Tensor, "*batch"]
    names: str | tuple[str, ...]
    low_resolution: "SceneBatch | None" = None

    def all_views(self) -> Views:
        """Join reference and targets along one view axis, the reference first: [batch 1+view ...]."""
        axis = self.depth_range.ndim - 1
        parts = [self.reference.map(lambda tensor: tensor.unsqueeze(axis)), self.targets]
        if any(part.depths is None for part in parts):
            parts = [replace(part, depths=None) for part in parts]
        return concatenate(parts, axis)


@dataclass(frozen=True)
class CachedScene(TensorDataclass):
    """Scenes for stage 2 whose reference images were encoded beforehand.

    `mean` and `log_variance` are the autoreconstructor's posterior before scaling. `condition` is the reference
    image (sRGB, 0 to 1; 0 within the boxes of masked diffusion), or the features that a frozen conditioning computes
    from it. `names` and `reference_frame` are as in `SceneBatch`.
    """

    mean: Float[Tensor, "*batch channel height width"]
    log_variance: Float[Tensor, "*batch channel height width"]
    condition: Float[Tensor, "*batch _ _ _"]
    reference_frame: Int64[Tensor, "*batch"]
    names: str | tuple[str, ...]


Batch = SceneBatch | CachedScene
