"""Scenes from photographs by weights that others published: one answer for each.

Splatter Image (Szymanowicz et al., CVPR 2024) sees an object on a plain background and gives one Gaussian a pixel. It
draws nothing: there are no samples, and what is hidden stays an average.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.baselines.published import PublishedSplatterImage
from completesplat.data.pictures.photograph import Photograph, Picture, read_photograph
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.scene_model import SceneModel, require_one

OBJECT_SHARE = 0.65
"""Of the picture that a cut-out object fills (`gradio_app.py`, `resize_foreground`)."""
PHONE_FOV = 50.0


class PublishedGenerator(SceneModel):
    """Published weights of Splatter Image, as `CompleteSplat.from_pretrained` and `predict` take them.

    Its field of view is that of the training's pictures, or where each had its own, that of a phone's main camera; up
    is upwards in the photograph.

    Attributes:
        said: what it is, and which pictures it wants.

    Args, Raises: those of `PublishedSplatterImage`.
    """

    def __init__(self, weights: str) -> None:
        network = PublishedSplatterImage(weights)
        super().__init__({"image_size": network.image_size})
        self.network = network.eval().requires_grad_(False)
        self.fov_degrees.fill_(PHONE_FOV if network.fov_degrees is None else network.fov_degrees)
        color = "white" if network.background else "black"
        self.said = (
            "Splatter Image (Szymanowicz et al., CVPR 2024), another method. It knows objects on "
            f"{color}: give pictures that are transparent or {color} around one, or background=remove"
        )

    @property
    def reconstructing(self) -> PublishedSplatterImage:
        """The network."""
        return self.network

    def read(self, picture: Picture, fov_degrees: float | None = None, remove_background: bool = False) -> Photograph:
        """A picture at the model's size, on the background that the weights know (`read_photograph`).

        Where the weights know one camera, each picture counts as that one's, and a cut-out object is put into its
        middle, as large as in training.

        Raises:
            CompleteSplatError: as `read_photograph`, or a field of view for weights that know one camera.
        """
        known = self.network.fov_degrees
        if known is not None and fov_degrees is not None:
            raise CompleteSplatError(f"fov={fov_degrees:g}: these weights take every picture as of {known:.0f} degrees")
        photograph = read_photograph(
            picture,
            self.image_size,
            fov_degrees,
            PHONE_FOV,
            remove_background,
            self.network.background,
            None if known is None else OBJECT_SHARE,
        )
        return photograph if known is None else replace(photograph, fov_degrees=known, fov_source="default")

    def depth_range_of(self, photograph: Photograph) -> Float[Tensor, "2"]:
        """Near and far; of captures around the distance at which the object has the size of training's."""
        focal_length = self.camera(photograph).intrinsics[0, 0].item()
        distance = self.network.object_distance(photograph.image, focal_length)
        known = torch.tensor([0.0, distance + self.network.depths.far], device=self.up.device)
        return self.network.depths.range(known)

    @torch.no_grad()
    def generate(
        self,
        images: Float[Tensor, "batch 3 height width"],
        cameras: Cameras,
        depth_range: Float[Tensor, "batch 2"],
        samples: int = 1,
        visible: Float[Tensor, "batch 1 height width"] | None = None,
        **settings: Any,
    ) -> Gaussians:
        """As `OneAnswer.generate`, in the colours that the cameras see; what is hidden counts as background."""
        require_one(samples)
        if visible is not None:
            images = images * visible + self.network.background * (1 - visible)
        scenes = self.network(images).splatter_image.gaussians(cameras, depth_range)
        seen: Gaussians = scenes.seen_from(cameras.centers)
        return seen

    def save_pretrained(self, path: Path | str) -> None:
        """`WeightsError`: what others published stays in their files."""
        raise WeightsError("published weights are kept as their authors' files: copy these")
