"""The rules of the house that no type checker holds: who imports whom, what is never called, how long things get.

Each rule is one test over all files, and its failure names every offender.
"""

import ast
import graphlib
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path, PureWindowsPath

import pytest
from lines_of_code import HANDLERS, PACKED, UNPACKED, WALRUS, density, lines_of_code

import completesplat

ROOT = Path(completesplat.__file__).parent
FILES = {path.relative_to(ROOT).as_posix(): path.read_text() for path in sorted(ROOT.rglob("*.py"))}
TREES = {path: ast.parse(text, path) for path, text in FILES.items()}

# A module imports from its own floor and from those before it; nothing from the benchmarks, which are no part of the
# method.
LAYERS = """
    version installation errors quantities signals wording files settings ply_files weights tensors
    geometry gaussians splatter_image scene rasterizers
    photo data autoreconstructor diffusion losses metrics
    onnx_graphs sampling_settings scene_model baselines generator export
    evaluation training viewer commands cli
    benchmarks
"""
FLOORS = LAYERS.split()
LATENTS_ONLY = {"gaussians", "splatter_image", "rasterizers"}
DATASETS = ("co3d", "realestate", "toy", "hydrant", "teddybear", "srn")
LONGEST_FILE = 400
FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "shelve", "marshal"}
MAY_IMPORT = {
    ("data/validation/processes.py", "pickle"),  # what multiprocessing does with every argument
    ("weights/checkpoint_reading.py", "pickle"),  # a dry run that replaces every function which a file names
}
FORBIDDEN_CALLS = {"eval", "exec", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "os.system", "os.popen"}


def floor(name: str) -> str:
    """`geometry/cameras.py` or `completesplat.geometry.cameras` -> `geometry`."""
    return name.removesuffix(".py").replace("/", ".").removeprefix("completesplat.").split(".")[0]


def imports(tree: ast.AST, path: str) -> Iterator[tuple[str, list[str]]]:
    """Absolute name of each imported module, those inside functions included, and the names taken from it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, []) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = ["completesplat", *Path(path).parent.parts]
            base = package[: len(package) - node.level + 1] if node.level else []
            yield ".".join([*base, *filter(None, [node.module])]), [alias.name for alias in node.names]


def imported_files(tree: ast.AST, path: str, known: Collection[str]) -> set[str]:
    """Which of the known modules are imported, by their own names or as names of their packages."""
    result = set()
    for module, names in imports(tree, path):
        full = {f"{module}.{name}" for name in names}
        result |= full if full and full <= set(known) else {module, *full}
    return result & set(known)


def module_name(path: str) -> str:
    """`geometry/cameras.py` -> `completesplat.geometry.cameras`; a package is named without its `__init__`."""
    return ".".join(["completesplat", *Path(path).with_suffix("").parts]).removesuffix(".__init__")


def upward_imports(trees: Mapping[str, ast.AST]) -> list[str]:
    result = []
    known = {module_name(path) for path in FILES}
    for path, tree in trees.items():
        own = floor(path)
        for module in imported_files(tree, path, known):
            other = floor(module)
            if other in FLOORS and own in FLOORS and FLOORS.index(other) > FLOORS.index(own):
                result.append(f"{path} imports {module}")
            if own == "diffusion" and other in LATENTS_ONLY:
                result.append(f"{path} imports {module}, but diffusion knows latents only")
    return result


def import_circle(trees: Mapping[str, ast.AST]) -> list[str]:
    """Modules each of which imports the one before it, the first one being also the last; empty if there are none."""
    known = {module_name(path) for path in trees}
    graph = {module_name(path): imported_files(tree, path, known) for path, tree in trees.items()}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def shared_class_names(trees: Mapping[str, ast.AST]) -> dict[str, list[str]]:
    """Where the classes are whose names are given more than once."""
    places = defaultdict(list)
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(path)
    return {name: paths for name, paths in places.items() if len(paths) > 1}


def unsafe_calls(tree: ast.AST, path: str) -> list[str]:
    modules = {m for m, _ in imports(tree, path) if (path, m) not in MAY_IMPORT}
    result = [f"import of {m}" for m in sorted(modules) if m.split(".")[0] in FORBIDDEN_MODULES]
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        keywords = {k.arg: k.value for k in node.keywords}
        if name in FORBIDDEN_CALLS:
            result.append(f"line {node.lineno}: {name}")
        for keyword in ("shell", "allow_pickle"):
            value = keywords.get(keyword)
            if value is not None and not (isinstance(value, ast.Constant) and value.value is False):
                result.append(f"line {node.lineno}: {keyword} may be true")
        only = keywords.get("weights_only")
        if name == "torch.load" and not (isinstance(only, ast.Constant) and only.value is True):
            result.append(f"line {node.lineno}: torch.load without weights_only=True")
    if any(module == "torch" and "load" in names for module, names in imports(tree, path)):
        result.append("torch.load under another name")
    return result


def native_names(tree: ast.AST) -> list[str]:
    """Lines that make a name of a path below a folder with this system's slashes, which on Windows lean backwards."""
    texts = [node for node in ast.walk(tree) if isinstance(node, ast.FormattedValue)]
    texts += [n.args[0] for n in ast.walk(tree) if isinstance(n, ast.Call) and ast.unparse(n.func) == "str" and n.args]
    values = [text.value if isinstance(text, ast.FormattedValue) else text for text in texts]
    return [
        f"line {value.lineno}"
        for value in values
        if isinstance(value, ast.Call) and isinstance(value.func, ast.Attribute) and value.func.attr == "relative_to"
    ]


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
    assert {floor(path) for path in TREES} - set(FLOORS) == {"__init__", "__main__"}


