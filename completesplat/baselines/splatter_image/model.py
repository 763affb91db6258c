"""Splatter Image with its authors' published weights (Szymanowicz et al., CVPR 2024): one pass, one answer.

It sees an object on a plain background and predicts one Gaussian per pixel. It draws no samples, so hidden parts are
reconstructed as an average. Written after `scene/gaussian_predictor.py` of szymanowiczs/splatter-image at 78a6ad0.

Its files are as on the hub: `config_NAME.yaml` is Hydra's record of a training run, of which a few options are read as
data; `model_NAME.pth` is a checkpoint of torch with `model_state_dict`. The weights for objects of all kinds are in
`model_latest.pth`.
"""

import os
import re
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
import yaml
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.model import Reconstruction, ReconstructionModel
from completesplat.baselines.splatter_image.network import SongUNet
from completesplat.errors import CompleteSplatError, TensorFileError, WeightsError
from completesplat.files import atomic_path, home_path, make_folder, write_text
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.photo.reading import Framing, ImageLike, Photograph
from completesplat.quantities import Crop, Entries, Few, Natural, Range, Width
from completesplat.scene_model import SceneModel
from completesplat.settings.schema import violations
from completesplat.splatter_image import Parameterization, SplatterImage
from completesplat.weights import RUN_WEIGHTS, from_hub, read_small
from completesplat.weights.checkpoint_reading import mismatch, read_tensor_file
from completesplat.wording import SHORT, printable

