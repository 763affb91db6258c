"""`completesplat doctor`: versions, backends and optional programs of this machine, a line each."""

import os
import platform
import shutil
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from omegaconf import DictConfig
from packaging.requirements import Requirement

from completesplat.data.rendered.blender import find_blender
from completesplat.errors import CompleteSplatError
from completesplat.files import write_json
from completesplat.installation import install_command
from completesplat.settings.extensions import installed
from completesplat.version import __version__

EXTRAS = {
    "cuda": "to draw on an NVIDIA GPU",
    "view": "to show scenes in a browser",
    "background": "to cut objects out of photos",
    "grabcut": "to cut them out roughly, by colour, without a download",
    "mesh": "to write meshes",
    "usd": "to write usdz",
    "render": "to render meshes without Blender",
    "colmap": "to find cameras of photos, to read captures whose lens distorts",
    "slurm": "to spread sweeps over a cluster",
    "optuna": "to search for good settings",
    "tensorboard": "to log to TensorBoard",
    "perceptual": "to train on perceptual features without a download",
}
LIBRARIES = ("torch", "lightning", "hydra-core", "diffusers", "numpy", "numba")


def run(config: DictConfig, out: Path) -> None:
    """Print all lines, and write them to `doctor.json`."""
    lines: dict[str, str] = {}
    for check in (versions, devices, rasterizers, extras, extensions, programs):
        lines.update(findings(check))
    write_json(out / "doctor.json", lines)
    for name, text in lines.items():
        print(f"{name:24} {text}")


def findings(check: Callable[[], Iterator[tuple[str, str]]]) -> Mapping[str, str]:
    """Return the lines of a check by name.

    An exception of any library is the line of the check that it ends.
    """
    lines = {}
    try:
        for name, text in check():
            lines[name] = text
    except Exception as error:  # the other checks still run
        lines[check.__name__] = "broken: " + " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return lines


def versions() -> Iterator[tuple[str, str]]:
    """Yield the versions of this package, Python and the libraries that matter most."""
    yield "completesplat", __version__
    yield "python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    for name in LIBRARIES:
        yield name, _version(name) or f"missing: pip install {name}"


def devices() -> Iterator[tuple[str, str]]:
    """Yield CPU and GPUs, and where networks compute."""
    import torch

    from completesplat.evaluation.provenance import machine
    from completesplat.tensors import used_device

    threads = f"{os.cpu_count()} cores, {torch.get_num_threads()} threads of torch"
    yield "cpu", f"{machine()['processor']}, {threads}"
    for index in range(torch.cuda.device_count()):
        free, total = torch.cuda.mem_get_info(index)
        memory = f"{free / 1e9:.1f} of {total / 1e9:.1f} GB free"
        yield f"gpu {index}", f"{torch.cuda.get_device_name(index)}, {memory}"
    if not torch.cuda.is_available():
        built = f"for CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
        yield "gpu", f"none: torch is built {built} (nvidia-smi shows the driver); all works on the CPU, slower"
    yield "used device", used_device()


def rasterizers() -> Iterator[tuple[str, str]]:
    """Yield each fast backend: whether a test rendering of it is right, or why it cannot be used."""
    from completesplat.rasterizers.selection import FASTER, failure

    for name in FASTER:
        reason = failure(name, None)
        works = "works: a test rendering agrees with the reference"
        yield f"rasterizer {name}", works if reason is None else f"not used: {reason}"


def extras() -> Iterator[tuple[str, str]]:
    """Yield each extra with the versions of its packages, or how to install it."""
    requirements = [Requirement(line) for line in requires("completesplat") or ()]
    for extra, purpose in EXTRAS.items():
        names = [x.name for x in requirements if x.marker is not None and x.marker.evaluate({"extra": extra})]
        missing = [name for name in names if _version(name) is None]
        if missing:
            yield f"extra {extra}", f"missing, {purpose}: {install_command(extra)}"
        else:
            yield f"extra {extra}", ", ".join(f"{name} {_version(name)}" for name in names)


def extensions() -> Iterator[tuple[str, str]]:
    """Yield each extension with its options."""
    for extension in installed().extensions:
        listed = [f"{file.parent.name}={file.stem}" for file in sorted(extension.conf.glob("*/[!_]*.yaml"))]
        yield f"extension {extension.name}", f"{extension.version}: {', '.join(listed)}"
    for name, reason in installed().broken.items():
        yield f"extension {name}", f"broken: {reason}"


def programs() -> Iterator[tuple[str, str]]:
    """Yield ffmpeg, which a package brings, and the programs that some formats and data need."""
    import imageio_ffmpeg

    yield "ffmpeg", imageio_ffmpeg.get_ffmpeg_exe()
    node = shutil.which("splat-transform") or shutil.which("npx")
    yield "node", node or "missing, for the formats sog and html: Node.js 20 or newer with npm, https://nodejs.org"
    try:
        blender = find_blender()
        yield "blender", f"{blender.version}, {blender.command[0]}"
    except CompleteSplatError as error:
        yield "blender", f"missing, for data render: {error}"


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
