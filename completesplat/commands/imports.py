"""Imports of commands: without the garbage collector, and without modules that no prediction uses."""

import gc
import importlib.metadata
import sys
from collections import UserDict
from collections.abc import Callable, Iterator, MutableSequence
from contextlib import contextmanager
from functools import cached_property
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.metadata import packages_distributions
from importlib.util import spec_from_loader
from types import ModuleType
from typing import Any

SCIPY = ("scipy.integrate", "scipy.linalg", "scipy.linalg.cython_blas", "scipy.stats")
POSTPONED = ("requests", *SCIPY, "torch._dynamo", "torch.distributed._functional_collectives")
"""Modules that diffusers and numba import although no prediction uses them."""


@contextmanager
def importing() -> Iterator[None]:
    """Pause the garbage collector during imports, because it took a fifth of a prediction's time.

    The objects that exist after the first import of torch are frozen: the collector does not examine them again.
    """
    before = "torch" in sys.modules
    gc.disable()
    try:
        yield
    finally:
        if not before and "torch" in sys.modules:
            gc.freeze()
        gc.enable()


@contextmanager
def postponing() -> Iterator[None]:
    """Put stand-ins for `POSTPONED` into `sys.modules`, because these modules took half of the time of imports.

    This is the only place with stand-ins. It stays until `bench startup` finds that a first scene takes at most 0.3
    times `import torch` longer without it.

    The first use of a stand-in imports the real module. Afterwards `sys.modules` holds the real modules or none.
    Only for commands that compile no network: diffusers' blocks are not marked for torch.compile (`allow_in_graph`).
    """
    finder, stand_ins = _Submodules(), {name: _StandIn(name) for name in POSTPONED}
    vars(stand_ins["torch._dynamo"]).update(allow_in_graph=lambda marked: marked, disable=_disable)
    sys.modules.update({name: stand_in for name, stand_in in stand_ins.items() if name not in sys.modules})
    sys.meta_path.append(finder)
    importlib.metadata.packages_distributions = _Distributions
    try:
        yield
    finally:
        importlib.metadata.packages_distributions = packages_distributions
        sys.meta_path.remove(finder)
        for name, stand_in in stand_ins.items():
            if sys.modules.get(name) is stand_in:
                del sys.modules[name]


def _real(name: str) -> ModuleType:
    if isinstance(sys.modules.get(name), _StandIn):
        del sys.modules[name]
    return import_module(name)


def _disable(function: Callable[..., Any] | None = None, recursive: bool = True, **settings: Any) -> Any:
    """Exclude a function from compilation when it is called first, as torch does with functions of its own."""
    import torch

    if "wrapping" in settings:  # torch does so now
        return _real("torch._dynamo").disable(function, recursive, **settings)
    return torch._disable_dynamo(function, recursive)  # type: ignore[attr-defined]


class _Distributions(UserDict[str, list[str]]):
    """`packages_distributions`, but the records of all installed packages are read when one is looked up."""

    data = cached_property(lambda self: packages_distributions())  # type: ignore[assignment]

    def __init__(self) -> None:
        pass


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
