"""`completesplat doctor`: what this machine has, what it lacks, and whether completing a photograph can work."""

import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any, Literal

from omegaconf import OmegaConf
from packaging.requirements import Requirement

from completesplat import __version__

State = Literal["yes", "no", "broken"]


@dataclass(frozen=True)
class Finding:
    """One thing that was found, is missing or is broken.

    Args:
        part: of the machine, the same for lines that belong together.
        name: of the thing.
        state: `broken` is what completing a photograph needs and does not have; `no` is no error.
        said: a version, a place, or the reason and what to do.
    """

    part: str
    name: str
    state: State
    said: str


def one_line(error: BaseException) -> str:
    """An exception's kind and message, without line breaks and not too long."""
    message = " ".join(str(error).split())
    return f"{type(error).__name__}: {message[:200]}" if message else type(error).__name__


def size(count: float) -> str:
    """Bytes as `3.2 GB`, `14.1 MB`, `0.3 MB`."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"


PACKAGES_PART, EXTRAS_PART = "packages", "extras"
ALWAYS_SHOWN = ("torch", "lightning", "hydra-core", "numba", "diffusers", "wandb")
EXTRAS = {
    "cuda": "draws on an NVIDIA GPU",
    "view": "shows scenes in a browser, live",
    "colmap": "imports captures of your own",
    "slurm": "spreads sweeps over a cluster",
}


def check_packages() -> list[Finding]:
    """Versions of what is needed, and what each extra would give."""
    found = [
        Finding(PACKAGES_PART, "completesplat", "yes", __version__),
        Finding(PACKAGES_PART, "python", "yes", f"{platform.python_version()} on {platform.system()}"),
    ]
    try:
        requirements = [Requirement(line) for line in requires("completesplat") or ()]
    except PackageNotFoundError:
        said = "runs from its source without being installed; `pip install -e .` there also fetches what it needs"
        return [*found, Finding(PACKAGES_PART, "installation", "no", said)]
    extras = [line for name, gives in EXTRAS.items() for line in extra_packages(name, gives, requirements)]
    return [*found, *needed_packages(one for one in requirements if applies(one, "")), *extras]


def check_imports() -> list[Finding]:
    """Whether what draws and writes a prediction can be imported, which needs more than that packages are there.

    Raises:
        Exception: of any kind, whatever stands in the way.
    """
    for module in ("completesplat.generation", "completesplat.export.prediction"):
        import_module(module)
    return [Finding("imports", "networks, files", "yes", "all that completing a photograph imports")]


def applies(requirement: Requirement, extra: str) -> bool:
    """Whether a package is needed here for an extra, "" for none."""
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def needed_packages(needed: Iterable[Requirement]) -> list[Finding]:
    """A line for each of the best known and for each that is missing or of another version; one for all others."""
    lines, others = [], 0
    for requirement in needed:
        found = _version(requirement)
        if found is None:
            said = f'missing; `pip install "{requirement.name}{requirement.specifier}"`'
            lines.append(Finding(PACKAGES_PART, requirement.name, "broken", said))
        elif not requirement.specifier.contains(found, prereleases=True):
            said = f"{found}, which is not {requirement.specifier}: it may or may not work"
            lines.append(Finding(PACKAGES_PART, requirement.name, "no", said))
        elif requirement.name in ALWAYS_SHOWN:
            lines.append(Finding(PACKAGES_PART, requirement.name, "yes", found))
        else:
            others += 1
    lines.sort(key=lambda line: line.name not in ALWAYS_SHOWN)
    return [*lines, Finding(PACKAGES_PART, "others", "yes", f"{others} more, in versions that fit")]


def extra_packages(name: str, gives: str, requirements: Iterable[Requirement]) -> list[Finding]:
    """A line for each package of an extra; one that is not installed is no error."""
    lines = []
    for requirement in requirements:
        if applies(requirement, "") or not applies(requirement, name):
            continue
        found = _version(requirement)
        said = f"{found}: {gives}" if found else f'{gives}: pip install "completesplat[{name}]"'
        lines.append(Finding(EXTRAS_PART, requirement.name, "yes" if found else "no", said))
    return lines


def _version(requirement: Requirement) -> str | None:
    try:
        return version(requirement.name)
    except PackageNotFoundError:
        return None


DEVICE_PART = "device"


def check_device() -> list[Finding]:
    """A GPU that is not there is no error: small models draw in seconds without."""
    import torch

    from completesplat.results.machine import machine

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    found = [Finding(DEVICE_PART, "processor", "yes", f"{machine()['processor']}, {cores} cores to use")]
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        found.append(Finding(DEVICE_PART, "memory", "yes", size(memory)))
    if not torch.cuda.is_available():
        return [*found, Finding(DEVICE_PART, "GPU", "no", no_gpu())]
    for index in range(torch.cuda.device_count()):
        free, total = torch.cuda.mem_get_info(index)
        said = f"{torch.cuda.get_device_name(index)}, {size(free)} of {size(total)} free"
        found.append(Finding(DEVICE_PART, f"GPU {index}", "yes", said))
    return found


def no_gpu() -> str:
    """Why torch sees none."""
    import torch

    if torch.version.cuda is None:
        return f"this torch ({torch.__version__}) is built without CUDA; all works on the processor, slower"
    if shutil.which("nvidia-smi") is None:
        return "no NVIDIA driver here (there is no nvidia-smi); all works on the processor, slower"
    return f"torch for CUDA {torch.version.cuda} finds none; `nvidia-smi` says what the driver sees"


DATA_PART = "data"


def check_data(conf: Path, place: Path) -> list[Finding]:
    """Data are needed to train, not to complete a photograph.

    Args:
        conf: the folder of the data sets' configurations.
        place: the folder that relative roots start from.
    """
    found = []
    for path in sorted(conf.glob("*.yaml")):
        config = OmegaConf.to_container(OmegaConf.load(path))
        # One without a root of its own has another one's, or cannot be chosen.
        if isinstance(config, dict) and "root" in config:
            found.append(_data_set(path.stem, str(config["root"]), "data_seed" in config, place))
    return found


def _data_set(name: str, root: str, procedural: bool, place: Path) -> Finding:
    if root == "???":
        return Finding(DATA_PART, name, "no", f"has no place of its own: data={name} data.root=FOLDER")
    folder = place / root
    if folder.is_dir():
        return Finding(DATA_PART, name, "yes", f"{root}: {sum(1 for _ in folder.iterdir())} entries")
    said = "made there when it is first used" if procedural else f"data={name} data.root=FOLDER names another place"
    return Finding(DATA_PART, name, "no", f"not in {root}; {said}")


TOOLS_PART = "tools"
LEAST_SPACE = 100e6
"""Bytes: the files of a few predictions."""


def check_tools(place: Path) -> list[Finding]:
    """Videos need ffmpeg, which comes as a package; node is for exports only.

    Args:
        place: the folder whose disk is looked at.
    """
    return [_ffmpeg(), _node(), _splat_transform(), _space(place)]


def _ffmpeg() -> Finding:
    try:
        import imageio_ffmpeg

        said = f"{imageio_ffmpeg.get_ffmpeg_version()}, {imageio_ffmpeg.get_ffmpeg_exe()}"
    except Exception as error:  # a program that is missing, cannot be run, or says nothing
        said = f"{one_line(error)}; for videos, `pip install --force-reinstall imageio-ffmpeg`"
        return Finding(TOOLS_PART, "ffmpeg", "broken", said)
    return Finding(TOOLS_PART, "ffmpeg", "yes", said)


def _node() -> Finding:
    from completesplat.export.splat_transform import PROGRAM

    path = shutil.which("node")
    if path is None:
        return Finding(TOOLS_PART, "node", "no", f"version 20 or newer runs {PROGRAM}: https://nodejs.org")
    try:
        found = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=10, check=True).stdout
    except (OSError, subprocess.SubprocessError) as error:
        return Finding(TOOLS_PART, "node", "no", f"{path} does not run: {one_line(error)}")
    return Finding(TOOLS_PART, "node", "yes", f"{found.strip()}, {path}")


def _splat_transform() -> Finding:
    from completesplat.export.splat_transform import PACKAGE, PROGRAM

    path = shutil.which(PROGRAM)
    if path is not None:
        return Finding(TOOLS_PART, PROGRAM, "yes", path)
    how = "npx fetches it when they are asked for" if shutil.which("npx") else "first Node.js with npm"
    return Finding(TOOLS_PART, PROGRAM, "no", f"for formats spz, sog and html: `npm install -g {PACKAGE}`, or {how}")


def _space(place: Path) -> Finding:
    free = shutil.disk_usage(place).free
    if free < LEAST_SPACE:
        return Finding(
            TOOLS_PART, "free disk", "broken", f"{size(free)} in {place}: too little for a prediction's files"
        )
    return Finding(TOOLS_PART, "free disk", "yes", f"{size(free)} in {place}")


def run(config: Any, out: Path) -> None:
    """Print the table and write `doctor.json`; exit status 1 if something is broken that a prediction needs."""
    from rich.console import Console

    findings = []
    with Console(stderr=True).status("looking") as status:
        for part, check in checks(Path.cwd()):
            status.update(f"looking at: {part}")
            findings += findings_of(part, check)
    broken = [finding for finding in findings if finding.state == "broken"]
    content = {"works": not broken, "findings": [vars(finding) for finding in findings]}
    (out / "doctor.json").write_text(json.dumps(content, indent=2) + "\n")
    show(findings)
    if broken:
        print("broken: " + "; ".join(f"{one.part}, {one.name}: {one.said}" for one in broken))
        print(out)
        sys.exit(1)
    print("Nothing that completing a photograph needs is broken.")


def checks(place: Path) -> list[tuple[str, Callable[[], list[Finding]]]]:
    """The parts of the machine with their checks, in the order of the table."""
    from completesplat.commands import conf_folder

    return [
        ("packages", check_packages),
        ("imports", check_imports),
        ("device", check_device),
        ("rasterizers", partial(_check_with_parts, "check_rasterizers")),
        ("weights", partial(_check_with_parts, "check_weights")),
        ("data", partial(check_data, conf_folder() / "data", place)),
        ("tools", partial(check_tools, place)),
    ]


def findings_of(part: str, check: Callable[[], list[Finding]]) -> list[Finding]:
    """The findings of a check; an exception, such as a failing import, becomes a finding."""
    try:
        return check()
    except Exception as error:  # of any library: the other parts are looked at all the same
        return [Finding(part, "check", "broken", one_line(error))]


def _check_with_parts(name: str) -> list[Finding]:
    """A check that needs the package's own parts, which are imported only now."""
    return getattr(import_module("completesplat.commands.doctor_checks"), name)()


def show(findings: Sequence[Any]) -> None:
    """The table, with a rule between the parts."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    styles = {"yes": "green", "no": "yellow", "broken": "bold red"}
    table = Table(title="completesplat doctor", title_justify="left")
    for heading in ("part", "what", "here", "which, or why not"):
        table.add_column(heading, overflow="fold")
    last = None
    for finding in findings:
        if last not in (None, finding.part):
            table.add_section()
        state = Text(finding.state, style=styles[finding.state])
        table.add_row("" if finding.part == last else finding.part, Text(finding.name), state, Text(finding.said))
        last = finding.part
    Console(width=None if Console().is_terminal else 160).print(table)
