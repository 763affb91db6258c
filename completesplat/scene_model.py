"""Base class of all models that make scenes from photos: inputs, cameras, units and files."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.autoreconstructor.encoder import Images
from completesplat.autoreconstructor.model import DepthRange, Reconstruction, ReconstructionModel
from completesplat.data.placement import SMALLEST_NEAR
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, nearest_to_axes, pinhole, transform_points
from completesplat.onnx_graphs import Graph, Precision, write_graphs
from completesplat.photo.photograph import read_photograph
from completesplat.photo.reading import Framing, ImageLike, Photograph
from completesplat.photo.visible import Visible, both
from completesplat.quantities import Crop, Detail
from completesplat.rasterizers.front_detail import fit_detail, front_targets
from completesplat.rasterizers.front_fitting import fit_front
from completesplat.rasterizers.selection import auto
from completesplat.sampling_settings import COLOR_FITS, DEFAULT_SAMPLING, DETAIL, OnFit, OnScenes, Sampling
from completesplat.scene import Views
from completesplat.settings.composition import has_bfloat16
from completesplat.settings.schema import check_settings, check_value
from completesplat.splatter_image import Parameterization, SplatterImage
from completesplat.tensors import concatenate, in_float32
from completesplat.weights.saved_model import SavedModel

OBJECT_SHARE = 0.9  # of the image's side that an object on a background fills, as on imported turntables
_rasterizer = cache(auto)


class SceneModel(SavedModel):
    """Base class of models from photos to scenes: `CompleteSplat` (samples), `DeterministicModel`, `PublishedModel`.

    Args:
        architecture: the config that is written beside the weights; it has `image_size`.

    Attributes:
        background: grey value behind the objects in all its training images; None if they show whole scenes.
    """

    network: ReconstructionModel
    fov_degrees: Tensor
    depth_range: Tensor
    up: Tensor

    draws_samples = False
    """Whether it has several answers for one photo."""

    note: str | None = None
    """Advice to users about the photos that it needs."""

    def __init__(self, architecture: dict[str, Any]) -> None:
        super().__init__(architecture)
        self.image_size: int = architecture["image_size"]
        self.background: float | None = (architecture.get("training") or {}).get("background")
        # These are measured on the training set and serve photos of unknown cameras.
        self.register_buffer("fov_degrees", torch.tensor(50.0))
        self.register_buffer("depth_range", torch.tensor([0.5, 5.0]))
        self.register_buffer("up", torch.tensor([0.0, -1.0, 0.0]))

    @property
    def reconstruction_model(self) -> ReconstructionModel:
        """Return the network that makes a Splatter Image without sampling."""
        return self.network

    @torch.no_grad()
    def generate(
        self,
        images: Images,
        cameras: Cameras,
        depth_range: DepthRange,
        sampling: Sampling = DEFAULT_SAMPLING,
        visible: Visible | None = None,
        own: Visible | None = None,
        on_step: OnScenes | None = None,
    ) -> Gaussians:
        """Reconstruct the scene of each image, in its camera's frame.

        Args:
            visible: 0 where an image is hidden; hidden pixels have no influence.
            own: 0 where an image continues its photo's border, which the scene is not fitted to.
            on_step: never called, because these models have no denoising steps.

        Raises:
            CompleteSplatError: several samples are asked for.
        """
        if sampling.samples != 1:
            raise CompleteSplatError(f"samples={sampling.samples}: this model draws none, it gives one answer")
        if visible is not None:
            images = images * visible + (self.background or 0) * (1 - visible)
        reconstruction: Reconstruction = self.eval().reconstruction_model(images)
        scenes = reconstruction.splatter_image.gaussians(cameras, depth_range)
        return self.fitted(scenes, images, cameras, both(visible, own), sampling.color_fits)

    def fitted(
        self, scenes: Gaussians, images: Images, cameras: Cameras, part: Visible | None, color_fits: int
    ) -> Gaussians:
        """Return scenes [batch * samples] fitted to their images, where `part` is not 0."""
        if not color_fits:
            return scenes
        background = self._behind
        samples = len(scenes.means) // len(images)
        parts = []
        for i in range(len(scenes.means)):  # one after the other, for the memory
            photo = slice(i // samples, i // samples + 1)
            mask = None if part is None else part[photo]
            scene = scenes[i : i + 1]
            parts.append(fit_front(scene, cameras[photo], images[photo], _rasterizer(), color_fits, background, mask))
        return concatenate(parts)

    @property
    def _behind(self) -> float:
        """Grey value behind scenes that are fitted to images."""
        return 0.5 if self.background is None else self.background

    def detailed(
        self,
        scenes: Gaussians,
        photograph: Photograph,
        size: int,
        visible: Visible | None = None,
        on_fit: OnFit | None = None,
    ) -> list[Gaussians]:
        """Return scenes [sample] of a photo whose fronts have its detail (`fit_detail`), each without a batch.

        Args:
            size: side of the image that they are fitted to (`front_size`).
            on_fit: called with the number of each sample before it is fitted.
        """
        if size <= self.image_size:
            return [scenes[i] for i in range(len(scenes.means))]
        camera = self.camera(photograph)[None]
        targets = front_targets(camera, photograph.square_at, size, visible, photograph.own_at)
        fitted = []
        for i in range(len(scenes.means)):
            if on_fit is not None:
                on_fit(i)
            fitted.append(fit_detail(scenes[i : i + 1], camera, targets, _rasterizer(), self._behind)[0])
        return fitted

    def front_size(self, photograph: Photograph, detail: Detail = DETAIL) -> int:
        """Return the side of the image that a photo's scenes look right at: `detail` or less, and the model's or more.

        The photo has no detail beyond its own pixels.
        """
        return max(self.image_size, min(detail, photograph.square.width))

    @property
    def parameterization(self) -> Parameterization:
        return self.reconstruction_model.parameterization

    def replace_sampler(self, sampler: Mapping[str, Any]) -> None:
        """Use another sampler from now on; raise CompleteSplatError if the model draws no samples."""
        raise CompleteSplatError("these weights draw no samples: leave out sampler")

    def needed_of_data(self, data: Mapping[str, object]) -> dict[str, object]:
        """Return the settings that a data set with the config `data` must have for this model."""
        return {"image_size": self.image_size} | ({} if self.background is None else {"background": self.background})

    def depths_of_training(self) -> dict[str, float]:
        """Return the depth range around an object in training, by the names of the settings of data."""
        training = self.architecture.get("training") or {}
        return {name: training[name] for name in ("depth_before", "depth_after") if name in training}

    @in_float32()
    def forward(
        self,
        image: Photograph | ImageLike,
        visible: Float[Tensor, "1 _ _"] | None = None,
        on_step: OnScenes | None = None,
        on_fit: OnFit | None = None,
        detail: Detail = DETAIL,
        **settings: Any,
    ) -> list[Gaussians]:
        """Generate complete scenes from one photo, in its camera's frame (+x right, +y down, +z forward).

        They look right from `camera(photograph, front_size(photograph, detail))`, because a rasterizer's blur is part
        of them (`completesplat.rasterizers.front_detail.seen_larger`). Like `predict`, this fits scenes to the photo by
        default. `color_fits=0, detail=0` gives the paper's plain samples.

        Args:
            image: a file, a PIL image, an array or a tensor (see `read`), or what `read` returned.
            visible: 0 where the image is hidden; by default what `read` was told.
            on_step: called after each denoising step; see `CompleteSplat.generate`.
            on_fit: called with the number of each sample before its front is fitted to more than the model's size.
            detail: longest side of the image that fronts are fitted to, with smaller Gaussians where the photo has more
                detail; at most the photo's own. At the model's size or less, `color_fits` alone fit. 0: none do.
            **settings: `samples`, `skip_weight`, `color_fits` (by default 40), `steps`, `seed`, ...: see `Sampling`.

        Raises:
            CompleteSplatError: the image is not readable, the weights are not float32, or `visible` or a setting is
                not as needed.
        """
        dtype = self.up.dtype
        if dtype != torch.float32:
            message = f"the model's weights are {dtype}; model.float() makes them float32, which scenes need"
            raise CompleteSplatError(message)
        check_settings(Sampling, settings)
        check_value("detail", Detail, detail)
        device = self.up.device
        sampling = Sampling(**{"bfloat16": has_bfloat16(device.type), "color_fits": COLOR_FITS, **settings})
        if detail == 0:
            sampling = replace(sampling, color_fits=0)
        photograph = image if isinstance(image, Photograph) else self.read(image)
        visible = photograph.visible if visible is None else visible
        shape = (1, self.image_size, self.image_size)
        if visible is not None and (visible.shape != shape or not ((visible >= 0) & (visible <= 1)).all()):
            raise CompleteSplatError(f"visible: needs values from 0 to 1 in shape {list(shape)}")
        visible = None if visible is None else visible[None].to(device)
        own = photograph.own_at(self.image_size)
        scenes = self.eval().generate(
            photograph.image[None].to(device),
            self.camera(photograph)[None],
            self.depth_range_of(photograph)[None],
            sampling,
            visible=visible,
            own=None if own is None else own[None].to(device),
            on_step=on_step,
        )
        return self.detailed(scenes, photograph, self.front_size(photograph, detail), visible, on_fit)

    def depth_range_of(self, photograph: Photograph) -> Float[Tensor, "2"]:
        """Return near and far of the scene in a photo: those of the training set.

        The objects in a training set have one size. Their weights move the range with the photo's field of view, so
        that an object at the middle of its range is as large in the photo as in the training images.
        """
        before = (self.architecture.get("training") or {}).get("depth_before")
        if before is None:
            return self.depth_range
        trained, assumed = (math.tan(math.radians(x) / 2) for x in (self.fov_degrees.item(), photograph.fov_degrees))
        center: Tensor = self.depth_range[0] + before
        return (self.depth_range + center * (trained / assumed - 1)).clamp(min=SMALLEST_NEAR)

    @torch.no_grad()
    def reconstruct(self, views: Views) -> Gaussians:
        """Reconstruct the scene of several views at the posterior's mean, without sampling.

        Args:
            views: [view ...], in the model's units (`in_model_units`); the first is the reference, its frame the world.

        Returns:
            Gaussians in the frame of the first camera.

        Raises:
            WeightsError: the posterior of these weights sees one image alone.
        """
        if not self.reconstruction_model.sees_views:
            raise WeightsError("these weights reconstruct from one image: they were trained with posterior=image")
        batch = views.to(self.up.device)[None]
        depth_range = self.depth_range[None]
        reconstruction: Reconstruction = self.eval().reconstruction_model(batch.images[:, 0], batch, depth_range)
        return reconstruction.splatter_image.gaussians(batch.cameras[:, 0], depth_range)[0]

    def in_model_units(self, cameras: Cameras) -> Cameras:
        """Scale the world of cameras in any units to the model's units.

        The point nearest to all optical axes gets the depth at which untrained Gaussians start
        (`Parameterization.first_depth`): objects lie there in the data of training.

        Raises:
            CompleteSplatError: the axes are parallel, or meet behind the first camera.
        """
        center = nearest_to_axes(cameras)
        first = cameras[0].world_to_camera
        depth = 0.0 if center is None else transform_points(first, center.float()[None])[0, 2].item()
        if depth <= 0:
            raise CompleteSplatError("the cameras do not look at one place: where the scene lies cannot be told")
        return cameras.scale_world(torch.tensor(self.middle_depth(self.depth_range) / depth))

    def middle_depth(self, depth_range: Float[Tensor, "2"]) -> float:
        """Return the depth in a range at which Gaussians start in training: for objects, that of their centre."""
        near, far = depth_range.tolist()
        return float(near + self.parameterization.first_depth * (far - near))

    @property
    def framing(self) -> Framing:
        """Return how photos are framed for this model, which is how its training images were.

        The square of a cut-out or transparent object is the central one, enlarged to hold it. A model of objects on a
        background gets such an object on it, as large as in training. It ignores EXIF records: unless a
        field of view is given, it assumes that of its training images.
        """
        typical = self.fov_degrees.item()
        training = self.architecture.get("training") or {}
        if self.background is None:
            return Framing(self.image_size, typical, whole_object=True, training=training)
        return Framing(
            self.image_size,
            typical,
            reads_exif=False,
            background=self.background,
            object_share=OBJECT_SHARE,
            training=training,
        )

    def read(
        self,
        image: ImageLike,
        fov_degrees: float | None = None,
        remove_background: bool = False,
        mask: ImageLike | None = None,
        box: Sequence[float] | None = None,
        crop: Crop = "whole",
    ) -> Photograph:
        """Read an image at the model's size by `read_photograph`, which explains the arguments."""
        check_value("crop", Crop, crop)
        return read_photograph(image, self.framing, fov_degrees, remove_background, mask, box, crop)

    def camera(self, photograph: Photograph, size: int | None = None) -> Cameras:
        """Return the camera that took a photo, at the origin of the world, for the model's image size or another."""
        size = self.image_size if size is None else size
        device = self.up.device
        intrinsics = pinhole(photograph.fov_degrees, size)
        intrinsics[:2, 2] = size * torch.tensor(photograph.axis)
        return Cameras(torch.eye(4, device=device), intrinsics.to(device), (size, size))

    def description(self) -> dict[str, Any]:
        """Return what a program needs beside the networks: sizes, cameras, units (`export/README.md` explains them)."""
        framing = self.framing
        training = framing.training or {}
        return {
            "format": "completesplat",
            "version": 1,
            "draws_samples": self.draws_samples,
            "content": training.get("content"),
            "image_size": self.image_size,
            "fov_degrees": framing.fov_degrees,
            "reads_exif": framing.reads_exif,
            "background": self.background,
            "object_share": framing.object_share,
            "depth_range": self.depth_range.tolist(),
            "depth_before": training.get("depth_before"),
            "smallest_depth": SMALLEST_NEAR,
            "up": self.up.tolist(),
        }

    def graphs(self) -> list[Graph]:
        """Return the parts of the model for ONNX: one graph from an image to its scene."""
        size = self.image_size
        inputs = {"image": torch.full((1, 3, size, size), 0.5), **self.example_camera()}
        return [Graph("scene", self, self._scene_part, inputs)]

    def example_camera(self) -> dict[str, Tensor]:
        """Return inputs of a graph that places Gaussians."""
        intrinsics = pinhole(self.fov_degrees.item(), self.image_size)
        return {"intrinsics": intrinsics[None], "depth_range": self.depth_range.cpu()[None]}

    def _scene_part(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        splatter_image = self.reconstruction_model(inputs["image"]).splatter_image
        return self.placed(splatter_image, inputs["intrinsics"], inputs["depth_range"])

    def placed(
        self,
        splatter_image: SplatterImage,
        intrinsics: Float[Tensor, "*batch 3 3"],
        depth_range: Float[Tensor, "*batch 2"],
    ) -> dict[str, Tensor]:
        """Return the Gaussians of Splatter Images in their cameras' frames, by the names of their values."""
        world_to_camera = torch.eye(4).expand(*intrinsics.shape[:-2], 4, 4)
        cameras = Cameras(world_to_camera, intrinsics, (self.image_size, self.image_size))
        return dict(vars(splatter_image.gaussians(cameras, depth_range)))

    def to_onnx(self, folder: Path | str, precision: Precision = "float32") -> None:
        """Write the networks as ONNX graphs, and `pipeline.json`, by which a program without torch runs them.

        The errors are those of `write_graphs`.
        """
        write_graphs(folder, self.eval().graphs(), self.description(), precision)
