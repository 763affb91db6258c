"""Models from one image to complete scenes, without Lightning, for use in other programs.

model = CompleteSplat.for_photo("photo.jpg")
scenes = model("photo.jpg", samples=4, seed=0)
"""

import logging
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import Features, Images
from completesplat.autoreconstructor.model import DepthRange, VariationalAutoReconstructor
from completesplat.baselines.splatter_image.model import PublishedModel, is_published
from completesplat.diffusion.denoiser import Denoise, Latents
from completesplat.diffusion.guidance import allowed_skip_weight, in_bfloat16
from completesplat.diffusion.sampling import (
    PART,
    Sampler,
    draw_noise,
    in_parts,
    one_thread_each,
    part_of,
    with_forward_process,
)
from completesplat.diffusion.step_table import step_table
from completesplat.errors import WeightsError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.onnx_graphs import Graph
from completesplat.photo.choice import likeliest_for
from completesplat.photo.crop import SMALLEST_SIDE
from completesplat.photo.reading import Framing, ImageLike, read_square
from completesplat.photo.visible import Visible, both
from completesplat.sampling_settings import DEFAULT_SAMPLING, OnScenes, Sampling
from completesplat.scene import Views
from completesplat.scene_model import SceneModel
from completesplat.splatter_image import SplatterImage
from completesplat.tensors import concatenate, in_float32
from completesplat.weights import first_line
from completesplat.weights.allowed import PartConfig, check_architecture, class_of, stored_config
from completesplat.weights.checkpoint_reading import mismatch, not_finite
from completesplat.weights.opening import StoredModel, read_model

logger = logging.getLogger(__name__)

NETWORKS = ("autoreconstructor", "conditioning", "denoiser", "network")  # parts of models that have weights


