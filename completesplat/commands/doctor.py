"""`completesplat doctor`: a report of what this machine has and lacks, and whether `predict` works on it."""

import os
import platform
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal, NamedTuple

from omegaconf import DictConfig
from packaging.requirements import Requirement
from rich.console import Console
from rich.filesize import decimal
from rich.table import Table
from rich.text import Text

from completesplat.data.rendered.blender import find_blender
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.files import write_json
from completesplat.version import __version__
from completesplat.weights import SHIPPED, SUMS_FILE, check_folder

EXTRAS = {
    "cuda": "to draw on an NVIDIA GPU",
    "view": "to show scenes in a browser",
    "background": "to cut objects out of photos",
    "grabcut": "to cut them out roughly, by colour, without a download",
    "mesh": "to write meshes",
    "heic": "to read the photos of iPhones",
    "colmap": "to find cameras of photos, to read captures whose lens distorts",
    "slurm": "to spread sweeps over a cluster",
    "perceptual": "to train on perceptual features without a download",
}
DEVICES = {
    "cuda": "networks and splats of all verbs",
    "mps": "networks of all verbs but plan, report and hidden modes, whose splats the CPU draws (tiled). Not run yet;"
    " PYTORCH_ENABLE_MPS_FALLBACK=1 has the CPU compute what MPS lacks",
    "cpu": "all networks and splats",
}
STYLES = {"yes": "green", "no": "yellow", "broken": "bold red"}
LEAST_SPACE = 100_000_000  # bytes that the files of a few predictions take


class Finding(NamedTuple):
    """Result of one check: present ("yes"), absent but not necessary ("no"), or "broken", which stops predictions.

    `details` are a version, a place, or the reason and what to do.
    """

    name: str
    state: Literal["yes", "no", "broken"]
    details: str


def check_packages() -> Iterator[Finding]:
    """Yield the versions of Python and this package, and the packages that it requires."""
    yield Finding("completesplat", "yes", f"{__version__}, Python {platform.python_version()} on {platform.system()}")
    try:
        yield from required_packages(map(Requirement, requires("completesplat") or ()))
    except PackageNotFoundError:
        message = "runs from its source without being installed; `pip install -e .` there also fetches what it needs"
        yield Finding("installation", "no", message)


def required_packages(requirements: Iterable[Requirement]) -> Iterator[Finding]:
    """Yield missing and mismatched packages, without those of extras, and the number of the others."""
    others = 0
    for requirement in requirements:
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            installed = version(requirement.name)
        except PackageNotFoundError:
            message = f'missing; `pip install "{requirement.name}{requirement.specifier}"`'
            yield Finding(requirement.name, "broken", message)
            continue
        if requirement.specifier.contains(installed, prereleases=True):
            others += 1
        else:
            message = f"{installed}, which is not {requirement.specifier}: it may or may not work"
            yield Finding(requirement.name, "no", message)
    yield Finding("packages", "yes", f"{others} in versions that fit")


def check_extras(requirements: Iterable[str] | None = None) -> Iterator[Finding]:
    """Yield the packages of each extra, as `EXTRA: PACKAGE`; one that is not installed is no error."""
    lines = requires("completesplat") or () if requirements is None else requirements
    for requirement in map(Requirement, lines):
        for extra, purpose in EXTRAS.items():
            if requirement.marker is not None and requirement.marker.evaluate({"extra": extra}):
                name = f"{extra}: {requirement.name}"
                try:
                    yield Finding(name, "yes", f"{version(requirement.name)}: {purpose}")
                except PackageNotFoundError:
                    yield Finding(name, "no", f'{purpose}: `pip install "completesplat[{extra}]"`')


def check_imports() -> Iterator[Finding]:
    """Import the modules that compute and write a prediction; their exceptions are not caught here."""
    for module in ("completesplat.generator", "completesplat.export.prediction"):
        import_module(module)
    yield Finding("networks, files", "yes", "all that completing a photo imports")


