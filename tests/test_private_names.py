"""Private names of libraries that the package uses: each is listed here with its reason."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import completesplat

ROOT = Path(completesplat.__file__).parent
# Documented names of namedtuple, os and Hydra.
PUBLIC = {"_asdict", "_replace", "_exit", "_target_", "_global_", "_self_", "_partial_", "_recursive_"}
FOR_BLENDER = "data/rendered/_scene_"  # Blender runs these files beside each other
LOADERS = "torch.utils.data.dataloader"
NO_ORIGIN = "OmegaConf does not tell publicly to which setting a setting refers"
NO_FEATURES = "the library gives the last features only, the loss needs those of each stage"
ONE_OF_TORCH = "torch.nn.Module.to reads its arguments with it; a copy of its rules would go wrong first"
DURING_JOB = "processes that Lightning starts repeat the program's arguments; put back afterwards"

# File, names: reason.
REASONS = {
    "baselines/autodecoder.py _load_from_state_dict": "makes room for a checkpoint's codes before they are compared",
    "commands/__init__.py logging.raiseExceptions": "documented: no reports of logging's own errors",
    "commands/__init__.py sys.argv": DURING_JOB,
    "commands/jobs.py sys.argv": DURING_JOB,
    f"data/loading/loader.py {LOADERS}._BaseDataLoaderIter": "the type of `_iterator`, by which Lightning ends workers",
    "data/loading/worker_folder.py tempfile.tempdir": "documented: the folder of a worker's temporary files",
    "data/validation/processes.py _processes": "executors cannot end workers before Python 3.14",
    "losses/efficientnet.py _blocks _bn0 _conv_stem _swish": NO_FEATURES,
    "settings/checks.py _get_node _get_root _value": NO_ORIGIN,
    "settings/composition.py _is_avx512_bf16_supported": "torch does not tell publicly whether a CPU has bfloat16",
    "tensors.py _C _nn _parse_to": ONE_OF_TORCH,
    "tensors.py torch.utils._pytree": "the public registration takes no static values beside tensors",
    "weights/checkpoint_reading.py _Unpickler": "Python's unpickler in Python, whose calls a dry run replaces",
    "training/callbacks.py _get_train_description _update": "the progress bar covers the run, not an epoch",
    "training/callbacks.py _average_model _foreach_lerp_": "Lightning's average lies on the CPU; torch's update waits",
    "training/callbacks.py _update_metrics": "figures are shown once a second, because reading them waits for a GPU",
    "training/callbacks.py _swap_models": "images of fixed scenes are drawn with the averaged weights",
    "training/loggers.py _check_log_dir_exists": "Lightning's logger would delete the rows of the run that goes on",
    "training/loggers.py _wandb_init": "W&B's run begins with Lightning's options and ours",
    "training/optimization.py _orthogonalize": "Muon's own way is slow on CPUs and less exact",
    "training/stage.py _compiler_ctx": "Lightning marks modules of torch.compile with it, and has no public name",
    "training/stage.py _foreach_mul_": "one kernel instead of one for each gradient",
    "training/stage.py _trainer": "Lightning's `trainer` raises an error where there is none",
    "training/stopping.py _launch_process_observer": "kills the first process; without it, Lightning's own way",
    "viewer/access.py websockets_server.serve": "viser starts its server without checks, and has no option for them",
    "weights/checkpoint_reading.py _C": "sizes of an archive's parts are checked before torch allocates them",
}


def is_private(name: object) -> bool:
    return re.fullmatch(r"_[A-Za-z]\w*", str(name)) is not None and name not in PUBLIC


def defined(tree: ast.AST) -> set[str]:
    """Names of functions, classes, variables and attributes of `self` that a file defines."""
    nodes = list(ast.walk(tree))
    names = {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    stored = [node for node in nodes if isinstance(getattr(node, "ctx", None), ast.Store)]
    names |= {node.id for node in stored if isinstance(node, ast.Name)}
    return names | {
        node.attr for node in stored if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "self"
    }


def imported(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield the full name of everything that a file imports from libraries, and its name in the file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, alias.asname or alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not (node.module or "").startswith("completesplat"):
            yield from ((f"{node.module}.{alias.name}", alias.asname or alias.name) for alias in node.names)


def used(text: str) -> Iterator[str]:
    """Yield the private names that a file imports, reads, overrides for a library to call, or replaces in one."""
    tree = ast.parse(text)
    nodes, own, names = list(ast.walk(tree)), defined(tree), dict(imported(tree))
    yield from (name for name in names if any(map(is_private, name.split("."))))
    attributes = [node for node in nodes if isinstance(node, ast.Attribute)]
    read = {node.attr for node in attributes}
    for node in attributes:
        if is_private(node.attr) and (node.attr not in own or ast.unparse(node.value) == "super()"):
            yield node.attr
        if isinstance(node.ctx, ast.Store) and ast.unparse(node.value) in names.values():
            yield ast.unparse(node)
    for node in nodes:
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("getattr", "setattr", "hasattr"):
            yield from (part.value for part in node.args if isinstance(part, ast.Constant) and is_private(part.value))
        if isinstance(node, ast.ClassDef):
            methods = {part.name for part in node.body if isinstance(part, ast.FunctionDef)}
            yield from (name for name in methods - read if is_private(name))


def test_every_private_name_of_a_library_has_a_reason():
    places = {path.relative_to(ROOT).as_posix(): path for path in ROOT.rglob("*.py")}
    ours = {place: path for place, path in places.items() if not place.startswith(FOR_BLENDER)}
    names = {(place, name) for place, path in ours.items() for name in used(path.read_text())}
    assert names == {(place, name) for place, *listed in map(str.split, REASONS) for name in listed}


def test_each_kind_of_use_is_found():
    own = "class A(B):\n def _f(self): self._x = 1\n def g(self): self._f(), self._x"
    for text, name in {
        "import torch._dynamo as dynamo": "torch._dynamo",
        "from hydra._internal import utils": "hydra._internal.utils",
        "from completesplat.cli import _own": None,
        "pool._processes": "_processes",
        "getattr(pool, '_processes')": "_processes",
        "import numpy as np\nnp.zeros = None": "np.zeros",
        own: None,
        own.replace("self._f()", "super()._f()"): "_f",
        "class A(B):\n def _f(self): pass": "_f",
    }.items():
        assert set(used(text)) == ({name} if name else set()), text
