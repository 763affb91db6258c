"""Splatter Image with the weights that its authors published (Szymanowicz et al., CVPR 2024): one pass, one answer.

Read at commit 78a6ad0 of szymanowiczs/splatter-image (`scene/gaussian_predictor.py`) and written anew.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.model import Reconstruction
from completesplat.baselines.song_unet import SongUNet
from completesplat.errors import WeightsError
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers.directional import DirectionalGaussians
from completesplat.splatter_image import CHANNELS, SH_C0, Parameterization, SplatterImage
from completesplat.weights.splatter_image import find, read_tensors

SH_C1 = 0.4886025119029199
"""The spherical harmonics of degree 1 are this, sqrt(3 / (4 pi)), times -y, z and -x of the unit direction."""
HARMONICS = 9
OBJECT_SIZE = 2 * 0.57
"""Of the captures' objects along their largest axis, in scene units (`preprocess_co3d.py`: 1.2 * 0.95)."""
TOLERANCE = 1e-4
# Neither scales nor depths are clamped.
PARAMETERIZATION = Parameterization(layers=1, smallest_scale=1e-9, largest_scale=1e9)
ORDER_OF_HARMONICS = [[[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]]  # of a vector's components; its transpose goes back


class Depths(NamedTuple):
    """Where along the optical axis Gaussians lie: between these two, or that far from an object's distance."""

    near: float
    far: float
    around_object: bool

    def range(self, given: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Near and far of scenes whose data say this; of these, the far end tells the object's distance.

        Their near end is kept in front of the camera, which Splatter Image's is not.
        """
        own = given.new_tensor([self.near, self.far])
        return given[..., 1:] + own - self.far if self.around_object else own.expand_as(given)


@dataclass(frozen=True)
class DirectionalSplatterImage(SplatterImage):
    """A Splatter Image of one layer with spherical harmonics of degree 1, and with depths of its own.

    `harmonics` are three coefficients of red, green, blue each, in the reference camera's frame.
    """

    harmonics: Float[Tensor, "*batch 9 height width"]
    depths: Depths

    def gaussians(self, cameras: Cameras, depth_range: Float[Tensor, "*batch 2"]) -> DirectionalGaussians:
        """As `SplatterImage.gaussians`; the colours are those that the reference camera sees."""
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
    """The U-Net, with a 1x1 convolution behind it."""

    def __init__(self, **sizes: object) -> None:
        super().__init__()
        outputs = CHANNELS + HARMONICS
        self.encoder = SongUNet(inputs=3, outputs=outputs, **sizes)  # type: ignore[arg-type]
        self.out = nn.Conv2d(outputs, outputs, 1)

    def forward(self, images: Tensor) -> Tensor:
        result: Tensor = self.out(self.encoder(images))
        return result


class PublishedSplatterImage(nn.Module):
    """Image -> Splatter Image by published weights.

    Attributes:
        image_size: side of the square images, in pixels.
        background: grey value behind the objects of all pictures that it has seen, 0 or 1.
        fov_degrees: field of view of all these pictures; None: each has its own.
        depths: where its Gaussians lie.

    Args:
        weights: `splatter_image:NAME` of the hub, a `.pth` file with its `config_NAME.yaml` beside it, or a folder of
            both; see `weights/splatter_image.py`.

    Raises:
        WeightsError: the files are missing, unreadable, or not those of this network, to the last name and size.
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
        with torch.device("meta"):  # which gives tensors sizes and no memory
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
        if said := _mismatch(self.state_dict(), tensors):
            raise WeightsError(f"{file}: {said}")
        self.load_state_dict({name: value.clone() for name, value in tensors.items()}, assign=True)
        if said := self._other_constants():
            raise WeightsError(f"{file}: {said}")
        self.fov_degrees = self._field_of_view()

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Reconstruction:
        """Reconstruct from sRGB images in [0, 1] of objects on `background`; there is no posterior."""
        output = self.network_with_offset(images).float()
        raw, harmonics = output.split([CHANNELS, HARMONICS], dim=1)
        return Reconstruction(
            DirectionalSplatterImage(raw[:, None], PARAMETERIZATION, harmonics, self.depths), posterior=None
        )

    def object_distance(self, image: Float[Tensor, "3 size size"], focal_length: float) -> float:
        """How far away an object on `background` is whose largest extent in the picture is that of training's objects.

        The weights of captures want it (upstream's data know it); for a photograph this is our estimate.
        """
        seen = ((image - self.background).abs() > 0.05).any(0)
        extent = max((int(seen.any(axis).sum()) for axis in (0, 1)), default=0) or self.image_size
        return OBJECT_SIZE * focal_length / extent

    def _other_constants(self) -> str | None:
        """What of the constants in the weights is other than the network takes it to be."""
        order = torch.tensor(ORDER_OF_HARMONICS)
        kept = {"v_to_sh_transform": order, "sh_to_v_transform": order.mT}
        for name, value in self.named_buffers():
            known = torch.full_like(value, 0.25) if name.endswith("resample_filter") else kept.get(name)
            if known is not None and not torch.equal(known, value):
                return f"{name} has other values than published weights have"
        corner = self.ray_dirs[0, 0, 0, 0]
        if not torch.allclose(self.ray_dirs, self._rays(corner), rtol=TOLERANCE, atol=TOLERANCE) or corner >= 0:
            return "ray_dirs are not those of a camera that looks along +z, with +x right and +y down"
        return None

    def _rays(self, corner: Tensor) -> Float[Tensor, "1 3 size size"]:
        """Rays through the pixels' centres, from the x and y of the first one."""
        along = torch.linspace(float(corner), -float(corner), self.image_size)
        y, x = torch.meshgrid(along, along, indexing="ij")
        return torch.stack([x, y, torch.ones_like(x)])[None]

    def _field_of_view(self) -> float | None:
        """From the rays: those of weights without one are in pixels, of a focal length of 1."""
        corner = -self.ray_dirs[0, 0, 0, 0].double()
        half = self.image_size / 2
        focal_length = (half - 0.5) / corner
        return None if abs(focal_length - 1) < TOLERANCE else float(2 * torch.atan(half / focal_length).rad2deg())


def _mismatch(own: dict[str, Tensor], there: dict[str, Tensor]) -> str | None:
    """The first tensor that is not the same in both, by name, size and kind."""
    for name, value in own.items():
        if name not in there:
            return f"{name} is missing there"
        if (there[name].shape, there[name].dtype) != (value.shape, value.dtype):
            found = f"{list(there[name].shape)} of {there[name].dtype}"
            return f"{name} is {found} there and {list(value.shape)} of {value.dtype} here"
    for name in there:
        if name not in own:
            return f"{name} has no place here"
    return None
