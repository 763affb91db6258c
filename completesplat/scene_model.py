"""What all models have in common that make scenes of photographs: pictures and cameras in, Gaussians out, files."""

import json
from abc import abstractmethod
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors.torch import save_file
from torch import Tensor, nn

from completesplat.atomic import atomic_path, make_folder, write_text
from completesplat.data.pictures.photograph import Photograph, Picture, picture_features, read_photograph
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, nearest_to_axes, pinhole, transform_points
from completesplat.scene import Views
from completesplat.schema import check_settings
from completesplat.splatter_image import Parameterization
from completesplat.weights import CONFIG_FILE, WEIGHTS_FILE, write_sums


class SceneModel(nn.Module):
    """What makes scenes of photographs: `CompleteSplat`, which draws them, `OneAnswer` and `PublishedGenerator`.

    Args:
        architecture: the configuration, as it is written beside the weights; it has `image_size`.
    """

    fov_degrees: Tensor
    depth_range: Tensor
    up: Tensor

    draws_samples = False
    """Whether it has several answers for one photograph."""

    def __init__(self, architecture: dict[str, Any]) -> None:
        super().__init__()
        self.architecture = architecture
        self.image_size: int = architecture["image_size"]
        # Measured on the training set; they serve photographs of unknown cameras.
        self.register_buffer("fov_degrees", torch.tensor(50.0))
        self.register_buffer("depth_range", torch.tensor([0.5, 5.0]))
        self.register_buffer("up", torch.tensor([0.0, -1.0, 0.0]))

    @property
    @abstractmethod
    def reconstructing(self) -> Any:
        """The network that makes a Splatter Image of a picture, or of several views, without drawing."""

    @abstractmethod
    def generate(self, *inputs: Any, **settings: Any) -> Gaussians:
        """See `CompleteSplat.generate`."""

    @property
    def parameterization(self) -> Parameterization:
        """How the raw values of its Splatter Images are read."""
        found: Parameterization = self.reconstructing.parameterization
        return found

    def forward(
        self, image: Photograph | Picture, visible: Float[Tensor, "1 _ _"] | None = None, **settings: Any
    ) -> list[Gaussians]:
        """Complete scenes from one photograph, in its camera's frame (+x right, +y down, +z forward).

        Args:
            image: a file, a PIL image, an array, a tensor (`read`), or a photograph that was read.
            visible: 0 where it is hidden; see `completesplat.data.pictures.photograph`.
            **settings: `samples`, `skip_weight`, `guidance_weight`, `steps`, `seed`, ...: see `generate`.

        Raises:
            CompleteSplatError: not a readable image, or what `generate` refuses.
        """
        check_settings(self.generate, settings)
        photograph = image if isinstance(image, Photograph) else self.read(image)
        device = self.up.device
        scenes = self.eval().generate(
            photograph.image[None].to(device),
            self.camera(photograph)[None],
            self.depth_range_of(photograph)[None],
            visible=None if visible is None else visible[None].to(device),
            **settings,
        )
        return [scenes[i] for i in range(len(scenes.means))]

    def depth_range_of(self, photograph: Photograph) -> Float[Tensor, "2"]:
        """Near and far of what a photograph shows: those of the training set."""
        return self.depth_range

    @torch.no_grad()
    def reconstruct(self, views: Views) -> Gaussians:
        """The scene that several views show, at the posterior's mean: nothing is drawn.

        Args:
            views: [view ...], the first the reference and its frame the world, in the model's units (`in_own_units`).

        Returns:
            Gaussians in the frame of the first camera.

        Raises:
            WeightsError: the posterior of these weights sees one picture.
        """
        if not getattr(self.reconstructing, "sees_views", False):
            raise WeightsError("these weights reconstruct from one picture: they were trained with posterior=image")
        batch, depth_range = views.to(self.up.device)[None], self.depth_range[None]
        splatter_image = self.eval().reconstructing(batch.images[:, 0], batch, depth_range).splatter_image
        scene: Gaussians = splatter_image.gaussians(batch.cameras[:, 0], depth_range)[0]
        return scene

    def in_own_units(self, cameras: Cameras) -> Cameras:
        """Cameras of any units, in a world that is scaled to what the model knows.

        The point nearest to all optical axes comes to the depth at which untrained Gaussians start
        (`Parameterization.first_depth`), which a data set's objects are meant to lie at.

        Raises:
            CompleteSplatError: axes that are parallel, or meet behind the first camera.
        """
        center = nearest_to_axes(cameras)
        depth = 0.0 if center is None else transform_points(cameras[0].world_to_camera, center[None])[0, 2].item()
        if depth <= 0:
            raise CompleteSplatError("the cameras do not look at one place: where the scene lies cannot be told")
        near, far = self.depth_range.tolist()
        share = self.parameterization.first_depth
        return cameras.scale_world(torch.tensor((near + share * (far - near)) / depth))

    def read(self, picture: Picture, fov_degrees: float | None = None, remove_background: bool = False) -> Photograph:
        """A picture at the model's size (`read_photograph`); an unknown field of view is the training set's."""
        return read_photograph(picture, self.image_size, fov_degrees, self.fov_degrees.item(), remove_background)

    @property
    def knows_hidden(self) -> bool:
        """Whether parts of the pictures were hidden in training; weights that do not say it count as not."""
        return bool(self.architecture.get("training", {}).get("box_masks", 0) > 0)

    def distance(self, photograph: Photograph) -> float | None:
        """How far a photograph lies from the training pictures, in their deviations; None: the weights do not say.

        The root mean square over the `picture_features`: about 1 for a picture of the same kind.
        """
        training = self.architecture.get("training", {})
        if not {"picture_mean", "picture_std"} <= training.keys():
            return None
        mean, deviation = (torch.tensor(training[name]) for name in ("picture_mean", "picture_std"))
        return ((picture_features(photograph.image) - mean) / deviation).square().mean().sqrt().item()

    def camera(self, photograph: Photograph) -> Cameras:
        """The camera that took a photograph, at the origin of the world."""
        device = self.up.device
        intrinsics = pinhole(photograph.fov_degrees, self.image_size).to(device)
        return Cameras(torch.eye(4, device=device), intrinsics, (self.image_size, self.image_size))

    def save_pretrained(self, path: Path | str) -> None:
        """Write `config.json`, `model.safetensors` and their checksums into a folder; fit for the Hugging Face hub.

        Raises: those of `make_folder`.
        """
        folder = Path(path)
        folder.parent.mkdir(parents=True, exist_ok=True)
        make_folder(folder)
        weights = {key: value.contiguous().cpu() for key, value in self.state_dict().items()}
        with atomic_path(folder / WEIGHTS_FILE, size=sum(value.nbytes for value in weights.values())) as temporary:
            save_file(weights, temporary)
        write_text(folder / CONFIG_FILE, json.dumps(self.architecture, indent=2) + "\n")
        write_sums(folder)


def require_one(samples: int) -> None:
    """`CompleteSplatError` where several samples are asked of a model that draws none."""
    if samples != 1:
        raise CompleteSplatError(f"samples={samples}: this model draws none, it gives one answer")
