"""Conversion of any photo to a model's square input image, with its field of view.

Also masks of hidden regions, statistics that characterize a set of images, and removal of the background.
"""

import io
import logging
import math
import os
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image, ImageCms
from torch import Tensor

from completesplat.data.images import files
from completesplat.data.images.exif import ORIENTATION, Tags, crop_fov, read_exif
from completesplat.errors import CompleteSplatError, ImageError
from completesplat.tensors import TensorDataclass

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "AVIF", "JPEG2000", "BMP", "GIF", "PPM")
SMALLEST_SIDE = 8
FOVS = 0.1, 179  # degrees; float32 holds neither the focal lengths nor the depths of others
DEEP_GREY_MODES = (*files.SIXTEEN_BIT_MODES, "I", "F")
LARGEST_PADDED = 6000  # pixels; larger squares are reduced before they are padded, because their size has no bound
SAME_SHAPE = 0.02  # largest difference between the side ratios of a photo and its mask
LANCZOS_REACH = 3  # radius of the filter, in pixels of the coarser image
# Networks of rembg under Apache 2.0, the best first (DIS, U2-Net, its small form); its default forbids commercial use.
CUTTERS = ("isnet-general-use", "u2net", "u2netp")
DOWNLOADED = "u2net"
GRABCUT_SIDE = 400  # pixels; more would take longer than a prediction
MIDDLE = 0.7  # radii of the ellipse in which an object is expected at first, in halves of the sides

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Photograph(TensorDataclass):
    """Square image (sRGB, 0 to 1) with the field of view across a side, and the source of the field of view.

    `crop` tells the central square of the photo from one that was chosen for its object.
    """

    image: Float[Tensor, "3 size size"]
    fov_degrees: float
    fov_source: Literal["given", "exif", "default"]
    crop: Literal["center", "object"] = "center"


Window: TypeAlias = tuple[int, int, int, int]  # left, top, right and bottom of a square of an image, in pixels
ImageLike: TypeAlias = str | Path | Image.Image | np.ndarray | Tensor


def read_photograph(
    source: ImageLike,
    size: int,
    fov_degrees: float | None = None,
    default_fov_degrees: float = 50.0,
    remove_background: bool = False,
    background: float = 1.0,
    object_share: float | None = None,
    whole_object: bool = False,
) -> Photograph:
    """Turn an image upright, crop the largest central square and resize it (Lanczos, antialiased).

    Transparency is composited over the background. An animation yields its first frame. An embedded colour profile is
    converted to sRGB. Grey images of 16 bits are scaled to [0, 1]; grey images of floats must lie in [0, 1].

    Args:
        source: a JPEG, PNG, WebP, TIFF, AVIF, JPEG 2000, BMP, GIF or PPM file, recognized by its content; a PIL image;
            an array [height, width, 3] or tensor [3, height, width] of bytes, or floats in [0, 1] (rounded to bytes).
        fov_degrees: field of view of the central square, if it is known; with `object_share` that of the crop.
        default_fov_degrees: that of the crop without usable EXIF focal length (50 is close to a phone's camera).
        remove_background: see `without_background`; applied to the whole image.
        background: grey value from 0 to 1 behind transparent and removed pixels, white by default.
        object_share: for an image with a transparent or removed background, crop the square around the object such that
            the object's longer side fills this share of it; None: crop the central square.
        whole_object: enlarge that central square, and its field of view, such that it holds the whole object.

    Raises:
        ImageError: the file is missing or not a complete image of one of these formats, has more than 64 million pixels
            (checked before decoding) or less than 8 pixels on a side, or its pixel values are ambiguous.
        CompleteSplatError: the field of view is outside `FOVS`, or errors of `without_background`.
    """
    for fov in (fov_degrees, default_fov_degrees):
        if fov is not None and not FOVS[0] <= fov <= FOVS[1]:
            raise CompleteSplatError(f"the field of view must lie between {FOVS[0]} and {FOVS[1]} degrees, not {fov}")
    try:
        file, exif = _loaded(source)
        upright = files.turn_upright(file, exif.get(ORIENTATION))
        if remove_background:
            upright = _cut_out(upright, background)
        central = _centered_window(upright.size, min(upright.size))
        around = _object_window(upright, object_share) if whole_object or object_share is not None else None
        window = central if around is None else around
        image = _to_tensor(_cropped(upright, window), file, size, background)
    except ImageError as error:
        name = source if isinstance(source, (str, Path)) else "the image"
        raise ImageError(f"{name}: {error}") from error.__cause__
    crop: Literal["center", "object"] = "center" if window == central else "object"
    fov = crop_fov(exif, file.size) if fov_degrees is None else float(fov_degrees)
    if fov is None:
        return Photograph(image, float(default_fov_degrees), "default", crop)
    if crop == "object" and object_share is None:
        ratio = (window[2] - window[0]) / min(upright.size)
        fov = math.degrees(2 * math.atan(ratio * math.tan(math.radians(fov) / 2)))
    return Photograph(image, fov, "exif" if fov_degrees is None else "given", crop)


