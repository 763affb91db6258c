"""The rules of the house that no type checker holds: who imports whom, what is never called, how long things get."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import completesplat

ROOT = Path(completesplat.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
TREES = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(), str(path)) for path in FILES}

# A module imports from its own floor and from those before it.
FLOORS = [
    "errors",
    "atomic",
    "weights",
    "tensors",
    "geometry",
    "gaussians",
    "splatter_image",
    "scene",
    "rasterizers",
    "data",
    "autoreconstructor",
    "diffusion",
    "losses",
    "metrics",
    "baselines",
    "generation",
    "training",
    "export",
    "viewer",
    "results",
    "studies",
    "commands",
    "benchmarks",
    "cli",
]
LATENTS_ONLY = {"gaussians", "splatter_image", "rasterizers"}
DATASETS = ("co3d", "realestate", "toy", "hydrant", "teddybear")
LONGEST_FILE, LONGEST_FUNCTION = 400, 50
FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "shelve", "marshal"}
FORBIDDEN_CALLS = {"eval", "exec", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "os.system", "os.popen"}


def floor(name: str) -> str:
    """`geometry/cameras.py` or `completesplat.geometry.cameras` -> `geometry`."""
    parts = name.removesuffix(".py").replace("/", ".").removeprefix("completesplat.").split(".")
    return parts[0]


def imported_modules(tree: ast.AST, path: str) -> Iterator[str]:
    """Absolute names of all imported modules, those inside functions included."""
    package = ["completesplat", *Path(path).parent.parts]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            # `from completesplat import x` may name a module or a value of the package itself.
            yield from ([f"{module}.{alias.name}" for alias in node.names] if module == "completesplat" else [module])


def upward_imports(trees: dict[str, ast.AST]) -> list[str]:
    found = []
    for path, tree in trees.items():
        own = floor(path)
        for module in imported_modules(tree, path):
            if not module.startswith("completesplat."):
                continue
            other = floor(module)
            if other in FLOORS and own in FLOORS and FLOORS.index(other) > FLOORS.index(own):
                found.append(f"{path} imports {module}")
            if own == "diffusion" and other in LATENTS_ONLY:
                found.append(f"{path} imports {module}, but diffusion knows latents only")
    return found


def dotted(node: ast.expr) -> str:
    return ast.unparse(node) if isinstance(node, ast.Name | ast.Attribute) else ""


def unsafe_calls(tree: ast.AST, path: str) -> list[str]:
    found = [f"import of {m}" for m in imported_modules(tree, path) if m.split(".")[0] in FORBIDDEN_MODULES]
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = dotted(node.func)
        keywords = {k.arg: k.value for k in node.keywords}
        if name in FORBIDDEN_CALLS:
            found.append(f"line {node.lineno}: {name}")
        for keyword in ("shell", "allow_pickle"):
            value = keywords.get(keyword)
            if value is not None and not (isinstance(value, ast.Constant) and value.value is False):
                found.append(f"line {node.lineno}: {keyword} may be true")
        only = keywords.get("weights_only")
        if name == "torch.load" and not (isinstance(only, ast.Constant) and only.value is True):
            found.append(f"line {node.lineno}: torch.load without weights_only=True")
    if any(
        isinstance(node, ast.ImportFrom) and node.module == "torch" and "load" in {alias.name for alias in node.names}
        for node in ast.walk(tree)
    ):
        found.append("torch.load under another name")
    return found


def docstrings(tree: ast.AST) -> set[int]:
    """Identities of the constants that are docstrings (of modules, classes, functions, and of attributes)."""
    statements = [child for node in ast.walk(tree) for child in ast.iter_child_nodes(node)]
    return {id(s.value) for s in statements if isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant)}


def words(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and text of every identifier and string that is code."""
    documentation = docstrings(tree)
    for node in ast.walk(tree):
        line = getattr(node, "lineno", 0)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documentation:
            yield line, node.value
        for field in ("id", "attr", "name", "asname", "arg", "module"):
            value = getattr(node, field, None)
            if isinstance(value, str):
                yield line, value


def dataset_names(tree: ast.AST) -> list[str]:
    return [f"line {n}: {word}" for n, word in words(tree) if any(name in word.lower() for name in DATASETS)]