class CompleteSplat(SceneModel):
    """Conditioning, denoiser, sampler and the frozen autoreconstructor: everything that inference needs.

    The four parts are given as configs (`_target_` and arguments, as in `conf/`), which are written beside the weights,
    so that `from_pretrained` can build the parts again. They may name the caller's own modules, which are imported.

    Args:
        autoreconstructor, conditioning, denoiser, sampler: configs of the parts.
        image_size: side of the square images, in pixels.
        training: facts about the training images (`completesplat.weights.allowed.TrainingImages`).

    Raises:
        WeightsError: a config has a part or an option that weights may not name (`completesplat.weights.allowed`).
    """

    latent_mean: Tensor
    latent_std: Tensor

    draws_samples = True

    def __init__(
        self,
        autoreconstructor: PartConfig,
        conditioning: PartConfig,
        denoiser: PartConfig,
        sampler: PartConfig,
        image_size: int,
        training: Mapping[str, object] | None = None,
    ) -> None:
        parts = {"autoreconstructor": autoreconstructor, "conditioning": conditioning, "denoiser": denoiser}
        super().__init__(_architecture({**parts, "sampler": sampler}, image_size, training))
        # Its weights come from a trained stage, so Stable Diffusion's are not needed.
        frozen: VariationalAutoReconstructor = build(self.architecture["autoreconstructor"])
        self.autoreconstructor = frozen.requires_grad_(False)
        self.conditioning = build(conditioning)
        self.denoiser = build(denoiser)
        self.sampler: Sampler = build(sampler)
        # The training stage measures these on the training set.
        channels = self.denoiser.latent_channels
        self.register_buffer("latent_mean", torch.zeros(channels, 1, 1))
        self.register_buffer("latent_std", torch.ones(channels, 1, 1))

    @property
    def reconstruction_model(self) -> VariationalAutoReconstructor:
        return self.autoreconstructor

    def train(self, mode: bool = True) -> "CompleteSplat":
        """Switch the trainable parts; the autoreconstructor stays frozen in evaluation mode."""
        super().train(mode)
        self.autoreconstructor.eval()
        return self

    @torch.no_grad()
    def encode(
        self, images: Images, views: Views | None = None, depth_range: DepthRange | None = None
    ) -> Float[Tensor, "batch channel _ _"]:
        """Draw each scene's standardised latent from the frozen posterior ("we also sample latent codes", supplement).

        If stage 1 was not variational, the latent is the posterior's mode. The arguments are those of
        `VariationalAutoReconstructor.posterior`.
        """
        posterior, _ = self.autoreconstructor.posterior(images, views, depth_range)
        return self.standardised(self.autoreconstructor.training_latent(posterior))

    def set_latent_moments(self, mean: Sequence[float], std: Sequence[float]) -> None:
        """Set the mean and standard deviation of each channel over the training set (`standardised`)."""
        self.latent_mean.copy_(torch.tensor(mean)[:, None, None])
        self.latent_std.copy_(torch.tensor(std)[:, None, None])

    def standardised(self, latent: Latents) -> Latents:
        """Scale latents for the denoiser: mean 0 and standard deviation 1 in each channel over the training set."""
        return (latent - self.latent_mean) / self.latent_std

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
        """Draw Gaussians [batch * samples]: the scenes of one image next to each other, in the frame of its camera.

        Args:
            visible: 0 where an image is hidden; hidden pixels have no influence.
            own: 0 where an image continues its photo's border, which scenes are not fitted to.
            on_step: called after each denoiser call of each part with its number, the timestep, the estimated scenes.

        Raises:
            CompleteSplatError: a weight lies outside of [0, 1], skips meet hidden pixels, or the steps are impossible.
        """
        skip_weight = allowed_skip_weight(sampling.skip_weight, visible)
        if visible is not None:
            images = images * visible
        with one_thread_each(self.denoiser, images.device) as threads:
            drawing = _Drawing(self, images, cameras, depth_range, sampling, skip_weight, on_step)
            scenes = drawing.scenes(threads)
        return self.fitted(scenes, images, cameras, both(visible, own), sampling.color_fits)

    def replace_sampler(self, sampler: Mapping[str, Any]) -> None:
        """Use another sampler from now on, with the noise schedule and prediction type of training.

        Raises:
            CompleteSplatError: one of the two is for diffusion, the other for flow matching.
            WeightsError: weights may not name one of its parts.
        """
        config = stored_config(with_forward_process(sampler, self.architecture["sampler"]))
        check_architecture({**self.architecture, "sampler": config})
        self.sampler = build(config)
        self.architecture["sampler"] = config

    def description(self) -> dict[str, Any]:
        """Return what a program needs beside the networks, with the noise's shape and the sampler's steps.

        Raises:
            CompleteSplatError: see `step_table`.
        """
        image = torch.full((1, 3, self.image_size, self.image_size), 0.5)
        with torch.no_grad():
            shape = (self.denoiser.latent_channels, *self.conditioning(image).shape[-2:])
        return {**super().description(), "noise_shape": list(shape), "steps": step_table(self.sampler)}

    @torch.no_grad()
    def graphs(self) -> list[Graph]:
        """Return the parts of the model for ONNX: what is computed once a photo, once a step, and once a sample."""
        image = torch.full((1, 3, self.image_size, self.image_size), 0.5)
        seen = self._image_part({"image": image})
        conditioning = seen.pop("conditioning").repeat(2, 1, 1, 1)
        latent = torch.zeros(2, self.denoiser.latent_channels, *conditioning.shape[-2:])
        step = {"latent": latent, "timestep": torch.ones(2, dtype=torch.int64), "conditioning": conditioning}
        decode = {"latent": latent, "skip_weight": torch.tensor([1.0]), **self.example_camera(), **seen}
        return [
            Graph("image", self, self._image_part, {"image": image}),
            Graph("step", self, self._step_part, step, tuple(step)),
            Graph("decode", self, self._decode_part, decode, ("latent",)),
        ]

    def _image_part(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        stage1 = self.autoreconstructor
        features = stage1.encoder.features(inputs["image"] * 2 - 1, stage1.reconstructor.feature_levels)
        numbered = {f"feature{level}": feature for level, feature in enumerate(features)}
        return {"conditioning": self.conditioning(inputs["image"]), **numbered}

    def _step_part(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {"prediction": self.denoiser(inputs["latent"], inputs["timestep"], inputs["conditioning"])}

    def _decode_part(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        latent = inputs["latent"]
        count = latent.shape[0]  # `len` would be one number for every call of the graph
        seen = [value for name, value in inputs.items() if name.startswith("feature")]
        features = [value.expand(count, *value.shape[1:]) for value in seen]
        unscaled = latent * self.latent_std + self.latent_mean
        weight = inputs["skip_weight"].expand(count)
        splatter_image = self.autoreconstructor.reconstructor(unscaled, features, weight)
        intrinsics = inputs["intrinsics"].expand(count, 3, 3)
        return self.placed(splatter_image, intrinsics, inputs["depth_range"].expand(count, 2))

    @staticmethod
    @in_float32()
    def from_pretrained(path: Path | str, trust: bool = False) -> SceneModel:
        """Load a saved or trained model in evaluation mode on the CPU; stage 1 gives a `DeterministicModel`.

        Args:
            path: a name of shipped weights, a folder of weights or of a run, a checkpoint, or an id on the Hugging Face
                hub (`locate`). Published weights of Splatter Image (`is_published`) give a `PublishedModel`.
            trust: the weights name your own modules, and you trust their author; not needed below the working folder.

        Raises:
            WeightsError: files are missing, unreadable, changed, not finite, do not belong together, or name parts that
                `completesplat.weights.allowed` does not list; or the run's model makes no scene from a photo.
        """
        try:
            model = _opened(path, trust)
            name = not_finite(model.state_dict())
        except WeightsError:
            raise
        except Exception as error:
            raise WeightsError(f"{path}: cannot be loaded: {first_line(error)}") from error
        if name is not None:
            raise WeightsError(f"{path}: {name} is not finite")
        return model.eval()

    @staticmethod
    def for_photo(image: ImageLike) -> SceneModel:
        """Load the weights in the package that are likeliest for a photo, as `predict` does, and log which and why.

        Args:
            image: a file, a PIL image, an array or a tensor.

        Raises:
            ImageError, MissingFile: the photo cannot be read.
            WeightsError: the package has no weights.
        """
        read_square(image, Framing(SMALLEST_SIDE))  # which raises where the choice would go on
        label = Path(image).name if isinstance(image, str | Path) else "the photo"
        name, reason = likeliest_for([(label, image)], 1)
        logger.info("weights: %s%s", name, reason)
        return CompleteSplat.from_pretrained(name)


class _Drawing:
    """All samples of some images, which are drawn and decoded in parts.

    Samples are numbered from 0 to `count - 1`, those of one image next to each other.

    Args:
        model, images, cameras, depth_range, sampling, on_step: as of `CompleteSplat.generate`; hidden pixels are 0.
        skip_weight: weight of the skips from the images.
    """

    def __init__(
        self,
        model: CompleteSplat,
        images: Images,
        cameras: Cameras,
        depth_range: DepthRange,
        sampling: Sampling,
        skip_weight: float,
        on_step: OnScenes | None,
    ) -> None:
        self.model = model
        self.cameras = cameras
        self.depth_range = depth_range
        self.sampling = sampling
        self.skip_weight = skip_weight
        self.on_step = on_step
        self.conditioning: Tensor = model.conditioning(images)
        self.features: Features = []
        stage1 = model.autoreconstructor
        if skip_weight:
            self.features = stage1.encoder.features(images * 2 - 1, stage1.reconstructor.feature_levels)
        shape = (model.denoiser.latent_channels, *self.conditioning.shape[-2:])
        self.noise = draw_noise(len(images), sampling.samples, shape, sampling.seed).to(images.device)
        self.count = len(self.noise)
        self.image_of = torch.arange(len(images), device=images.device).repeat_interleave(sampling.samples)
        self.denoise: Denoise = partial(in_bfloat16, model.denoiser) if sampling.bfloat16 else model.denoiser

    def scenes(self, threads: int) -> Gaussians:
        """Draw all samples with this number of threads, each of which draws parts (0: torch's own threads).

        Latents are drawn first and decoded then: if a GPU's memory does not suffice to decode a part, its latents are
        not lost.
        """
        draw_most = self.sampling.batch
        decode_most = self.sampling.batch
        if threads and self.on_step is None:
            draw_most = draw_most or part_of(self.count)
        if threads:
            decode_most = decode_most or PART
        if self.on_step is not None:
            threads = 1
        latents = torch.cat(in_parts(self.draw, self.count, draw_most, threads))
        return concatenate(in_parts(partial(self.decode_part, latents), self.count, decode_most, threads))

    def draw(self, part: slice) -> Latents:
        """Draw the latents of some samples."""
        conditioning = self.conditioning[self.image_of[part]]
        watch = None if self.on_step is None else partial(self.show_step, part)
        weight = self.sampling.guidance_weight
        return self.model.sampler(self.denoise, self.noise[part], conditioning, weight, self.sampling.steps, watch)

    def decode_part(self, latents: Latents, part: slice) -> Gaussians:
        """Decode some of the latents of all samples."""
        return self.decode(latents[part], part)

    def decode(self, latents: Latents, part: slice) -> Gaussians:
        """Decode the latents of some samples."""
        indices = self.image_of[part]
        skips = [feature[indices] for feature in self.features]
        unscaled = latents * self.model.latent_std + self.model.latent_mean
        splatter_image: SplatterImage = self.model.autoreconstructor.reconstructor(unscaled, skips, self.skip_weight)
        return splatter_image.gaussians(self.cameras[indices], self.depth_range[indices])

    def show_step(self, part: slice, step: int, timestep: int, latents: Latents) -> None:
        """Call `on_step` with the scenes that a step estimates for some samples."""
        assert self.on_step is not None
        self.on_step(step, timestep, self.decode(latents, part))


class DeterministicModel(SceneModel):
    """Model of one pass from a photo to its scene: stage 1 at its posterior's mode, or the baseline Splatter Image.

    Args:
        network: config of the network, as in `conf/`.
        image_size, training: as of `CompleteSplat`, which raises the same error.
    """

    def __init__(self, network: PartConfig, image_size: int, training: Mapping[str, object] | None = None) -> None:
        super().__init__(_architecture({"network": network}, image_size, training))
        with torch.random.fork_rng(devices=[]):  # initial weights are random; a run's later draws stay the same
            self.network = build(self.architecture["network"])


def _architecture(
    parts: Mapping[str, PartConfig], image_size: int, training: Mapping[str, object] | None
) -> dict[str, Any]:
    """Return a model's config as weights store it; raise WeightsError for parts that weights may not name."""
    config: dict[str, Any] = {name: stored_config(part) for name, part in parts.items()}
    config["image_size"] = image_size
    if training is not None:
        config["training"] = dict(training)
    check_architecture(config)
    return config


def build(part: Any) -> Any:
    """Build a part, and the parts in it, from a config that `check_architecture` has accepted."""
    if isinstance(part, list):
        return [build(value) for value in part]
    if not isinstance(part, Mapping):
        return part
    settings = {name: build(value) for name, value in part.items() if name != "_target_"}
    return class_of(part)(**settings) if "_target_" in part else settings


def _opened(weights: Path | str, trust: bool) -> SceneModel:
    if is_published(weights):
        return PublishedModel(str(weights))
    stored = read_model(weights, trust)
    _check_sizes(stored)
    kind = DeterministicModel if "network" in stored.architecture else CompleteSplat
    model: SceneModel = kind(**stored.architecture)
    difference = mismatch(model.state_dict(), stored.tensors)
    if difference is not None:
        raise ValueError(difference)
    model.load_state_dict(stored.tensors)
    model.file = stored.tensor_file
    return model


def _check_sizes(stored: StoredModel) -> None:
    """Raise WeightsError, before the networks take memory, if a tensor of theirs is missing or has another size."""
    with torch.device("meta"):  # tensors with sizes but without memory
        parts = {name: build(stored.architecture[name]) for name in NETWORKS if name in stored.architecture}
        networks = nn.ModuleDict(parts)
    for name, value in networks.state_dict().items():
        actual = list(stored.tensors[name].shape) if name in stored.tensors else "missing"
        if actual != list(value.shape):
            places = f"in {stored.tensor_file.name} and {list(value.shape)} by {stored.config_file.name}"
            raise WeightsError(f"{name} is {actual} {places}")