def _cut_out(image: Image.Image, background: float) -> Image.Image:
    if image.mode not in files.EIGHT_BIT_MODES:
        raise ImageError(f"colour mode {image.mode} goes without background=remove")
    return without_background(_to_srgb(image, background))


def _loaded(source: ImageLike) -> tuple[Image.Image, Tags]:
    """Return an image with its pixels, as it is stored, and its EXIF tags."""
    if isinstance(source, np.ndarray | Tensor):
        source = _pixels(source)
    if isinstance(source, str | Path):
        _require_content(Path(source))
    elif not isinstance(source, Image.Image):
        raise ImageError(f"{type(source).__name__}: give a file name, a PIL image, an array or a tensor")
    formats = files.photo_formats(FORMATS)
    with nullcontext(source) if isinstance(source, Image.Image) else files.open_image(source, formats) as file:
        if min(file.size) < SMALLEST_SIDE:
            raise ImageError(f"{file.size} pixels; at least {SMALLEST_SIDE} on a side are needed")
        if not isinstance(source, Image.Image):
            files.check_sums(file, source)
        file.load()
        return file, read_exif(file)


def _require_content(path: Path) -> None:
    try:
        exists = path.is_file()
    except OSError as error:  # such as a name that is too long
        raise ImageError(str(error.strerror)) from error
    if not exists:
        raise ImageError("a folder; give a file" if path.is_dir() else "no such file")
    if not os.path.getsize(path):
        raise ImageError("the file is empty")


def _object_window(image: Image.Image, share: float | None) -> Window | None:
    """Return the square around the opaque part of which it fills this share; None if all pixels are opaque.

    Without a share it is the smallest square in the middle that holds the central one and the opaque part.
    """
    if image.mode not in files.EIGHT_BIT_MODES or not image.has_transparency_data:
        return None
    alpha = image.convert("RGBA").getchannel("A")
    if alpha.getextrema()[0] == 255:
        return None
    box = alpha.getbbox()
    if box is None:
        raise ImageError("nothing but transparency")
    left, top, right, bottom = box
    if share is not None:
        size = right - left, bottom - top
        return _centered_window(size, round(max(size) / share), left, top)
    width, height = image.size
    reach = max(width - 2 * left, 2 * right - width, height - 2 * top, 2 * bottom - height)
    return _centered_window(image.size, max(reach, min(image.size)))


def _centered_window(size: tuple[int, int], side: int, left: int = 0, top: int = 0) -> Window:
    """Return the square in the middle of a box, which may extend beyond it, as left, top, right and bottom."""
    left = left + (size[0] - side) // 2
    top = top + (size[1] - side) // 2
    return left, top, left + side, top + side


