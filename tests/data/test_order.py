"""Folders and files of `completesplat/data` stand in an order, and each imports only from those before it."""

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest

from completesplat import data

ROOT = Path(data.__file__).parent
# The drawing of the order in the package's docstring. Names of one line do not import each other.
DRAWING = [line for line in inspect.cleandoc(str(data.__doc__)).splitlines() if line.startswith("    ")]
LINES = [line.partition(":")[0].split(",") for line in DRAWING]
PLACES = {name.strip(): number for number, names in enumerate(LINES) for name in names}
READERS = PLACES["co3d"]


def imported(text: str) -> Iterator[str]:
    """First parts of the names below `completesplat.data` that a file imports."""
    for node in ast.walk(ast.parse(text)):
        modules = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name the whole package"
            modules = [f"{node.module}.{alias.name}" for alias in node.names]
        for module in modules:
            if module.startswith("completesplat.data."):
                yield module.split(".")[2]


def upward(place: str, text: str) -> list[str]:
    """Names that a file imports from its own line or from later ones, its own folder excepted."""
    own = PLACES.get(place, READERS)
    return [name for name in imported(text) if name != place and PLACES.get(name, READERS) >= own]


def test_each_file_imports_only_from_those_before_it() -> None:
    wrong = {}
    for path in sorted(ROOT.rglob("*.py")):
        relative = path.relative_to(ROOT)
        if relative != Path("__init__.py"):
            wrong[relative.as_posix()] = upward(relative.with_suffix("").parts[0], path.read_text())
    assert len(wrong) > 40
    assert {path: names for path, names in wrong.items() if names} == {}


@pytest.mark.parametrize(
    "text",
    [
        "from completesplat.data.toy import write",
        "from completesplat.data import captures",
        "def f():\n    import completesplat.data.rendered.blender",
    ],
)
def test_an_import_that_points_up_or_to_the_side_is_noticed(text: str) -> None:
    assert len(upward("co3d", text)) == len(upward("new", text)) == 1
    assert upward("new", "from completesplat.data.loading.scenes import SceneStore") == []
