"""What pyproject.toml declares is what is imported, and nothing else."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import packages_distributions
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
    "hydra-submitit-launcher": "found by hydra: hydra/launcher=submitit_slurm",
    "ipykernel": "runs the notebooks",
    "mypy": "a program",
    "nbclient": "runs the notebooks",
    "pytest-xdist": "an option of pytest",
    "ruff": "a program",
}


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
    names = {name.split(".")[0] for path in (ROOT / folder).rglob("*.py") for name in modules(path)}
    if folder == "completesplat":
        texts = [path.read_text() for path in (ROOT / "conf").rglob("*.yaml")]
        names |= {name for text in texts for name in re.findall(r"_target_: (\w+)\.", text)}
    own = {"completesplat", *(path.stem for path in (ROOT / "tests").glob("*.py"))}
    others = names - own - set(sys.stdlib_module_names)
    return {name: {canonicalize_name(found) for found in DISTRIBUTIONS.get(name, [name])} for name in others}


def test_what_is_declared_is_imported_or_has_a_reason_and_nothing_else_is_imported() -> None:
    needed, developers = declared(PROJECT["dependencies"]), declared(EXTRAS["dev"])
    optional = declared(line for name, lines in EXTRAS.items() if name != "dev" for line in lines)
    package, tests = imported("completesplat"), imported("tests")
    assert {name: found for name, found in package.items() if not found & (needed | optional)} == {}
    assert {name: found for name, found in tests.items() if not found & (needed | developers)} == {}
    used = set().union(*package.values())
    assert needed | optional <= used | NEVER_IMPORTED.keys()
    used |= set().union(*tests.values())
    assert developers <= used | NEVER_IMPORTED.keys()
    assert NEVER_IMPORTED.keys() <= (needed | optional | developers) - used
