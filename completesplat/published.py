"""Published weights of another method, which reconstruct one scene from a photo.

Splatter Image (Szymanowicz et al., CVPR 2024) sees an object on a plain background and predicts one Gaussian per pixel.
It draws no samples, so hidden parts are reconstructed as an average.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.baselines.splatter_image.model import PublishedSplatterImage
from completesplat.data.images.photograph import ImageLike, Photograph, read_photograph
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.scene_model import SceneModel, require_one

OBJECT_SHARE = 0.65
"""Share of the image that a cut-out object fills (`gradio_app.py`, `resize_foreground`)."""
PHONE_FOV = 50.0


class PublishedGenerator(SceneModel):
    """Published weights of Splatter Image, as `CompleteSplat.from_pretrained` and `predict` take them.

    Its field of view is that of the training images, or if these have different ones, that of a phone's main camera.
    Its up direction points upwards in the photo. Arguments and errors are those of `PublishedSplatterImage`.

    Attributes:
        said: the method, and the images that it needs.
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
        """Return the network."""
        return self.network

    def read(self, picture: ImageLike, fov_degrees: float | None = None, remove_background: bool = False) -> Photograph:
        """Read an image at the model's size, on the background that the weights know (`read_photograph`).

        If the weights know only one camera, the image counts as that camera's, and a cut-out object is put into the
        middle of the image, as large as in training.

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
        """Return near and far; for weights of captures, around the distance that gives the object its trained size."""
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
        """Return scenes as `OneAnswer.generate`, in the colours that the cameras see; hidden pixels are background."""
        require_one(samples)
        if visible is not None:
            images = images * visible + self.network.background * (1 - visible)
        scenes = self.network(images).splatter_image.gaussians(cameras, depth_range)
        seen: Gaussians = scenes.seen_from(cameras.centers)
        return seen

    def save_pretrained(self, path: Path | str) -> None:
        """Raise WeightsError, because published weights stay in their authors' files."""
        raise WeightsError("published weights are kept as their authors' files: copy these")
