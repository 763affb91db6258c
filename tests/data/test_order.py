"""Folders and files of `completesplat/data` stand in an order, and each imports only from those before it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from completesplat import data

ROOT = Path(data.__file__).parent

# What all data sets share, the store, the loaders, the readers, and what makes data. Those of one line do not import
# each other.
ORDER = """
    sequences tolerance
    splits
    validation
    placement
    packed
    loading
    captures co3d realestate10k
    rendered toy
"""
LINES = [line.split() for line in ORDER.strip().splitlines()]
PLACES = {name: number for number, names in enumerate(LINES) for name in names}


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
    return [name for name in imported(text) if name in PLACES and name != place and PLACES[name] >= PLACES[place]]


def test_each_file_imports_only_from_those_before_it() -> None:
    files = [path for path in ROOT.rglob("*.py") if path.parent != ROOT or path.stem != "__init__"]
    places = {path: path.relative_to(ROOT).with_suffix("").parts[0] for path in files}
    assert {place for place in places.values() if place not in PLACES} <= {"images"}
    wrong = {path: upward(place, path.read_text()) for path, place in places.items() if place in PLACES}
    assert {path.relative_to(ROOT).as_posix(): names for path, names in wrong.items() if names} == {}


@pytest.mark.parametrize(
    "text",
    [
        "from completesplat.data.toy import write",
        "from completesplat.data import captures",
        "def f():\n    import completesplat.data.rendered.blender",
    ],
)
def test_an_import_that_points_up_or_to_the_side_is_noticed(text: str) -> None:
    assert len(upward("co3d", text)) == 1
