"""The packages that this one needs, those of its extras, and whether the networks can be loaded at all."""

import platform
from collections.abc import Iterable
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires, version

from packaging.requirements import Requirement

from completesplat import __version__
from completesplat.reports.doctor.finding import Finding

PART, EXTRAS_PART = "packages", "extras"
ALWAYS_SHOWN = ("torch", "lightning", "hydra-core", "numba", "diffusers", "wandb")
EXTRAS = {
    "cuda": "draws on an NVIDIA GPU",
    "view": "shows scenes in a browser, live",
    "colmap": "imports captures of your own",
    "slurm": "spreads sweeps over a cluster",
}


def check() -> list[Finding]:
    """Versions of what is needed, and what each extra would give."""
    found = [
        Finding(PART, "completesplat", "yes", __version__),
        Finding(PART, "python", "yes", f"{platform.python_version()} on {platform.system()}"),
    ]
    try:
        requirements = [Requirement(line) for line in requires("completesplat") or ()]
    except PackageNotFoundError:
        said = "runs from its source without being installed; `pip install -e .` there also fetches what it needs"
        return [*found, Finding(PART, "installation", "no", said)]
    extras = [line for name, gives in EXTRAS.items() for line in extra_packages(name, gives, requirements)]
    return [*found, *needed_packages(one for one in requirements if applies(one, "")), *extras]


def imports() -> list[Finding]:
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
            lines.append(Finding(PART, requirement.name, "broken", said))
        elif not requirement.specifier.contains(found, prereleases=True):
            said = f"{found}, which is not {requirement.specifier}: it may or may not work"
            lines.append(Finding(PART, requirement.name, "no", said))
        elif requirement.name in ALWAYS_SHOWN:
            lines.append(Finding(PART, requirement.name, "yes", found))
        else:
            others += 1
    lines.sort(key=lambda line: line.name not in ALWAYS_SHOWN)
    return [*lines, Finding(PART, "others", "yes", f"{others} more, in versions that fit")]


def extra_packages(name: str, gives: str, requirements: Iterable[Requirement]) -> list[Finding]:
    """What an extra brings, or would bring: one that is not installed is no error."""
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