OBJECT_SIZE = 2 * 0.57
"""Largest extent of the captured objects, in scene units (`preprocess_co3d.py`: 1.2 * 0.95)."""
CUT_OUT_SHARE = 0.65
"""Share of the image that a cut-out object fills (`gradio_app.py`, `resize_foreground`)."""
PHONE_FOV = 50.0
TOLERANCE = 1e-4
# Neither scales nor depths are clamped.
PARAMETERIZATION = Parameterization(layers=1, smallest_scale=1e-9, largest_scale=1e9, harmonics=1)
OUTPUTS = PARAMETERIZATION.channels
ORDER_OF_HARMONICS = [[[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]]  # signed permutation of axes; its transpose inverts it

HUB = "szymanowiczs/splatter-image-v1"
PAGE = f"https://huggingface.co/{HUB}"
PREFIX = "splatter_image:"
STATE = "model_state_dict"
GENERAL = "objaverse"
GENERAL_FILE = "model_latest.pth"
MODEL_FILE = re.compile(r"model_(\w+)\.pth")

# Options that are read, by section. Networks that other options describe have other tensors, which loading shows.
SECTIONS: dict[str, dict[str, object]] = {
    "data": {
        "training_resolution": Annotated[int, Range(8, 1024)],
        "znear": Annotated[float, Range(-1e6, 1e6)],
        "zfar": Annotated[float, Range(-1e6, 1e6)],
        "white_background": bool,
        "origin_distances": bool,
    },
    "model": {
        "base_dim": Width,
        "num_blocks": Few,
        "attention_resolutions": Annotated[Sequence[Natural], Entries(most=8)],
    },
}


class PublishedCheckpoint(NamedTuple):
    """Checkpoint of published weights, and the sections `data` and `model` of its config."""

    weights: Path
    data: Mapping[str, Any]
    model: Mapping[str, Any]


class DepthBounds(NamedTuple):
    """Depth range of the Gaussians along the optical axis: absolute, or relative to an object's distance."""

    near: float
    far: float
    around_object: bool

    def range(self, given: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Return near and far for scenes whose data have the depth range `given`.

        The far depth tells an object's distance; the near depth does not, which is clamped in front of the camera.
        """
        limits = given.new_tensor([self.near, self.far])
        if self.around_object:
            return given[..., 1:] + limits - self.far
        return limits.expand_as(given)


@dataclass(frozen=True)
class PublishedImage(SplatterImage):
    """Splatter Image with its own depth range."""

    depths: DepthBounds

    def gaussians(self, cameras: Cameras, depth_range: Float[Tensor, "*batch 2"]) -> Gaussians:
        """Return Gaussians like `SplatterImage.gaussians`, in the depth range of the weights."""
        return super().gaussians(cameras, self.depths.range(depth_range))


class PublishedSplatterImage(ReconstructionModel):
    """Network from an image to a Splatter Image, with published weights.

    Attributes:
        image_size: side of the square images, in pixels.
        background: grey value behind the objects in all its training images, 0 or 1.
        fov_degrees: field of view of all training images; None: each has its own.
        depths: depth range of its Gaussians.

    Args:
        weights: `splatter_image:NAME` on the hub, a `.pth` file beside its `config_NAME.yaml`, or their folder.

    Raises:
        WeightsError: the files are missing, unreadable, or have other tensors (name, size, type) than this network.
    """

    ray_dirs: Tensor
    parameterization = PARAMETERIZATION

    def __init__(self, weights: str) -> None:
        super().__init__()
        file, data, model = find_published(weights)
        self.file = file
        size = self.image_size = data["training_resolution"]
        self.background = float(data["white_background"])
        self.depths = DepthBounds(data["znear"], data["zfar"], data["origin_distances"])
        with torch.device("meta"):  # tensors have sizes but take no memory
            network = SongUNet(size, 3, OUTPUTS, model["base_dim"], model["num_blocks"], model["attention_resolutions"])
            last = nn.Conv2d(OUTPUTS, OUTPUTS, 1)
            self.network_with_offset = nn.Sequential(OrderedDict(encoder=network, out=last))
            self.register_buffer("ray_dirs", torch.empty(1, 3, size, size))
            for name in ("v_to_sh_transform", "sh_to_v_transform"):
                self.register_buffer(name, torch.empty(1, 3, 3))
        tensors = read_tensors(file)
        other_types = [f"{name} is of {x.dtype}" for name, x in tensors.items() if x.dtype != torch.float32]
        reason = mismatch(self.state_dict(), tensors) or next(iter(other_types), None)
        if reason is None:
            self.load_state_dict({name: value.clone() for name, value in tensors.items()}, assign=True)
            reason = self._other_constants()
        if reason is not None:
            raise WeightsError(f"{file}: {reason}")
        self.fov_degrees = self._field_of_view()

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Reconstruction:
        """Reconstruct from sRGB images in [0, 1] of objects on `background`; there is no posterior."""
        raw = self.network_with_offset(images).float()[:, None]
        return Reconstruction(PublishedImage(raw, PARAMETERIZATION, self.depths), None)

    def object_distance(self, image: Float[Tensor, "3 size size"], focal_length: float) -> float:
        """Estimate the distance of an object on `background`, assuming that it is as large as the training objects.

        Weights that were trained on captures need it. Upstream takes it from the data; for photos it is estimated here.
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
        corner = float(self.ray_dirs[0, 0, 0, 0])
        along = torch.linspace(corner, -corner, self.image_size)
        y, x = torch.meshgrid(along, along, indexing="ij")
        rays = torch.stack([x, y, torch.ones_like(x)])[None]  # through the pixels' centres
        if not torch.allclose(self.ray_dirs, rays, rtol=TOLERANCE, atol=TOLERANCE) or corner >= 0:
            return "ray_dirs are not those of a camera that looks along +z, with +x right and +y down"
        return None

    def _field_of_view(self) -> float | None:
        """Derive the field of view from the rays; None if these are in pixels, for a focal length of 1."""
        corner = -self.ray_dirs[0, 0, 0, 0].double()
        half = self.image_size / 2
        focal_length = (half - 0.5) / corner
        return None if abs(focal_length - 1) < TOLERANCE else float(2 * torch.atan(half / focal_length).rad2deg())


class PublishedModel(SceneModel):
    """Published weights of Splatter Image, as `CompleteSplat.from_pretrained` and `predict` take them.

    Its field of view is that of the training images, or if these have different ones, that of a phone's main camera.
    Its up direction points upwards in the photo. Arguments and errors are those of `PublishedSplatterImage`.
    """

    def __init__(self, weights: str) -> None:
        network = PublishedSplatterImage(weights)
        super().__init__({"image_size": network.image_size})
        self.network: PublishedSplatterImage = network.eval().requires_grad_(False)
        self.background = network.background
        self.file = network.file
        self.fov_degrees.fill_(PHONE_FOV if network.fov_degrees is None else network.fov_degrees)
        color = "white" if network.background else "black"
        self.note = (
            "Splatter Image (Szymanowicz et al., CVPR 2024), another method. It knows objects on "
            f"{color}: give images that are transparent or {color} around one, or background=remove"
        )

    def needed_of_data(self, data: Mapping[str, object]) -> dict[str, object]:
        """Return image size and background, and for weights trained on captures the depth range behind an object.

        Raises:
            CompleteSplatError: the weights need the distance of the object, and the data do not contain it.
        """
        needed = super().needed_of_data(data) | {"background": self.background}
        if not self.network.depths.around_object:
            return needed
        if "depth_after" not in data:  # the far end of the depth range says where the object is
            raise CompleteSplatError(f"{self.network.file}: knows objects; these data do not say where objects are")
        return needed | {"depth_after": self.network.depths.far}

    @property
    def framing(self) -> Framing:
        """Return how photos are framed: on the background that the weights know.

        If the weights know only one field of view, the image is taken to have it, and a cut-out object is placed in the
        middle of the image, as large as in training.
        """
        known = self.network.fov_degrees
        background = self.network.background
        if known is None:
            return Framing(self.image_size, PHONE_FOV, background=background, training={})
        return Framing(
            self.image_size, known, reads_exif=False, background=background, object_share=CUT_OUT_SHARE, training={}
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
        """Read an image at the model's size; see `SceneModel.read`.

        Raises:
            CompleteSplatError: as `read_photograph`, or a field of view is given, and the weights know only one.
        """
        known = self.network.fov_degrees
        if known is not None and fov_degrees is not None:
            raise CompleteSplatError(f"fov={fov_degrees:g}: these weights take every image as of {known:.0f} degrees")
        return super().read(image, fov_degrees, remove_background, mask, box, crop)

    def depth_range_of(self, photograph: Photograph) -> Float[Tensor, "2"]:
        """Return near and far; for weights trained on captures, around the object's estimated distance."""
        focal_length = self.camera(photograph).intrinsics[0, 0].item()
        distance = self.network.object_distance(photograph.image, focal_length)
        known = torch.tensor([0.0, distance + self.network.depths.far], device=self.up.device)
        return self.network.depths.range(known)

    def weight_files(self) -> dict[str, bytes]:
        """Raise WeightsError, because published weights stay in their authors' files."""
        raise WeightsError("published weights are kept as their authors' files: copy these")


def is_published(weights: Path | str) -> bool:
    """Return whether `weights` are Splatter Image's: `splatter_image:NAME`, a `.pth` file, or its folder or run."""
    path = home_path(weights)
    return str(weights).startswith(PREFIX) or path.suffix == ".pth" or (os.path.isdir(path) and bool(_models_in(path)))


def find_published(weights: str) -> PublishedCheckpoint:
    """Find the files of `weights`: `splatter_image:NAME` on the hub (downloaded once), or a local file or folder.

    Raises:
        WeightsError: they are missing, cannot be downloaded, or have options that no published weights have.
    """
    published = weights.startswith(PREFIX)
    model = _download(weights.removeprefix(PREFIX)) if published else _local(home_path(weights))
    options = _read_config(_config_beside(model))
    return PublishedCheckpoint(model, options["data"], options["model"])


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read the tensors of a checkpoint by name, mapped from the file, so that unused ones take no memory.

    Raises:
        WeightsError: the file is damaged, holds anything but plain data, or has no tensors of a model.
    """
    try:
        checkpoint = read_tensor_file(path, mmap=True)
    except TensorFileError as error:
        raise WeightsError(f"{path}: damaged, or not plain numbers ({error}); fetch it again") from error
    tensors = checkpoint.get(STATE) if isinstance(checkpoint, dict) else None
    if not isinstance(tensors, dict) or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise WeightsError(f"{path}: no {STATE} in it; give Splatter Image's own file")
    return tensors


def write_trained(folder: Path, weights: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write fine-tuned weights in the format of their authors' files, with an unchanged copy of their config."""
    make_folder(folder)
    config = _config_beside(weights)
    write_text(folder / config.name, read_small(config))
    with atomic_path(folder / weights.name) as temporary:
        torch.save({STATE: {name: value.detach().cpu() for name, value in tensors.items()}}, temporary)


def _models_in(folder: Path) -> list[Path]:
    paths = [*folder.glob("model_*.pth"), *(folder / RUN_WEIGHTS).glob("model_*.pth")]
    return sorted(path for path in paths if _config_beside(path).is_file())


def _config_beside(model: Path) -> Path:
    if model.name == GENERAL_FILE:
        name = GENERAL
    else:
        match = MODEL_FILE.fullmatch(model.name)
        name = "NAME" if match is None else match[1]
    return model.with_name(f"config_{name}.yaml")


def _local(path: Path) -> Path:
    models = _models_in(path) if path.is_dir() else [path]
    if len(models) > 1:
        names = ", ".join(model.name for model in models)
        raise WeightsError(f"{path}: holds {names}; give one of these files")
    if not models or not models[0].is_file():
        raise WeightsError(f"{path}: no such file")
    config = _config_beside(models[0])
    if not config.is_file():
        raise WeightsError(f"{models[0]}: {config.name} is missing beside it; both are at {PAGE}")
    return models[0]


def _download(name: str) -> Path:
    if not re.fullmatch(r"\w+", name):
        raise WeightsError(f"{PREFIX}{printable(name, SHORT)}: give NAME of a config_NAME.yaml at {PAGE}")
    files = f"config_{name}.yaml", GENERAL_FILE if name == GENERAL else f"model_{name}.pth"
    advice = f"where there is a network, `hf download {HUB} {' '.join(files)} --local-dir DIR` fetches it; "
    advice += f"then give weights=DIR/{files[1]}"
    folder = from_hub(HUB, files, advice)
    if not all((folder / file).is_file() for file in files):
        raise WeightsError(f"{PREFIX}{name}: {' or '.join(files)} is not in {folder}, the copy of {HUB}; {advice}")
    return folder / files[1]


def _read_config(path: Path) -> dict[str, dict[str, Any]]:
    """Read the options in `SECTIONS`; raise WeightsError if one is missing or of another type."""
    text = read_small(path)
    try:
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
            raise WeightsError(f"{path}: has aliases, which can unpack to any size; Splatter Image's files have none")
        config = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError) as error:
        raise WeightsError(f"{path}: not readable as YAML ({type(error).__name__})") from error
    sections: dict[str, dict[str, Any]] = {}
    for section, hints in SECTIONS.items():
        options = config.get(section) if isinstance(config, Mapping) else None
        known = options if isinstance(options, Mapping) else {}
        sections[section] = {name: known.get(name) for name in hints}
        _check_section(path, section, sections[section])
    return sections


def _check_section(path: Path, section: str, options: Mapping[str, object]) -> None:
    for name, hint in SECTIONS[section].items():
        for place, value, reason in violations(hint, options[name]):
            message = f"{path}: {section}.{name}{place} is {printable(value, SHORT)}: {reason}"
            raise WeightsError(f"{message}; only Splatter Image's own files are read")