def check_device() -> Iterator[Finding]:
    """Yield CPU, GPUs, what runs where, and rasterizers. A missing GPU is no error: small models are fast without."""
    import torch

    from completesplat.evaluation.provenance import machine
    from completesplat.rasterizers.selection import FASTER, failure
    from completesplat.tensors import used_device

    yield Finding("CPU", "yes", f"{machine()['processor']}, {os.cpu_count()} cores")
    waits = [f"{name}={os.environ[name]}" for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY") if name in os.environ]
    yield Finding("threads", "yes", f"{torch.get_num_threads()} of torch's; {', '.join(waits)}")
    for index in range(torch.cuda.device_count()):
        free, total = map(decimal, torch.cuda.mem_get_info(index))
        yield Finding(f"GPU {index}", "yes", f"{torch.cuda.get_device_name(index)}, {free} of {total} free")
    if not torch.cuda.is_available():
        built = f"for CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
        reason = f"torch {torch.__version__}, built {built}, finds none (nvidia-smi shows the driver's)"
        yield Finding("GPU", "no", f"{reason}; all works on the CPU, slower")
    device = used_device()
    yield Finding("used device", "yes", f"{device}: {DEVICES[device]}")
    for name in FASTER:
        fault = failure(name, None)
        message = "a test rendering agrees with the reference" if fault is None else fault
        yield Finding(f"rasterizer {name}", "yes" if fault is None else "no", message)


def check_weights(folder: Path = SHIPPED) -> Iterator[Finding]:
    """Yield the weights that come with the package, in subfolders of `folder`."""
    for path in sorted(path.parent for path in folder.glob(f"*/{SUMS_FILE}")):
        try:
            check_folder(path)
            yield Finding(path.name, "yes", f"with the package: predict weights={path.name}")
        except WeightsError as error:
            yield Finding(path.name, "broken", f"{error}; install completesplat again")


def check_tools(place: Path) -> Iterator[Finding]:
    """Yield ffmpeg (a package brings it), Node.js (for exports), Blender (for meshes) and the free space of a disk."""
    try:
        import imageio_ffmpeg

        yield Finding("ffmpeg", "yes", imageio_ffmpeg.get_ffmpeg_exe())
    except Exception as error:  # the program is missing or cannot be run
        yield Finding("ffmpeg", "broken", f"{error}; for videos, `pip install --force-reinstall imageio-ffmpeg`")
    node = shutil.which("splat-transform") or shutil.which("npx")
    advice = "formats spz, sog and html need Node.js 20 or newer with npm: https://nodejs.org"
    yield Finding("node", "yes" if node else "no", node or advice)
    try:
        blender = find_blender()
        yield Finding("blender", "yes", f"{blender.version}, {blender.command[0]}: to render meshes (data render)")
    except CompleteSplatError as error:
        yield Finding("blender", "no", f"data render needs it: {error}")
    free = shutil.disk_usage(place).free
    short = ": too little for a prediction's files" if free < LEAST_SPACE else ""
    yield Finding("free disk", "broken" if short else "yes", f"{decimal(free)} in {place}{short}")


def run(config: DictConfig, out: Path) -> None:
    """Print the table and write `doctor.json`; exit with status 1 if something that a prediction needs is broken."""
    checks = {"packages": check_packages, "extras": check_extras, "imports": check_imports, "device": check_device}
    checks |= {"weights": check_weights, "tools": lambda: check_tools(Path.cwd())}
    table = Table("part", "what", "here", "which, or why not", title="completesplat doctor", title_justify="left")
    rows = []
    broken = []
    for part, check in checks.items():
        for finding in findings_of(check):
            rows.append({"part": part, **finding._asdict()})
            table.add_row(part, Text(finding.name), Text(finding.state, STYLES[finding.state]), Text(finding.details))
            if finding.state == "broken":
                broken.append(f"{part}, {finding.name}: {finding.details}")
        table.add_section()
    write_json(out / "doctor.json", {"works": not broken, "findings": rows})
    Console(width=None if Console().is_terminal else 160).print(table)
    if broken:
        print("broken: " + "; ".join(broken))
        print(out)
        sys.exit(1)
    print("Nothing that completing a photo needs is broken.")


def findings_of(check: Callable[[], Iterable[Finding]]) -> list[Finding]:
    """Run a check; an exception, such as that of a failing import, becomes a finding."""
    try:
        return list(check())
    except Exception as error:  # of any library: the other checks still run
        return [Finding("check", "broken", " ".join(f"{type(error).__name__}: {error}".split())[:200])]
