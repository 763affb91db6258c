"""Workloads: scenes like splatter images or from a file, and the time and memory of one rendering."""

import ctypes
import math
import mmap
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from completesplat.errors import DataError
from completesplat.gaussians import Gaussians, concatenate
from completesplat.geometry.cameras import Cameras, look_at, pinhole, pixel_centers, unproject
from completesplat.rasterizers import Rasterizer
from completesplat.rasterizers.kernels.drawing import release

DISTANCE = 2.2  # from the cameras to the object's centre, world units
FOV_DEGREES = 49.0
OPACITIES = ("trained", "initial")


def splatter_scene(size: int, views: int, opacity: str, image_size: int | None = None) -> tuple[Gaussians, Cameras]:
    """Return a scene (batch of 1) with two layers of one Gaussian per pixel, and cameras on an orbit about it.

    Opacities are as after training ("trained": a dense object, where pixels are soon opaque, before a thin background)
    or as at its start ("initial": all low, so that every Gaussian counts). `size` is the side of the splatter image,
    `image_size` that of the cameras' images (None: the same).
    """
    generator = torch.Generator().manual_seed(0)
    source = Cameras(torch.eye(4), pinhole(FOV_DEGREES, size), (size, size))
    layers = [_layer(layer, source, opacity, generator) for layer in range(2)]
    return concatenate(layers)[None], orbit(image_size or size, views)


def _layer(layer: int, source: Cameras, opacity: str, generator: torch.Generator) -> Gaussians:
    """Return the front (0) or the back (1) of an ellipsoid, and a piece of background further away."""
    size = source.image_size[0]
    pixels = pixel_centers(size, size).flatten(0, 1)
    x, y = (pixels / size * 2 - 1).unbind(-1)
    radius = (x / 0.75).square() + (y / 0.8).square()
    bulge = 0.75 * (1 - radius).clamp(min=0).sqrt() * (1 if layer else -1)
    depth = DISTANCE + torch.where(radius < 1, bulge, 0.3 + 0.3 * layer)
    pixel_width = depth / source.intrinsics[0, 0]
    spread = 1.0 + layer if opacity == "trained" else 1.5  # standard deviation, in pixels
    noise = torch.randn(size * size, 9, generator=generator)
    return Gaussians(
        means=unproject(source, pixels + 0.25 * noise[:, :2], depth),
        quaternions=torch.tensor([1.0, 0, 0, 0]) + 0.5 * noise[:, 2:6],
        scales=(spread * pixel_width)[:, None] * torch.exp(0.4 * noise[:, 6:]),
        opacities=_opacities(layer, radius < 1, opacity, generator),
        colors=torch.stack([x, y, x * y], dim=-1).mul(3 + layer).sin() / 2 + 0.5,
    )


def _opacities(layer: int, inside: Tensor, opacity: str, generator: torch.Generator) -> Tensor:
    uniform = torch.rand(inside.shape, generator=generator)
    if opacity == "initial":
        return 0.1 + 0.2 * uniform
    return torch.where(inside, (0.1 if layer else 0.55) + 0.44 * uniform, 0.02 + 0.3 * uniform**3)


def orbit(size: int, views: int) -> Cameras:
    """Return cameras [1 view] on an orbit about the object, for images of side `size`."""
    angles = 0.5 + 2 * math.pi * torch.arange(views) / views
    target = torch.tensor([0.0, 0.0, DISTANCE])
    eyes = target + DISTANCE * torch.stack([angles.sin(), torch.full_like(angles, -0.2), -angles.cos()], dim=-1)
    matrices = look_at(eyes, target, torch.tensor([0.0, -1.0, 0.0]))
    return Cameras(matrices[None], pinhole(FOV_DEGREES, size).expand(1, views, 3, 3), (size, size))


NEEDED = ("means3d", "colors", "viewmats", "Ks", "width", "height")
# Defaults for missing arrays (gsplat's file lacks all three): round and half transparent Gaussians, of about the size
# that gsplat's own tests use (0 to 0.02 world units, `gsplat/_helper.py`).
DEFAULTS: dict[str, Any] = {"quats": (1.0, 0.0, 0.0, 0.0), "scales": (0.01, 0.01, 0.01), "opacities": 0.5}


