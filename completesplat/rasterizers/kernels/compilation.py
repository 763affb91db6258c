"""Compilation of kernels, also of other folders, by numba, and the cache of their machine code."""

import hashlib
import inspect
import logging
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from llvmlite.binding import get_host_cpu_features, get_host_cpu_name

from completesplat.errors import CompleteSplatError
from completesplat.files import private_folder, user_cache

Result = TypeVar("Result")
numba_config: Any = numba.config
logger = logging.getLogger(__name__)

# Without "nnan" and "ninf", with which the optimiser may remove the tests for values that are not finite.
# error_model="numpy" is needed for speed, because Python's error for a division by zero stops vectorisation.
OPTIONS: dict[str, Any] = {
    "fastmath": {"contract", "nsz", "arcp", "reassoc", "afn"},
    "error_model": "numpy",
    "boundscheck": False,
    "nogil": True,
}


def kernel(function: Callable[..., Result], **changed: object) -> Callable[..., Result]:
    """Compile an entry point on its first call, with changed `OPTIONS`. Later processes load it from the cache."""
    before = numba_config.CACHE_DIR
    directory = cache_directory()
    numba_config.CACHE_DIR = before if directory is None else str(directory)
    cached = directory is not None
    try:
        compiled: Callable[..., Result] = numba.njit(cache=cached, **OPTIONS | changed)(inspect.unwrap(function))
    finally:
        numba_config.CACHE_DIR = before
    return compiled


def helper(function: Callable[..., Result], **changed: object) -> Callable[..., Result]:
    """Compile a part of a kernel that is always inlined, with the kernel's options."""
    # Unwrapping removes a type checker's wrappers, which numba could not compile.
    compiled: Callable[..., Result] = numba.njit(forceinline=True, **OPTIONS | changed)(inspect.unwrap(function))
    return compiled


@cache
def cache_directory() -> Path | None:
    """Return the first writable of $NUMBA_CACHE_DIR, a folder beside the sources and the user's caches, or None.

    numba invalidates a cached function when its file changes, but not when a helper in another file does, so the
    folder's name contains a digest of all kernel sources, and of the processor and versions that they are compiled for.
    """
    here = Path(__file__).parent
    bases = [here / "__pycache__", *_user_folders()]
    if numba_config.CACHE_DIR:
        bases = [Path(numba_config.CACHE_DIR)]
    machine = repr((get_host_cpu_name(), get_host_cpu_features().flatten(), sys.version, numba.__version__)).encode()
    sources = b"".join(path.read_bytes() for path in sorted(here.glob("*.py")))
    digest = hashlib.sha256(machine + sources).hexdigest()
    for base in bases:
        folder = base / f"kernels-{digest[:12]}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        if not any(folder.glob("kernels_*/*.nbc")):
            logger.info("compiling the kernels on first use, once on this machine, takes 10 to 30 s")
        return folder
    message = "no writable cache folder (%s): kernels are compiled anew in every process, which takes 10 to 30 s"
    logger.warning(message, ", ".join(map(str, bases)))
    return None


def _user_folders() -> Iterator[Path]:
    """Yield the user's folders for caches, the last one among the temporary files."""
    with suppress(CompleteSplatError):
        yield user_cache()
    temporary = private_folder()
    if temporary is not None:
        yield temporary