@pytest.mark.parametrize("rule", [upward_imports, import_circle, shared_class_names])
def test_no_file_breaks_the_rule(rule: Callable[[Mapping[str, ast.AST]], Collection[str]]) -> None:
    """Imports point down only and in no circle, nothing imports the benchmarks, no two classes have one name."""
    assert rule(TREES) in ([], {})


def offenders(rule: Callable[[ast.AST], list[str]], trees: Mapping[str, ast.AST]) -> dict[str, list[str]]:
    """Return what breaks a rule for single files, by file."""
    results = {path: rule(tree) for path, tree in trees.items()}
    return {path: lines for path, lines in results.items() if lines}


def test_no_code_of_strangers_is_loaded_or_run() -> None:
    results = {path: unsafe_calls(tree, path) for path, tree in TREES.items()}
    assert {path: lines for path, lines in results.items() if lines} == {}


def test_data_sets_are_named_in_data_only() -> None:
    assert offenders(dataset_names, {path: tree for path, tree in TREES.items() if floor(path) != "data"}) == {}


def test_names_below_a_folder_have_forward_slashes_on_windows_too() -> None:
    assert offenders(native_names, TREES) == {}


def test_files_stay_short() -> None:
    lengths = {path: len(text.splitlines()) for path, text in FILES.items()}
    assert {path: length for path, length in lengths.items() if length > LONGEST_FILE} == {}


# What the rules allow is what the package does.
UPWARD = [
    ("geometry/cameras.py", "from completesplat import gaussians"),
    ("geometry/cameras.py", "from ..gaussians import Gaussians"),
    ("geometry/cameras.py", "def f():\n    import completesplat.scene"),
    ("diffusion/latents.py", "from completesplat.gaussians import Gaussians"),
    ("cli.py", "from completesplat import benchmarks"),
]
UNSAFE = """torch.load(path); torch.load(path, weights_only=flag); from torch import load; from pickle import loads;
    eval(text); yaml.load(text); subprocess.run(command, shell=flag); numpy.load(path, allow_pickle=True)"""
NAMING = ["class CO3DReader: pass", "x = 'realestate10k'", "make_toy(1)", "import data.toy", "f(hydrants=1)"]


def test_docstrings_comments_and_blank_lines_are_no_code() -> None:
    text = '"""A."""\n\n# b\nx = """c\n\nd"""\n\n\ndef f(\n    y,\n):  # e\n    """G."""\n    return y\n'
    assert lines_of_code(text) == 3 + 4


@pytest.mark.parametrize(
    ("text", "counted"),
    [
        ("a, b = x, y", {PACKED: 1}),
        ("a, b = f()", {}),
        ("f(a := x)", {WALRUS: 1}),
        ("try:\n    f()\nexcept (A, B):\n    pass", {HANDLERS: 1}),
        ("a = {**({} if x else y), **{'b': 1}, **z}", {UNPACKED: 2}),
        ("a = [*(x, y), *z, *(x for x in z)]", {UNPACKED: 1}),
        ("a |= {'b': 1}", {UNPACKED: 1}),
        ("a |= b", {}),
    ],
)
def test_dense_code_is_counted(text: str, counted: dict[str, int]) -> None:
    assert density(text) == counted


def test_the_rules_notice() -> None:
    assert [case for case in UPWARD if len(upward_imports({case[0]: ast.parse(case[1])})) != 1] == []
    unsafe = [source.strip() for source in UNSAFE.split(";")]
    assert [source for source in unsafe if len(unsafe_calls(ast.parse(source), "training/x.py")) != 1] == []
    native = ["str(path.relative_to(root))", "f'a {x.relative_to(root)}'"]
    assert [source for source in native if len(native_names(ast.parse(source))) != 1] == []
    assert native_names(ast.parse("path.relative_to(root).as_posix()")) == []
    name = PureWindowsPath("C:/a/b/c").relative_to("C:/a")
    assert (str(name), name.as_posix()) == (r"b\c", "b/c")
    assert [source for source in NAMING if not dataset_names(ast.parse(source))] == []
    sources = {"a.py": ast.parse("class A: pass\nclass B: pass"), "b.py": ast.parse("def f():\n    class A: pass")}
    assert shared_class_names(sources) == {"A": ["a.py", "b.py"]}
    one = ast.parse("from completesplat.b import g")
    for back in ("from completesplat import a", "from .a import f", "def f():\n    import completesplat.a"):
        circle = import_circle({"a.py": one, "b.py": ast.parse(back)})
        assert set(circle) == {"completesplat.a", "completesplat.b"}
    package = {"p/__init__.py": ast.parse("from .a import f"), "p/b.py": ast.parse("")}
    # The file that a package's module imports is another one than the package's own.
    assert import_circle({**package, "p/a.py": ast.parse("from . import b")}) == []
    assert len(import_circle({**package, "p/a.py": ast.parse("from . import f")})) == 3