def read_scene(path: Path) -> tuple[Gaussians, Cameras, list[str]]:
    """Read a scene (batch of 1) and its cameras; return them, and the names of missing arrays, which got defaults.

    Arrays: `means3d` [n 3], `colors` [n 3] (integers to 255, or floats to 1), `viewmats` [view 4 4] (world to
    camera), `Ks` [view 3 3] (pixels), `width`, `height`; if present `quats` [n 4] (wxyz), `scales` [n 3], `opacities`.

    Raises:
        DataError: the file is missing or not an npz, or an array is missing, not numeric or of the wrong shape.
    """
    arrays = _arrays(path)
    missing = [name for name in NEEDED if name not in arrays]
    if missing:
        raise DataError(f"{path} lacks {', '.join(missing)}")

    count, views = len(np.atleast_1d(arrays["means3d"])), len(np.atleast_1d(arrays["viewmats"]))
    inputs = {name: np.broadcast_to(value, (count, *np.shape(value))) for name, value in DEFAULTS.items()} | arrays

    def tensor(name: str, *shape: int, unit: int = 1) -> Tensor:
        values = inputs[name]
        if values.shape != shape or 0 in shape or values.dtype.kind not in "iuf":
            actual = f"{values.dtype} in the shape {list(values.shape)}"
            raise DataError(f"{path}: {name} should hold numbers in the shape {list(shape)}, not {actual}")
        return torch.from_numpy(np.ascontiguousarray(values / unit, np.float32))[None]

    gaussians = Gaussians(
        tensor("means3d", count, 3),
        tensor("quats", count, 4),
        tensor("scales", count, 3),
        tensor("opacities", count),
        tensor("colors", count, 3, unit=255 if inputs["colors"].dtype.kind in "iu" else 1),
    )
    width, height = (float(tensor(name)) for name in ("width", "height"))
    if not (width.is_integer() and height.is_integer() and min(width, height) >= 1):
        raise DataError(f"{path}: an image of {width:g} x {height:g} pixels cannot be drawn")
    cameras = Cameras(tensor("viewmats", views, 4, 4), tensor("Ks", views, 3, 3), (int(height), int(width)))
    return gaussians, cameras, [name for name in DEFAULTS if name not in arrays]


def _arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except Exception as error:  # zipfile, zlib and numpy may raise anything for a broken archive
        raise DataError(f"{path} is not an .npz file of plain arrays: {error}") from error


SAMPLING_SECONDS = 2e-3
MEBIBYTE = 2**20


def milliseconds(rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras) -> tuple[float, float]:
    """Return the times of the forward pass, and of both passes with gradients to all parameters of the Gaussians."""
    gaussians = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    ones = [_ones(cameras, channels) for channels in (3, 1, 1)]
    wait = torch.cuda.synchronize if gaussians.means.is_cuda else _nothing
    wait()
    start = time.perf_counter()
    rendering = rasterizer(gaussians, cameras)
    wait()
    middle = time.perf_counter()
    torch.autograd.backward([rendering.color, rendering.depth, rendering.alpha], ones)
    wait()
    return (middle - start) * 1e3, (time.perf_counter() - start) * 1e3


def _ones(cameras: Cameras, channels: int) -> Tensor:
    # NumPy, because torch would wake its own threads, which then spin for a while on the cores that are timed.
    ones = np.ones((*cameras.intrinsics.shape[:2], channels, *cameras.image_size), np.float32)
    return torch.from_numpy(ones).to(cameras.intrinsics.device)


def _nothing() -> None: ...


def peak_megabytes(work: Callable[[], object], device: str) -> float | None:
    """Return the memory in MB that `work` adds to the process, or to the GPU; None if the system does not tell.

    The memory of the process is read from /proc every 2 ms, and once more at the end.
    """
    _return_free_memory()
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        work()
        return (torch.cuda.max_memory_allocated() - before) / MEBIBYTE
    statm = Path("/proc/self/statm")
    if not statm.exists():
        work()
        return None
    samples: list[int] = []
    started, done = threading.Event(), threading.Event()

    def watch() -> None:
        last = False
        while not last:
            last = done.is_set()
            samples.append(int(statm.read_text().split()[1]))
            started.set()
            done.wait(SAMPLING_SECONDS)

    watcher = threading.Thread(target=watch)
    watcher.start()
    started.wait()
    try:
        work()
    finally:
        done.set()
        watcher.join()
    return (max(samples) - samples[0]) * mmap.PAGESIZE / MEBIBYTE


def _return_free_memory() -> None:
    """Return memory that the process still holds after freeing it, because reusing it would not be counted."""
    release()
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)  # a function of glibc


MOST_REFERENCE_PAIRS = 2**28  # of a Gaussian and a pixel; the reference takes a second for a tenth of them


@dataclass(frozen=True)
class Backend:
    """A rasterizer, its name in the tables, and the device of its tensors."""

    name: str
    rasterizer: Rasterizer

    @property
    def device(self) -> str:
        return "cuda" if self.name == "cuda" else "cpu"

    def takes(self, gaussians: int, pixels: int) -> bool:
        """Return whether a workload with this many pixels in all views is feasible."""
        return self.name != "reference" or gaussians * pixels <= MOST_REFERENCE_PAIRS