def test_every_module_belongs_to_a_floor() -> None:
    unknown = {floor(path) for path in TREES} - set(FLOORS) - {"__init__", "__main__"}
    assert unknown == set()


def test_imports_point_down_only() -> None:
    assert upward_imports(TREES) == []  # type: ignore[arg-type]


@pytest.mark.parametrize("path", TREES)
def test_nothing_is_loaded_or_run_that_could_be_code(path: str) -> None:
    assert unsafe_calls(TREES[path], path) == []


@pytest.mark.parametrize("path", [path for path in TREES if floor(path) != "data"])
def test_datasets_are_named_in_data_only(path: str) -> None:
    assert dataset_names(TREES[path]) == []


@pytest.mark.parametrize("path", TREES)
def test_files_and_functions_stay_short(path: str) -> None:
    assert len((ROOT / path).read_text().splitlines()) <= LONGEST_FILE
    if path.startswith("rasterizers/kernels"):
        return
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None:
            assert node.end_lineno - node.lineno < LONGEST_FUNCTION, node.name


def test_the_command_line_starts_without_the_heavy_libraries() -> None:
    code = (
        "import sys, completesplat.cli; "
        "print(*sorted({'torch', 'lightning', 'diffusers'} & {name.split('.')[0] for name in sys.modules}))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("geometry/cameras.py", "from completesplat.gaussians import Gaussians"),
        ("geometry/cameras.py", "from completesplat import gaussians"),
        ("geometry/cameras.py", "from ..gaussians import Gaussians"),
        ("geometry/cameras.py", "def f():\n    import completesplat.scene"),
        ("generation.py", "from completesplat.training import stage1"),
        ("diffusion/latents.py", "from completesplat.gaussians import Gaussians"),
        ("diffusion/latents.py", "from completesplat.rasterizers.reference import ReferenceRasterizer"),
    ],
)
def test_the_import_rule_notices(path: str, source: str) -> None:
    assert len(upward_imports({path: ast.parse(source)})) == 1


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("scene.py", "from completesplat.gaussians import Gaussians"),
        ("geometry/cameras.py", "from . import rotations\nfrom .rotations import f\nimport torch"),
        ("training/stage1.py", "from completesplat.generation import CompleteSplat"),
        ("diffusion/latents.py", "from completesplat.tensors import stack"),
        ("cli.py", "from completesplat import __version__"),
    ],
)
def test_the_import_rule_allows(path: str, source: str) -> None:
    assert upward_imports({path: ast.parse(source)}) == []


@pytest.mark.parametrize(
    "source",
    [
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "torch.load(path, weights_only=flag)",
        "from torch import load",
        "def f():\n    import pickle",
        "from pickle import loads",
        "eval(text)",
        "exec(text)",
        "yaml.load(text)",
        "subprocess.run(command, shell=True)",
        "subprocess.run(command, shell=flag)",
        "numpy.load(path, allow_pickle=True)",
    ],
)
def test_the_safety_rule_notices(source: str) -> None:
    assert len(unsafe_calls(ast.parse(source), "training/x.py")) == 1


def test_the_safety_rule_allows() -> None:
    source = "torch.load(path, map_location='cpu', weights_only=True)\nmodel.eval()\nyaml.safe_load(text)"
    assert unsafe_calls(ast.parse(source), "training/x.py") == []


@pytest.mark.parametrize(
    "source", ["class CO3DReader: pass", "x = 'realestate10k'", "make_toy(1)", "import data.toy", "f(hydrants=1)"]
)
def test_the_naming_rule_notices(source: str) -> None:
    assert len(dataset_names(ast.parse(source))) >= 1


def test_the_naming_rule_overlooks_documentation() -> None:
    source = '"""CO3D."""\n# toy\nclass A:\n    """Toy."""\n\n    x: int = 1\n    """RealEstate10K."""\n'
    assert dataset_names(ast.parse(source)) == []


def test_nothing_imports_the_benchmarks() -> None:
    """Their opponents are no part of the method; the configurations alone name what they run."""
    imported = {path: set(imported_modules(tree, path)) for path, tree in TREES.items() if floor(path) != "benchmarks"}
    assert [path for path, modules in imported.items() if any(floor(m) == "benchmarks" for m in modules)] == []
