"""Removal of the background of a photo, by a network of rembg or by colours (GrabCut)."""

import logging
import os
from functools import cache

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

from completesplat.errors import CompleteSplatError, ImageError
from completesplat.files import home_path
from completesplat.installation import install_command

# Networks of rembg under Apache 2.0, the best first (DIS, U2-Net, its small form); its default forbids commercial use.
NETWORKS = ("isnet-general-use", "u2net", "u2netp")
DOWNLOADED = "u2net"
GRABCUT_SIDE = 400  # pixels; more would take longer than a prediction
GRABCUT_ROUNDS = 5
SMALLEST_SIDE = 8  # pixels of the shorter side for GrabCut
MIDDLE = 0.7  # radii of the ellipse in which an object is expected at first, in halves of the sides

log = logging.getLogger(__name__)


def without_background(image: Image.Image) -> Image.Image:
    """Make the background of an RGB image transparent (RGBA) with a network of rembg, or by GrabCut.

    The network is the best of `NETWORKS` in rembg's folder, or else U2-Net (Qin et al. 2020), which rembg downloads.

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
        extras = f"{install_command('background')}, or {install_command('grabcut')} (no download, coarser)"
        raise CompleteSplatError(f"background=remove needs rembg or OpenCV: {extras}") from error
    scale = GRABCUT_SIDE / max(image.size)
    width = max(SMALLEST_SIDE, round(image.width * scale))
    height = max(SMALLEST_SIDE, round(image.height * scale))
    pixels = np.array(image.resize((width, height)))
    labels = _first_labels(height, width)
    models = np.zeros((2, 1, 65))  # of the background's colours, and of the object's
    cv2.setRNGSeed(0)
    cv2.grabCut(pixels, labels, (0, 0, 0, 0), models[0], models[1], GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    mask = Image.fromarray(_largest_piece(labels)).convert("L")
    advice = f"rembg is better: {install_command('background')}"
    log.info("background: removed roughly, from colours (GrabCut); %s", advice)
    cut = image.convert("RGBA")
    cut.putalpha(mask.resize(image.size, Image.Resampling.BICUBIC))
    return cut


def _first_labels(height: int, width: int) -> UInt8[np.ndarray, "height width"]:
    """Return GrabCut's labels: an ellipse that is probably the object, and a border that is certainly background."""
    import cv2

    x = width // 30
    y = height // 30  # at least one of them is above 0
    rows, columns = np.ogrid[1 - height : height : 2, 1 - width : width : 2]
    in_middle = np.hypot(rows / height, columns / width) < MIDDLE
    labels = np.where(in_middle, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    return np.pad(labels[y : height - y, x : width - x], ((y, y), (x, x)), constant_values=cv2.GC_BGD)


def _largest_piece(labels: UInt8[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the largest connected piece of the pixels that GrabCut labels as the object."""
    import cv2

    _, pieces, statistics, _ = cv2.connectedComponentsWithStats(labels & 1)
    sizes = [0, *statistics[1:, cv2.CC_STAT_AREA]]  # the first piece is the background
    return (pieces == np.argmax(sizes)) & (labels & 1 > 0)


def _network() -> str:
    home = os.environ.get("U2NET_HOME", os.path.join(os.environ.get("XDG_DATA_HOME", "~"), ".u2net"))
    folder = home_path(home)
    return next((name for name in NETWORKS if (folder / f"{name}.onnx").is_file()), DOWNLOADED)


@cache
def _session(name: str) -> object:
    import rembg

    return rembg.new_session(name)
