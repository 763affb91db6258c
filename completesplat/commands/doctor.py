"""`completesplat doctor`: a report of what this machine has and lacks, and whether `predict` can work on it."""

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any, Literal

from omegaconf import OmegaConf
from packaging.requirements import Requirement
from rich.console import Console
from rich.table import Table
from rich.text import Text

from completesplat import __version__
from completesplat.commands.protocol import write_json
from completesplat.settings.options import conf_folder

ALWAYS_SHOWN = ("torch", "lightning", "hydra-core", "numba", "diffusers", "wandb")
EXTRAS = {
    "cuda": "draws on an NVIDIA GPU",
    "view": "shows scenes in a browser, live",
    "colmap": "reads captures whose lens distorts",
    "slurm": "spreads sweeps over a cluster",
}
OWN_PARTS = "completesplat.commands.doctor_checks"
STYLES = {"yes": "green", "no": "yellow", "broken": "bold red"}
LEAST_SPACE = 100e6
"""Bytes that the files of a few predictions take."""


@dataclass(frozen=True)
class Finding:
    """Result of one check: present ("yes"), absent but not necessary ("no"), or "broken", which stops predictions.

    `said` is a version, a place, or the reason and what to do.
    """

    name: str
    state: Literal["yes", "no", "broken"]
    said: str


def one_line(error: BaseException) -> str:
    """Return an exception's type and message, without line breaks and of limited length."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}".removesuffix(": ")


def size(count: float) -> str:
    """Format bytes as `3.2 GB`, `14.1 MB`, `0.3 MB`."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"


def check_packages() -> Iterator[Finding]:
    """Yield the versions of Python, this package and the packages that it requires."""
    yield Finding("completesplat", "yes", __version__)
    yield Finding("python", "yes", f"{platform.python_version()} on {platform.system()}")
    try:
        needed = [Requirement(line) for line in requires("completesplat") or ()]
    except PackageNotFoundError:
        message = "runs from its source without being installed; `pip install -e .` there also fetches what it needs"
        yield Finding("installation", "no", message)
        return
    yield from needed_packages(requirement for requirement in needed if applies(requirement, ""))


def check_extras() -> Iterator[Finding]:
    """Yield the packages of each extra; nothing where this package is not installed."""
    with suppress(PackageNotFoundError):
        lines = [Requirement(line) for line in requires("completesplat") or ()]
        for name, gives in EXTRAS.items():
            yield from extra_packages(name, gives, lines)


def check_imports() -> Iterator[Finding]:
    """Import the modules that compute and write a prediction; their exceptions are not caught here."""
    for module in ("completesplat.generator", "completesplat.export.prediction"):
        import_module(module)
    yield Finding("networks, files", "yes", "all that completing a photograph imports")


def applies(requirement: Requirement, extra: str) -> bool:
    """Return whether this machine needs a package for an extra, or without any (`""`)."""
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def needed_packages(needed: Iterable[Requirement]) -> Iterator[Finding]:
    """Yield one finding for each well-known, missing or mismatched package, and one that counts all others."""
    lines, others = [], 0
    for requirement in needed:
        installed = _version(requirement)
        if installed is None:
            message = f'missing; `pip install "{requirement.name}{requirement.specifier}"`'
            lines.append(Finding(requirement.name, "broken", message))
        elif not requirement.specifier.contains(installed, prereleases=True):
            message = f"{installed}, which is not {requirement.specifier}: it may or may not work"
            lines.append(Finding(requirement.name, "no", message))
        elif requirement.name in ALWAYS_SHOWN:
            lines.append(Finding(requirement.name, "yes", installed))
        else:
            others += 1
    yield from sorted(lines, key=lambda line: line.name not in ALWAYS_SHOWN)
    yield Finding("others", "yes", f"{others} more, in versions that fit")


def extra_packages(name: str, gives: str, requirements: Iterable[Requirement]) -> Iterator[Finding]:
    """Yield one finding for each package of an extra; a package that is not installed is no error."""
    for requirement in requirements:
        if applies(requirement, name) and not applies(requirement, ""):
            installed = _version(requirement)
            message = f"{installed}: {gives}" if installed else f'{gives}: pip install "completesplat[{name}]"'
            yield Finding(requirement.name, "yes" if installed else "no", message)


def _version(requirement: Requirement) -> str | None:
    try:
        return version(requirement.name)
    except PackageNotFoundError:
        return None


