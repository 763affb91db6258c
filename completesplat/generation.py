"""From one image to complete scenes. No Lightning here: this is the part that other programs use.

model = CompleteSplat.from_pretrained("toy_objects")
scenes = model("photo.jpg", samples=4, seed=0)
"""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from completesplat.autoreconstructor.skips import allowed_skip_weight
from completesplat.data.pictures.photograph import Photograph, read_photograph
from completesplat.diffusion.sampling import draw_noise, with_forward_process
from completesplat.diffusion.splitting import in_parts
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, nearest_to_axes, pinhole, transform_points
from completesplat.parts import build, check_architecture, check_sizes, read_architecture
from completesplat.scene import Views
from completesplat.tensors import concatenate
from completesplat.weights import CONFIG_FILE, WEIGHTS_FILE, weights_folder, write_sums


class CompleteSplat(nn.Module):
    """Conditioning, denoiser, sampler and the frozen autoreconstructor: everything that inference needs.

    The four parts are given as configurations (`_target_` and arguments, as in `conf/`), so that they can be written
    beside the weights and built again by `from_pretrained`.

    Args:
        autoreconstructor, conditioning, denoiser, sampler: configurations of the parts.
        image_size: side of the square images, in pixels.

    Raises:
        WeightsError: a part or a setting that weights may not name (`parts`).
    """

    draws_samples = True
    latent_mean: Tensor
    latent_std: Tensor
    fov_degrees: Tensor
    depth_range: Tensor
    up: Tensor

    def __init__(
        self,
        autoreconstructor: Mapping[str, Any],
        conditioning: Mapping[str, Any],
        denoiser: Mapping[str, Any],
        sampler: Mapping[str, Any],
        image_size: int,
    ) -> None:
        super().__init__()
        parts = {"autoreconstructor": autoreconstructor, "conditioning": conditioning, "denoiser": denoiser}
        # Weights that training starts from are not needed again: all are saved together.
        saved = {
            name: {key: None if key == "pretrained" else value for key, value in part.items()}
            for name, part in parts.items()
        }
        self.architecture: dict[str, Any] = {**saved, "sampler": dict(sampler), "image_size": image_size}
        check_architecture(self.architecture)
        self.image_size = image_size
        # Its weights are a trained stage's: Stable Diffusion's are not needed at all.
        self.autoreconstructor = build(saved["autoreconstructor"]).requires_grad_(False)
        self.conditioning = build(conditioning)
        self.denoiser = build(denoiser)
        self.sampler = build(sampler)
        # Measured on the training set by the training stage; the last three serve photographs of unknown cameras.
        channels = self.denoiser.latent_channels
        self.register_buffer("latent_mean", torch.zeros(channels, 1, 1))
        self.register_buffer("latent_std", torch.ones(channels, 1, 1))
        self.register_buffer("fov_degrees", torch.tensor(50.0))
        self.register_buffer("depth_range", torch.tensor([0.5, 5.0]))
        self.register_buffer("up", torch.tensor([0.0, -1.0, 0.0]))

    @property
    def layers(self) -> int:
        """Gaussians of a pixel."""
        layers: int = self.autoreconstructor.reconstructor.parameterization.layers
        return layers

    def depth_range_of(self, photograph: Photograph) -> Float[Tensor, "2"]:
        """Near and far of what is made of a photograph: those of the training set."""
        return self.depth_range

    def train(self, mode: bool = True) -> "CompleteSplat":
        """Switch the trainable parts; the autoreconstructor stays frozen in evaluation mode."""
        super().train(mode)
        self.autoreconstructor.eval()
        return self

    @torch.no_grad()
    def encode(
        self,
        images: Float[Tensor, "batch 3 height width"],
        views: Views | None = None,
        depth_range: Float[Tensor, "batch 2"] | None = None,
    ) -> Float[Tensor, "batch channel _ _"]:
        """Draw each scene's latent from the frozen posterior ("we also sample latent codes", supplement), standardised.

        Args:
            images, views, depth_range: see `VariationalAutoReconstructor.posterior`.
        """
        return self.standardised(self.autoreconstructor.posterior(images, views, depth_range)[0].sample())

    def set_latent_moments(self, mean: Sequence[float], std: Sequence[float]) -> None:
        """Mean and deviation of each of the latent's channels on the training set."""
        self.latent_mean.copy_(torch.tensor(mean)[:, None, None])
        self.latent_std.copy_(torch.tensor(std)[:, None, None])

    def standardised(self, latent: Float[Tensor, "batch channel _ _"]) -> Float[Tensor, "batch channel _ _"]:
        """Latents as the denoiser knows them: of mean 0 and deviation 1 in each channel of the training set."""
        return (latent - self.latent_mean) / self.latent_std

    @torch.no_grad()
    def generate(
        self,
        images: Float[Tensor, "batch 3 height width"],
        cameras: Cameras,
        depth_range: Float[Tensor, "batch 2"],
        samples: int = 1,
        skip_weight: float | None = None,
        guidance_weight: float = 0.0,
        steps: int | None = None,
        seed: int | Sequence[int] = 0,
        visible: Float[Tensor, "batch 1 height width"] | None = None,
        batch: int | None = None,
        on_step: Callable[[int, int, Gaussians], None] | None = None,
    ) -> Gaussians:
        """Draw `samples` scenes for each image.

        Noise is drawn first: how many samples are computed at a time changes no more than the rounding of float32.

        Args:
            skip_weight: 1, the default, is most faithful (supplement, "Diverse Sampling"); 0 if something is hidden.
            guidance_weight: share of the unconditional prediction; more gives more diverse samples.
            steps: denoising steps; the sampler's own number by default.
            seed: of all noise, or one for each image: what is drawn for it then depends on no other image.
            visible: 0 where an image is hidden: what is there has no influence.
            batch: the largest number of latents at a time; all by default, or fewer if a GPU's memory does not suffice.
            on_step: called after each denoiser call, for each batch, with its number, the timestep and the scenes that
                the estimate of the clean latent stands for.

        Returns:
            Gaussians [batch * samples], the samples of one image next to each other, in the frame of its camera.

        Raises:
            CompleteSplatError: weights outside of [0, 1], skips with something hidden, impossible steps.
        """
        weight = allowed_skip_weight(skip_weight, visible)
        images = images if visible is None else images * visible
        conditioning = self.conditioning(images)
        _, features = self.autoreconstructor.encoder(images)
        shape = (self.denoiser.latent_channels, *conditioning.shape[-2:])
        noise = draw_noise(len(images), samples, shape, seed).to(images.device)
        image_of = torch.arange(len(images), device=images.device).repeat_interleave(samples)

        def draw(part: slice) -> Gaussians:
            own = image_of[part]
            skips = [feature[own] for feature in features], weight
            decode = partial(self._decode, skips=skips, cameras=cameras[own], depth_range=depth_range[own])
            shown = None if on_step is None else lambda step, level, latent: on_step(step, level, decode(latent))
            return decode(self.sampler(self.denoiser, noise[part], conditioning[own], guidance_weight, steps, shown))

        return concatenate(in_parts(draw, len(noise), batch))

    def _decode(self, latent: Tensor, skips: tuple[Any, ...], cameras: Cameras, depth_range: Tensor) -> Gaussians:
        splatter_image = self.autoreconstructor.reconstructor(latent * self.latent_std + self.latent_mean, *skips)
        gaussians: Gaussians = splatter_image.gaussians(cameras, depth_range)
        return gaussians

    def forward(
        self, image: Photograph | Path | str, visible: Float[Tensor, "1 _ _"] | None = None, **settings: Any
    ) -> list[Gaussians]:
        """Complete scenes from one photograph, in its camera's frame (+x right, +y down, +z forward).

        Args:
            image: a file, or a photograph read with `completesplat.data.pictures.photograph.read_photograph`.
            visible: 0 where it is hidden; see `completesplat.data.pictures.photograph`.
            **settings: `samples`, `skip_weight`, `guidance_weight`, `steps`, `seed`, ...: see `generate`.

        Raises:
            CompleteSplatError: not a readable image, or what `generate` refuses.
        """
        photograph = image if isinstance(image, Photograph) else self.read(image)
        device = self.latent_std.device
        scenes = self.eval().generate(
            photograph.image[None].to(device),
            self.camera(photograph)[None],
            self.depth_range[None],
            visible=None if visible is None else visible[None].to(device),
            **settings,
        )
        return [scenes[i] for i in range(len(scenes.means))]

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
        if not self.autoreconstructor.sees_views:
            raise WeightsError("these weights reconstruct from one picture: they were trained with posterior=image")
        batch, depth_range = views.to(self.latent_std.device)[None], self.depth_range[None]
        posterior, features = self.eval().autoreconstructor.posterior(batch.images[:, 0], batch, depth_range)
        splatter_image = self.autoreconstructor.reconstructor(posterior.mode(), features)
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
        share = self.autoreconstructor.reconstructor.parameterization.first_depth
        return cameras.scale_world(torch.tensor((near + share * (far - near)) / depth))

    def replace_sampler(self, sampler: Mapping[str, Any]) -> None:
        """Draw with another sampler from now on; noise schedule and prediction type stay those of training."""
        config = with_forward_process(sampler, self.architecture["sampler"])
        check_architecture({**self.architecture, "sampler": config})
        self.sampler = build(config)
        self.architecture["sampler"] = config

    def read(self, path: Path | str, fov_degrees: float | None = None) -> Photograph:
        """Read a photograph at the model's size; an unknown field of view is taken to be the training set's."""
        return read_photograph(Path(path), self.image_size, fov_degrees, self.fov_degrees.item())

    def camera(self, photograph: Photograph) -> Cameras:
        """The camera that took a photograph, at the origin of the world."""
        device = self.latent_std.device
        intrinsics = pinhole(photograph.fov_degrees, self.image_size).to(device)
        return Cameras(torch.eye(4, device=device), intrinsics, (self.image_size, self.image_size))

    def save_pretrained(self, path: Path | str) -> None:
        """Write `config.json`, `model.safetensors` and their checksums into a folder; fit for the Hugging Face hub."""
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        save_file({key: value.contiguous().cpu() for key, value in self.state_dict().items()}, folder / WEIGHTS_FILE)
        (folder / CONFIG_FILE).write_text(json.dumps(self.architecture, indent=2) + "\n")
        write_sums(folder)

    @classmethod
    def from_pretrained(cls, path: Path | str) -> "CompleteSplat":
        """Build the model that `save_pretrained` wrote, in evaluation mode on the CPU.

        Args:
            path: a folder, a name of the weights in the package, or an id of the Hugging Face hub (`weights_folder`).

        Raises:
            WeightsError: files are missing, unreadable, changed, do not belong together, or name what `parts` does not.
        """
        folder = weights_folder(path)
        try:
            architecture = read_architecture(folder)
            check_sizes(architecture, folder / WEIGHTS_FILE)
            model = cls(**architecture)
            model.load_state_dict(load_file(folder / WEIGHTS_FILE))
        except WeightsError:
            raise
        except Exception as error:
            reason = str(error).strip().splitlines()
            raise WeightsError(
                f"{folder}: cannot be loaded: {reason[0] if reason else type(error).__name__}"
            ) from error
        return model.eval()
