"""Scenes from photographs by weights that others published: one answer for each, in the place of `CompleteSplat`.

Splatter Image (Szymanowicz et al., CVPR 2024) sees an object on a plain background and gives one Gaussian a pixel. It
draws nothing: there are no samples, and what is hidden stays an average.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.baselines.published import PublishedSplatterImage
from completesplat.data.pictures.photograph import Photograph, read_photograph
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole

OBJECT_SHARE = 0.65
"""Of the picture that a cut-out object fills (`gradio_app.py`, `resize_foreground`)."""
PHONE_FOV = 50.0


class PublishedGenerator(nn.Module):
    """What `predict` and `view` ask of a generator, by published weights of Splatter Image.

    Attributes:
        image_size: side of the square images, in pixels.
        layers: Gaussians of a pixel.
        fov_degrees: of the training's pictures, or where each had its own, of a phone's main camera.
        up: where up is in a scene, which no weights know: upwards in the photograph.

    Args, Raises: those of `PublishedSplatterImage`.
    """

    draws_samples = False
    layers = 1
    fov_degrees: Tensor
    up: Tensor

    def __init__(self, weights: str) -> None:
        super().__init__()
        self.network = PublishedSplatterImage(weights).eval().requires_grad_(False)
        self.image_size = self.network.image_size
        fov = self.network.fov_degrees
        self.register_buffer("fov_degrees", torch.tensor(PHONE_FOV if fov is None else fov))
        self.register_buffer("up", torch.tensor([0.0, -1.0, 0.0]))
        color = "white" if self.network.background else "black"
        self.said = (
            "Splatter Image (Szymanowicz et al., CVPR 2024), another method: one answer, no samples. It knows objects "
            f"on {color}: give pictures that are transparent or {color} around one"
        )

    def read(self, path: Path | str, fov_degrees: float | None = None) -> Photograph:
        """Read a picture at the model's size, transparency laid over the background that the weights know.

        Where the weights know one camera, each picture counts as that one's, and a cut-out object is put into its
        middle, as large as in training.

        Raises:
            CompleteSplatError: as `read_photograph`, or a field of view for weights that know one camera.
        """
        known = self.network.fov_degrees
        if known is not None and fov_degrees is not None:
            raise CompleteSplatError(f"fov={fov_degrees:g}: these weights take every picture as of {known:.0f} degrees")
        share = None if known is None else OBJECT_SHARE
        background = self.network.background
        photograph = read_photograph(Path(path), self.image_size, fov_degrees, PHONE_FOV, background, share)
        return photograph if known is None else replace(photograph, fov_degrees=known, fov_source="default")

    def camera(self, photograph: Photograph) -> Cameras:
        """The camera that took a photograph, at the origin of the world."""
        intrinsics = pinhole(photograph.fov_degrees, self.image_size).to(self.up.device)
        return Cameras(torch.eye(4, device=self.up.device), intrinsics, (self.image_size, self.image_size))

    def depth_range_of(self, photograph: Photograph) -> Float[Tensor, "2"]:
        """Near and far; of captures around the distance at which the object has the size of training's."""
        focal_length = self.camera(photograph).intrinsics[0, 0].item()
        distance = self.network.object_distance(photograph.image, focal_length)
        known = torch.tensor([0.0, distance + self.network.depths.far], device=self.up.device)
        return self.network.depths.range(known)

    @torch.no_grad()
    def forward(self, image: Photograph | Path | str, visible: Tensor | None = None, **_: Any) -> list[Gaussians]:
        """The scene of one photograph, in its camera's frame (+x right, +y down, +z forward), in the colours it sees.

        Raises:
            CompleteSplatError: not a readable image, or something of it is hidden (`visible`).
        """
        if visible is not None:
            raise CompleteSplatError(f"box and mask hide something, and these weights complete nothing: {self.said}")
        photograph = image if isinstance(image, Photograph) else self.read(image)
        camera = self.camera(photograph)
        splatter_image = self.network(photograph.image[None].to(self.up.device)).splatter_image
        scene = splatter_image.gaussians(camera[None], self.depth_range_of(photograph)[None])[0]
        return [scene.seen_from(camera.centers)]