def check_device() -> Iterator[Finding]:
    """Yield CPU, memory and GPUs. A missing GPU is no error: small models draw samples in seconds without one."""
    import torch

    from completesplat.results.machine import machine

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield Finding("processor", "yes", f"{machine()['processor']}, {cores} cores to use")
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        yield Finding("memory", "yes", size(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")))
    if not torch.cuda.is_available():
        yield Finding("GPU", "no", no_gpu())
        return
    for index in range(torch.cuda.device_count()):
        free, total = torch.cuda.mem_get_info(index)
        yield Finding(f"GPU {index}", "yes", f"{torch.cuda.get_device_name(index)}, {size(free)} of {size(total)} free")


def no_gpu() -> str:
    """Return the reason why torch sees no GPU."""
    import torch

    if torch.version.cuda is None:
        return f"this torch ({torch.__version__}) is built without CUDA; all works on the processor, slower"
    if shutil.which("nvidia-smi") is None:
        return "no NVIDIA driver here (there is no nvidia-smi); all works on the processor, slower"
    return f"torch for CUDA {torch.version.cuda} finds none; `nvidia-smi` says what the driver sees"


def check_data(conf: Path, place: Path) -> Iterator[Finding]:
    """Yield the data sets in `conf`, with roots relative to `place`; they are needed to train, not to predict."""
    for path in sorted(conf.glob("*.yaml")):
        config = OmegaConf.to_container(OmegaConf.load(path))
        # A config without a root inherits one, or cannot be chosen.
        if not isinstance(config, dict) or "root" not in config:
            continue
        name, root = path.stem, str(config["root"])
        if root == "???":
            yield Finding(name, "no", f"has no place of its own: data={name} data.root=FOLDER")
        elif (place / root).is_dir():
            yield Finding(name, "yes", f"{root}: {len(os.listdir(place / root))} entries")
        else:
            made, elsewhere = "made there when it is first used", f"data={name} data.root=FOLDER names another place"
            yield Finding(name, "no", f"not in {root}; {made if 'data_seed' in config else elsewhere}")


def check_tools(place: Path) -> Iterator[Finding]:
    """Yield ffmpeg (for videos; a package brings it), Node.js (for exports only) and free space on `place`'s disk."""
    from completesplat.export.splat_transform import PACKAGE, PROGRAM

    yield _ffmpeg()
    yield _node(PROGRAM)
    path = shutil.which(PROGRAM)
    how = "npx fetches it when they are asked for" if shutil.which("npx") else "first Node.js with npm"
    message = f"for formats spz, sog and html: `npm install -g {PACKAGE}`, or {how}"
    yield Finding(PROGRAM, "yes" if path else "no", path or message)
    free = shutil.disk_usage(place).free
    short = ": too little for a prediction's files" if free < LEAST_SPACE else ""
    yield Finding("free disk", "broken" if short else "yes", f"{size(free)} in {place}{short}")


def _ffmpeg() -> Finding:
    try:
        import imageio_ffmpeg

        message = f"{imageio_ffmpeg.get_ffmpeg_version()}, {imageio_ffmpeg.get_ffmpeg_exe()}"
    except Exception as error:  # the program is missing, cannot be run, or prints nothing
        message = f"{one_line(error)}; for videos, `pip install --force-reinstall imageio-ffmpeg`"
        return Finding("ffmpeg", "broken", message)
    return Finding("ffmpeg", "yes", message)


def _node(program: str) -> Finding:
    path = shutil.which("node")
    if path is None:
        return Finding("node", "no", f"version 20 or newer runs {program}: https://nodejs.org")
    try:
        printed = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=10, check=True).stdout
    except (OSError, subprocess.SubprocessError) as error:
        return Finding("node", "no", f"{path} does not run: {one_line(error)}")
    return Finding("node", "yes", f"{printed.strip()}, {path}")


def run(config: Any, out: Path) -> None:
    """Print the table and write `doctor.json`; exit with status 1 if something that a prediction needs is broken."""
    findings: dict[str, Sequence[Finding]] = {}
    with Console(stderr=True).status("looking") as status:
        for part, check in checks(Path.cwd()).items():
            status.update(f"looking at: {part}")
            findings[part] = findings_of(check)
    rows = [{"part": part, **vars(finding)} for part, part_findings in findings.items() for finding in part_findings]
    broken = [f"{row['part']}, {row['name']}: {row['said']}" for row in rows if row["state"] == "broken"]
    write_json(out / "doctor.json", {"works": not broken, "findings": rows})
    show(findings)
    if broken:
        print("broken: " + "; ".join(broken))
        print(out)
        sys.exit(1)
    print("Nothing that completing a photograph needs is broken.")


def checks(place: Path) -> dict[str, Callable[[], Iterable[Finding]]]:
    """Return the checks by the part of the machine that they examine, in the order of the table."""
    return {
        "packages": check_packages,
        "extras": check_extras,
        "imports": check_imports,
        "device": check_device,
        # These need other modules of the package, which are imported only when the check runs.
        "rasterizers": lambda: import_module(OWN_PARTS).check_rasterizers(),
        "weights": lambda: import_module(OWN_PARTS).check_weights(),
        "data": lambda: check_data(conf_folder() / "data", place),
        "tools": lambda: check_tools(place),
    }


def findings_of(check: Callable[[], Iterable[Finding]]) -> list[Finding]:
    """Run a check; an exception, such as that of a failing import, becomes a finding."""
    try:
        return list(check())
    except Exception as error:  # of any library: the other checks still run
        return [Finding("check", "broken", one_line(error))]


def show(findings: Mapping[str, Sequence[Finding]]) -> None:
    """Print the table, with a rule between the parts."""
    table = Table(title="completesplat doctor", title_justify="left")
    for heading in ("part", "what", "here", "which, or why not"):
        table.add_column(heading, overflow="fold")
    for part, part_findings in findings.items():
        for index, finding in enumerate(part_findings):
            state = Text(finding.state, style=STYLES[finding.state])
            table.add_row("" if index else part, Text(finding.name), state, Text(finding.said))
        table.add_section()
    Console(width=None if Console().is_terminal else 160).print(table)
