"""Imports of heavy libraries: without the garbage collector, and without modules that no prediction uses."""

import gc
import sys
from collections.abc import Iterator, MutableSequence
from contextlib import contextmanager
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from types import ModuleType
from typing import Any

SCIPY = ("scipy.integrate", "scipy.linalg", "scipy.linalg.cython_blas", "scipy.stats")
POSTPONED = ("requests", *SCIPY, "torch._dynamo", "torch.distributed._functional_collectives")
"""Modules that diffusers and numba import although no prediction uses them."""


@contextmanager
def importing() -> Iterator[None]:
    """Pause the garbage collector during imports, because it took a third of the time of a prediction.

    The objects that exist after the first import of torch are frozen: the collector does not examine them again.
    """
    before = "torch" in sys.modules
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if not before and "torch" in sys.modules:
            gc.freeze()
        if enabled:
            gc.enable()


@contextmanager
def postponing() -> Iterator[None]:
    """Put stand-ins for `POSTPONED` into `sys.modules`.

    This is the only place with stand-ins. Lazy imports cannot replace it: each module of diffusers imports
    `diffusers.utils`, and this imports `torch._dynamo` (notebooks/experiments.md, "The first scene").
    The first use of a stand-in imports the real module. Afterwards `sys.modules` holds the real modules or none.
    Only for commands that compile no network: nothing is marked for torch.compile (`allow_in_graph`, `disable`).
    """
    finder = _Submodules()
    stand_ins = {name: _StandIn(name) for name in POSTPONED}
    vars(stand_ins["torch._dynamo"]).update(allow_in_graph=_unmarked, disable=_unmarked)
    sys.modules.update({name: stand_in for name, stand_in in stand_ins.items() if name not in sys.modules})
    sys.meta_path.append(finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name, stand_in in stand_ins.items():
            if sys.modules.get(name) is stand_in:
                del sys.modules[name]


def _real(name: str) -> ModuleType:
    if isinstance(sys.modules.get(name), _StandIn):
        del sys.modules[name]
    return import_module(name)


def _unmarked(marked: Any = None, *settings: object, **options: object) -> Any:
    return _unmarked if marked is None else marked


class _StandIn(ModuleType):
    """Stand-in for a module, which is imported when the first of its attributes is used."""

    __path__: MutableSequence[str] = []  # noqa: RUF012

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__pyx_capi__":  # `inspect` looks for these, Cython for the last
            raise AttributeError(name)
        return getattr(_real(self.__name__), name)


class _Submodules(MetaPathFinder, Loader):
    """Importer of modules below a stand-in, which imports the stand-in's module first."""

    def find_spec(self, name: str, path: object, target: ModuleType | None = None) -> ModuleSpec | None:
        below = isinstance(sys.modules.get(name.rpartition(".")[0]), _StandIn)
        return spec_from_loader(name, self) if below else None

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__
        del sys.modules[name]
        _real(name.rpartition(".")[0])
        import_module(name)
