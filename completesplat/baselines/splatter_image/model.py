"""Splatter Image with its authors' published weights (Szymanowicz et al., CVPR 2024): one pass, one answer.

This is a new implementation after commit 78a6ad0 of szymanowiczs/splatter-image (`scene/gaussian_predictor.py`).
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.model import Reconstruction
from completesplat.baselines.splatter_image.directional import DirectionalGaussians
from completesplat.baselines.splatter_image.files import find, read_tensors
from completesplat.baselines.splatter_image.network import SongUNet
from completesplat.errors import WeightsError
from completesplat.geometry.cameras import Cameras
from completesplat.splatter_image import CHANNELS, SH_C0, Parameterization, SplatterImage

SH_C1 = 0.4886025119029199
"""Spherical harmonics of degree 1 are this factor, sqrt(3 / (4 pi)), times -y, z and -x of the unit direction."""
HARMONICS = 9
OBJECT_SIZE = 2 * 0.57
"""Largest extent of the captured objects, in scene units (`preprocess_co3d.py`: 1.2 * 0.95)."""
TOLERANCE = 1e-4
# Neither scales nor depths are clamped.
PARAMETERIZATION = Parameterization(layers=1, smallest_scale=1e-9, largest_scale=1e9)
ORDER_OF_HARMONICS = [[[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]]  # of a vector's components; the transpose inverts it


class Depths(NamedTuple):
    """Depth range of the Gaussians along the optical axis: absolute, or relative to an object's distance."""

    near: float
    far: float
    around_object: bool

    def range(self, given: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Return near and far for scenes with this depth range in their data.

        Its far end gives an object's distance, because its near end is clamped to lie in front of the camera.
        """
        limits = given.new_tensor([self.near, self.far])
        return given[..., 1:] + limits - self.far if self.around_object else limits.expand_as(given)


@dataclass(frozen=True)
class DirectionalSplatterImage(SplatterImage):
    """Splatter Image of one layer, with spherical harmonics of degree 1 and its own depth range.

    `harmonics` holds red, green and blue of three coefficients, in the reference camera's frame.
    """

    harmonics: Float[Tensor, "*batch 9 height width"]
    depths: Depths

    def gaussians(self, cameras: Cameras, depth_range: Float[Tensor, "*batch 2"]) -> DirectionalGaussians:
        """Return Gaussians like `SplatterImage.gaussians`, with the colours that the reference camera sees."""
        plain = super().gaussians(cameras, self.depths.range(depth_range))
        mean = 0.5 + SH_C0 * rearrange(self.split()["color"], "... 1 rgb height width -> ... (height width) rgb")
        minus_y, z, minus_x = SH_C1 * rearrange(
            self.harmonics, "... (term rgb) height width -> term ... (height width) rgb", rgb=3
        )
        slopes = torch.stack([-minus_x, -minus_y, z], dim=-2)
        seen = DirectionalGaussians(**vars(plain), mean_colors=mean, slopes=slopes)
        colors = seen.seen_from(torch.zeros_like(plain.means[..., 0, :])).colors
        return DirectionalGaussians(**{**vars(seen), "colors": colors})


class _Predictor(nn.Module):
    """U-Net followed by a 1x1 convolution."""

    def __init__(self, **sizes: object) -> None:
        super().__init__()
        outputs = CHANNELS + HARMONICS
        self.encoder = SongUNet(inputs=3, outputs=outputs, **sizes)  # type: ignore[arg-type]
        self.out = nn.Conv2d(outputs, outputs, 1)

    def forward(self, images: Tensor) -> Tensor:
        result: Tensor = self.out(self.encoder(images))
        return result


class PublishedSplatterImage(nn.Module):
    """Network from an image to a Splatter Image, with published weights.

    Attributes:
        image_size: side of the square images, in pixels.
        background: grey value behind the objects in all its training images, 0 or 1.
        fov_degrees: field of view of all training images; None: each has its own.
        depths: depth range of its Gaussians.

    Args:
        weights: `splatter_image:NAME` on the hub, a `.pth` file beside its `config_NAME.yaml`, or a folder with
            both; see `weights/splatter_image.py`.

    Raises:
        WeightsError: the files are missing, unreadable, or have other tensors (name, size, type) than this network.
    """

    ray_dirs: Tensor
    parameterization = PARAMETERIZATION

    def __init__(self, weights: str) -> None:
        super().__init__()
        file, data, model = find(weights)
        self.file = file
        size = self.image_size = data["training_resolution"]
        self.background = float(data["white_background"])
        self.depths = Depths(data["znear"], data["zfar"], data["origin_distances"])
        if size % 8 or model["base_dim"] % 4:
            raise WeightsError(f"{file}: a size of {size}, {model['base_dim']} wide: neither fits the network")
        with torch.device("meta"):  # tensors have sizes but take no memory
            self.network_with_offset = _Predictor(
                size=size,
                width=model["base_dim"],
                blocks=model["num_blocks"],
                attention_sizes=model["attention_resolutions"],
            )
            self.register_buffer("ray_dirs", torch.empty(1, 3, size, size))
            for name in ("v_to_sh_transform", "sh_to_v_transform"):
                self.register_buffer(name, torch.empty(1, 3, 3))
        tensors = read_tensors(file)
        if message := _mismatch(self.state_dict(), tensors):
            raise WeightsError(f"{file}: {message}")
        self.load_state_dict({name: value.clone() for name, value in tensors.items()}, assign=True)
        if message := self._other_constants():
            raise WeightsError(f"{file}: {message}")
        self.fov_degrees = self._field_of_view()

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Reconstruction:
        """Reconstruct from sRGB images in [0, 1] of objects on `background`; there is no posterior."""
        output = self.network_with_offset(images).float()
        raw, harmonics = output.split([CHANNELS, HARMONICS], dim=1)
        return Reconstruction(
            DirectionalSplatterImage(raw[:, None], PARAMETERIZATION, harmonics, self.depths), posterior=None
        )

    def object_distance(self, image: Float[Tensor, "3 size size"], focal_length: float) -> float:
        """Estimate the distance of an object on `background`, assuming that it is as large as the training objects.

        The weights of captures need this distance. Upstream takes it from the data; this estimate serves photos.
        """
        seen = ((image - self.background).abs() > 0.05).any(0)
        extent = max((int(seen.any(axis).sum()) for axis in (0, 1)), default=0) or self.image_size
        return OBJECT_SIZE * focal_length / extent

    def _other_constants(self) -> str | None:
        """Name the first constant in the weights that differs from the network's, if there is one."""
        order = torch.tensor(ORDER_OF_HARMONICS)
        expected = {"v_to_sh_transform": order, "sh_to_v_transform": order.mT}
        for name, value in self.named_buffers():
            known = torch.full_like(value, 0.25) if name.endswith("resample_filter") else expected.get(name)
            if known is not None and not torch.equal(known, value):
                return f"{name} has other values than published weights have"
        corner = self.ray_dirs[0, 0, 0, 0]
        if not torch.allclose(self.ray_dirs, self._rays(corner), rtol=TOLERANCE, atol=TOLERANCE) or corner >= 0:
            return "ray_dirs are not those of a camera that looks along +z, with +x right and +y down"
        return None

    def _rays(self, corner: Tensor) -> Float[Tensor, "1 3 size size"]:
        """Return rays through the pixels' centres, given x and y of the first one."""
        along = torch.linspace(float(corner), -float(corner), self.image_size)
        y, x = torch.meshgrid(along, along, indexing="ij")
        return torch.stack([x, y, torch.ones_like(x)])[None]

    def _field_of_view(self) -> float | None:
        """Derive the field of view from the rays; None if these are in pixels, for a focal length of 1."""
        corner = -self.ray_dirs[0, 0, 0, 0].double()
        half = self.image_size / 2
        focal_length = (half - 0.5) / corner
        return None if abs(focal_length - 1) < TOLERANCE else float(2 * torch.atan(half / focal_length).rad2deg())


def _mismatch(own: dict[str, Tensor], there: dict[str, Tensor]) -> str | None:
    """Describe the first tensor that differs in name, size or type, if there is one."""
    for name, value in own.items():
        if name not in there:
            return f"{name} is missing there"
        if (there[name].shape, there[name].dtype) != (value.shape, value.dtype):
            actual = f"{list(there[name].shape)} of {there[name].dtype}"
            return f"{name} is {actual} there and {list(value.shape)} of {value.dtype} here"
    for name in there:
        if name not in own:
            return f"{name} has no place here"
    return None
