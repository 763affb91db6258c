"""`completesplat doctor`: a report of what this machine has and lacks, and whether `predict` works on it."""

import os
import platform
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

from omegaconf import DictConfig
from packaging.requirements import Requirement
from rich.console import Console
from rich.filesize import decimal
from rich.table import Table
from rich.text import Text

from completesplat import __version__
from completesplat.commands.protocol import write_json
from completesplat.errors import WeightsError
from completesplat.weights import SHIPPED, SUMS_FILE, WEIGHTS_FILE, check_folder

ALWAYS_NAMED = ("torch", "lightning", "hydra-core", "numba", "diffusers", "wandb")
EXTRAS = {"cuda": "to draw on an NVIDIA GPU", "view": "to show scenes in a browser, live"}
EXTRAS |= {"colmap": "to read captures whose lens distorts", "slurm": "to spread sweeps over a cluster"}
STYLES = {"yes": "green", "no": "yellow", "broken": "bold red"}
LEAST_SPACE = 100_000_000
"""Bytes that the files of a few predictions take."""


@dataclass(frozen=True)
class Finding:
    """Result of one check: present ("yes"), absent but not necessary ("no"), or "broken", which stops predictions.

    `details` are a version, a place, or the reason and what to do.
    """

    name: str
    state: Literal["yes", "no", "broken"]
    details: str


def check_packages() -> Iterator[Finding]:
    """Yield the versions of Python and this package, and the findings of `required_packages`."""
    yield Finding("completesplat", "yes", __version__)
    yield Finding("python", "yes", f"{platform.python_version()} on {platform.system()}")
    try:
        yield from required_packages([Requirement(line) for line in requires("completesplat") or ()])
    except PackageNotFoundError:
        message = "runs from its source without being installed; `pip install -e .` there also fetches what it needs"
        yield Finding("installation", "no", message)


def required_packages(requirements: Iterable[Requirement]) -> Iterator[Finding]:
    """Yield well-known, missing and mismatched packages and those of extras; count the others."""
    others = 0
    for requirement in requirements:
        name, marker = requirement.name, requirement.marker
        extra = next((key for key in ("", *EXTRAS) if marker is None or marker.evaluate({"extra": key})), None)
        if extra is None:  # for another system, or for developers
            continue
        try:
            installed = version(name)
        except PackageNotFoundError:
            package = f"completesplat[{extra}]" if extra else f"{name}{requirement.specifier}"
            message = f'missing; `pip install "{package}"`{f" {EXTRAS[extra]}" if extra else ""}'
            yield Finding(name, "no" if extra else "broken", message)
            continue
        if not requirement.specifier.contains(installed, prereleases=True):
            yield Finding(name, "no", f"{installed}, which is not {requirement.specifier}: it may or may not work")
        elif extra or name in ALWAYS_NAMED:
            yield Finding(name, "yes", installed)
        else:
            others += 1
    yield Finding("others", "yes", f"{others} more, in versions that fit")


def check_imports() -> Iterator[Finding]:
    """Import the modules that compute and write a prediction; their exceptions are not caught here."""
    for module in ("completesplat.generator", "completesplat.export.prediction"):
        import_module(module)
    yield Finding("networks, files", "yes", "all that completing a photo imports")


def check_device() -> Iterator[Finding]:
    """Yield CPU and GPUs. A missing GPU is no error: small models draw samples in seconds without one."""
    import torch

    from completesplat.results.machine import machine

    yield Finding("CPU", "yes", f"{machine()['processor']}, {os.cpu_count()} cores")
    for index in range(torch.cuda.device_count()):
        free, total = map(decimal, torch.cuda.mem_get_info(index))
        yield Finding(f"GPU {index}", "yes", f"{torch.cuda.get_device_name(index)}, {free} of {total} free")
    if not torch.cuda.is_available():
        built = f"for CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
        reason = f"torch {torch.__version__}, built {built}, finds none (nvidia-smi shows the driver's)"
        yield Finding("GPU", "no", f"{reason}; all works on the CPU, slower")


def check_rasterizers() -> Iterator[Finding]:
    """Yield the rasterizers that may not work here, fastest first; `reference` needs nothing but torch."""
    from completesplat.rasterizers.selection import FASTER, failure

    reasons = {name: failure(name, None) for name in FASTER}
    for name, reason in reasons.items():
        yield Finding(name, "no" if reason else "yes", reason or "a test rendering agrees with the reference")
    if all(reasons.values()):
        yield Finding("reference", "yes", "draws everything here, which is very slow")


def check_weights(folder: Path = SHIPPED) -> Iterator[Finding]:
    """Yield the weights that come with the package, in subfolders of `folder`."""
    for path in sorted(path for path in folder.iterdir() if (path / SUMS_FILE).is_file()):
        try:
            check_folder(path)
            size = decimal((path / WEIGHTS_FILE).stat().st_size)
            yield Finding(path.name, "yes", f"with the package, {size}: predict weights={path.name}")
        except WeightsError as error:
            yield Finding(path.name, "broken", f"{error}; install completesplat again")


def check_tools(place: Path) -> Iterator[Finding]:
    """Yield ffmpeg (for videos; a package brings it), programs for exports, and free space on `place`'s disk."""
    from completesplat.export.splat_transform import PACKAGE, PROGRAM

    try:
        import imageio_ffmpeg

        yield Finding("ffmpeg", "yes", f"{imageio_ffmpeg.get_ffmpeg_version()}, {imageio_ffmpeg.get_ffmpeg_exe()}")
    except Exception as error:  # the program is missing, cannot be run, or prints nothing
        message = f"{_one_line(error)}; for videos, `pip install --force-reinstall imageio-ffmpeg`"
        yield Finding("ffmpeg", "broken", message)
    missing = {"node": f"version 20 or newer runs {PROGRAM}: https://nodejs.org"}
    missing[PROGRAM] = f"for formats spz, sog and html: `npm install -g {PACKAGE}`; npx also fetches it when needed"
    for program, message in missing.items():
        path = shutil.which(program)
        yield Finding(program, "yes" if path else "no", path or message)
    free = shutil.disk_usage(place).free
    short = ": too little for a prediction's files" if free < LEAST_SPACE else ""
    yield Finding("free disk", "broken" if short else "yes", f"{decimal(free)} in {place}{short}")


def _one_line(error: BaseException) -> str:
    """Return an exception's type and message, without line breaks and of limited length."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}".removesuffix(": ")


def run(config: DictConfig, out: Path) -> None:
    """Print the table and write `doctor.json`; exit with status 1 if something that a prediction needs is broken."""
    checks: dict[str, Callable[[], Iterable[Finding]]] = {
        "packages": check_packages,
        "imports": check_imports,
        "device": check_device,
        "rasterizers": check_rasterizers,
        "weights": check_weights,
        "tools": lambda: check_tools(Path.cwd()),
    }
    table = Table(title="completesplat doctor", title_justify="left")
    for heading in ("part", "what", "here", "which, or why not"):
        table.add_column(heading, overflow="fold")
    rows = []
    for part, check in checks.items():
        for index, finding in enumerate(findings_of(check)):
            rows.append({"part": part, **vars(finding)})
            state = Text(finding.state, style=STYLES[finding.state])
            table.add_row("" if index else part, Text(finding.name), state, Text(finding.details))
        table.add_section()
    broken = [f"{row['part']}, {row['name']}: {row['details']}" for row in rows if row["state"] == "broken"]
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
        return [Finding("check", "broken", _one_line(error))]