def _cropped(image: Image.Image, window: Window) -> Image.Image:
    """Crop a square. What extends beyond the image is transparent; a large square is reduced before it is padded."""
    left, top, right, bottom = window
    side = right - left
    if left >= 0 and top >= 0 and right <= image.width and bottom <= image.height:
        return image.crop(window)
    factor = -(-side // LARGEST_PADDED)
    left = left // factor
    top = top // factor
    side = side // factor
    return image.convert("RGBA").reduce(factor).crop((left, top, left + side, top + side))


def _pixels(image: np.ndarray | Tensor) -> Image.Image:
    """Convert an array (channel last) or tensor (channel first) of bytes, or of floats, which are rounded to bytes."""
    channel = 0 if isinstance(image, Tensor) else -1
    if image.ndim != 3 or image.shape[channel] != 3:
        raise ImageError(f"{tuple(image.shape)} in shape; arrays are [height, width, 3], tensors [3, height, width]")
    if isinstance(image, Tensor):  # NumPy has no bfloat16
        image = image.float() if image.is_floating_point() else image
    values = image.movedim(0, -1).numpy(force=True) if isinstance(image, Tensor) else image
    if values.dtype == np.uint8:
        return Image.fromarray(values)
    if not np.issubdtype(values.dtype, np.floating):
        raise ImageError(f"values are {values.dtype}; bytes, or floats in [0, 1], have one meaning")
    if not ((values >= 0) & (values <= 1)).all():
        raise ImageError("values outside of [0, 1]")
    return Image.fromarray(np.rint(255 * values.astype(np.float32)).astype(np.uint8))


def _to_tensor(square: Image.Image, source: Image.Image, size: int, background: float) -> Float[Tensor, "3 size size"]:
    """Convert pixels to sRGB in [0, 1]; `source` is the opened file, because only it has TIFF tags."""
    if square.mode in DEEP_GREY_MODES:
        grey = Image.fromarray(files.deep_grey(square, getattr(source, "tag_v2", {})))
        resized = np.asarray(grey.resize((size, size), Image.Resampling.LANCZOS))
        return torch.from_numpy(resized.clip(0, 1)).expand(3, size, size).contiguous()
    if square.mode not in files.EIGHT_BIT_MODES:
        raise ImageError(f"colour mode {square.mode} is not supported")
    small = _to_srgb(square, background).resize((size, size), Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(small)).permute(2, 0, 1).contiguous().float() / 255


def _to_srgb(square: Image.Image, background: float) -> Image.Image:
    """Composite an image over the background, and convert it from its embedded colour profile, if any, to RGB."""
    profile = square.info.get("icc_profile")
    if square.has_transparency_data:
        square = files.over_grey(square, background)
    if profile:
        # Like image viewers, ignore a damaged profile, or one whose colour model differs from the pixels'.
        with suppress(ImageCms.PyCMSError, OSError):
            embedded = ImageCms.ImageCmsProfile(io.BytesIO(profile))
            native = square if square.mode in ("L", "RGB", "CMYK") else square.convert("RGB")
            converted = ImageCms.profileToProfile(native, embedded, ImageCms.createProfile("sRGB"), outputMode="RGB")
            return converted if converted is not None else native
    return square.convert("RGB")


def without_background(image: Image.Image) -> Image.Image:
    """Make the background of an RGB image transparent (RGBA) with a network of rembg, or by GrabCut.

    The network is the best of `CUTTERS` in rembg's folder, or else U2-Net (Qin et al. 2020), which rembg downloads.

    Raises:
        CompleteSplatError: OpenCV is not installed, nor a rembg that works.
        ImageError: the whole image is background.
    """
    pixels = Image.fromarray(np.array(image))  # without EXIF, because rembg would turn the image again
    name = _network()
    try:
        import rembg

        cut: Image.Image = rembg.remove(pixels, session=_session(name))
        log.info("background: removed by rembg (%s)", name)
    except (ImportError, SystemExit):  # rembg exits if onnxruntime is missing
        cut = by_grabcut(pixels)
    except Exception as error:  # from the HTTP library, onnxruntime or the file system
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        log.warning("background: rembg fails with its network %s (%s)", name, reason)
        cut = by_grabcut(pixels)
    if not cut.getchannel("A").getbbox():
        raise ImageError("background=remove leaves nothing of it: no object is found")
    return cut


def by_grabcut(image: Image.Image) -> Image.Image:
    """Keep the largest piece of what differs in colour from the image's border (GrabCut, Rother et al. 2004).

    The colours in the middle are taken for the object's at first.

    Raises:
        CompleteSplatError: OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        extras = 'pip install "completesplat[background]", or "completesplat[grabcut]" (no download, coarser)'
        raise CompleteSplatError(f"background=remove needs rembg or OpenCV: {extras}") from error
    width, height = (max(SMALLEST_SIDE, round(side * GRABCUT_SIDE / max(image.size))) for side in image.size)
    x = width // 30
    y = height // 30  # at least one of them is above 0
    rows, columns = np.ogrid[1 - height : height : 2, 1 - width : width : 2]
    labels = np.where(np.hypot(rows / height, columns / width) < MIDDLE, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels = np.pad(labels[y : height - y, x : width - x], ((y, y), (x, x)), constant_values=cv2.GC_BGD)
    models = np.zeros((2, 1, 65))
    cv2.setRNGSeed(0)
    small = np.array(image.resize((width, height)))
    cv2.grabCut(small, labels, (0, 0, 0, 0), models[0], models[1], 5, cv2.GC_INIT_WITH_MASK)
    _, pieces, statistics, _ = cv2.connectedComponentsWithStats(labels & 1)
    sizes = [0, *statistics[1:, cv2.CC_STAT_AREA]]  # the first piece is the background
    mask = (pieces == np.argmax(sizes)) & (labels & 1 > 0)
    log.info(
        'background: removed roughly, from colours (GrabCut); rembg is better: pip install "completesplat[background]"'
    )
    cut = image.convert("RGBA")
    cut.putalpha(Image.fromarray(mask).convert("L").resize(image.size, Image.Resampling.BICUBIC))
    return cut


def _network() -> str:
    home = os.environ.get("U2NET_HOME", os.path.join(os.environ.get("XDG_DATA_HOME", "~"), ".u2net"))
    folder = Path(home).expanduser()
    return next((name for name in CUTTERS if (folder / f"{name}.onnx").is_file()), DOWNLOADED)


@cache
def _session(name: str) -> object:
    import rembg

    return rembg.new_session(name)


def image_features(images: Float[Tensor, "*batch 3 height width"]) -> Float[Tensor, "*batch 8"]:
    """Return mean and standard deviation of red, green and blue, and two measures of detail; all lie in [0, 1].

    The measures of detail are the mean absolute differences between neighbours in a row, and in a column.
    """
    means = images.mean((-2, -1))
    deviations = images.std((-2, -1), correction=0)
    steps = [images.diff(dim=axis).abs().mean((-3, -2, -1))[..., None] for axis in (-1, -2)]
    return torch.cat([means, deviations, *steps], dim=-1)


def outside_of_box(photograph: Path, box: Sequence[float], size: int) -> Float[Tensor, "1 size size"]:
    """Return 1 where the square of a photo is visible, 0 where a box hides it; see `visible_pixels`.

    Args:
        box: left, upper, right and lower edge, as fractions (0 to 1) of the photo's central square.

    Raises:
        CompleteSplatError: the box is not four numbers, or not of positive size within the square.
    """
    if len(box) != 4:
        raise CompleteSplatError(f"box={list(box)}: give [x0,y0,x1,y1]")
    left, upper, right, lower = box
    if not (0 <= left < right <= 1 and 0 <= upper < lower <= 1):
        raise CompleteSplatError(f"box={list(box)}: needs 0 <= x0 < x1 <= 1 and 0 <= y0 < y1 <= 1")
    side = square_side(photograph)
    hidden = np.zeros((side, side), dtype=bool)
    hidden[math.floor(upper * side) : math.ceil(lower * side), math.floor(left * side) : math.ceil(right * side)] = True
    return visible_pixels(hidden, size)


def outside_of_mask(photograph: Path, mask: Path, size: int) -> Float[Tensor, "1 size size"]:
    """Return the same for a mask image, which is white where the photo is hidden, and is cropped like the photo."""
    hidden = read_photograph(mask, square_side(photograph), background=0.0).image.mean(0).numpy() > 0.5
    with Image.open(photograph) as image, Image.open(mask) as given:
        ratios = [max(size) / min(size) for size in (image.size, given.size)]  # EXIF may turn one of them
        if abs(ratios[0] / ratios[1] - 1) > SAME_SHAPE:
            raise CompleteSplatError(f"{mask}: {given.width} x {given.height} pixels, another shape than the photo's")
    if not hidden.any():
        raise CompleteSplatError(f"{mask}: hides nothing; a mask is white where the photograph is hidden")
    return visible_pixels(hidden, size)


def square_side(photograph: Path) -> int:
    """Return the side in pixels of the largest square of a readable image."""
    with Image.open(photograph) as image:
        return min(image.size)


def visible_pixels(hidden: Bool[np.ndarray, "side side"], size: int) -> Float[Tensor, "1 size size"]:
    """Return 1 for those of size x size pixels to which no hidden pixel contributes in resizing, else 0.

    Resizing blurs by three pixels of the result, so the hidden region grows by as much, and leaves no traces outside.
    """
    for _ in range(2):
        hidden = _touched(hidden, size).T
    if hidden.all():
        raise CompleteSplatError("the whole photo is hidden; a mask is white in the hidden part and black elsewhere")
    return torch.from_numpy(~hidden).float()[None]


def _touched(hidden: Bool[np.ndarray, "side _"], size: int) -> Bool[np.ndarray, "size _"]:
    side = len(hidden)
    if side == size:  # the image is not resized
        return hidden
    scale = side / size
    centers = (np.arange(size) + 0.5) * scale
    reach = LANCZOS_REACH * max(scale, 1)
    first = np.clip(np.floor(centers - reach), 0, side).astype(int)
    last = np.clip(np.ceil(centers + reach), 0, side).astype(int)
    counts = np.concatenate([np.zeros((1, hidden.shape[1]), dtype=int), hidden.cumsum(axis=0)])
    return counts[last] > counts[first]
