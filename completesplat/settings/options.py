"""Files of `conf/`: config groups, their options, and the nearest name to one that does not exist."""

from collections.abc import Iterable, Iterator
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml

from completesplat.settings.extensions import Extension, extensions

LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The faster of PyYAML's loaders that build plain values only."""
TASKS = ("data", "bench", "report")
"""Verbs with several tasks: `data toy` is short for `data data_task=toy`."""
LEAST_LIKE = 0.6


def conf_folder() -> Path:
    """Return the folder of configs, inside an installed package or beside the package in the repository."""
    package = Path(__file__).parents[1]
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def folders() -> Iterator[Path]:
    """Yield the folders of configs, where the first one with an option counts.

    They are the package's, those of extensions, and `conf` in the working folder if it exists.
    """
    yield conf_folder()
    for extension in extensions():
        yield extension.conf
    local = Path.cwd() / "conf"
    if local.is_dir():
        yield local


def groups() -> list[str]:
    """Return the names of all config groups."""
    return sorted({path.name for folder in folders() for path in folder.iterdir() if path.is_dir()})


def options(group: str) -> list[str]:
    """Return the options of a config group.

    Files that begin with `_` are parts of others.
    """
    return sorted({file.stem for folder in folders() for file in (folder / group).glob("[!_]*.yaml")})


def source_of(name: str) -> Extension | None:
    """Return the extension that has the option `GROUP/OPTION`; None for the package's and the working folder's."""
    for folder, extension in [(conf_folder(), None), *((extension.conf, extension) for extension in extensions())]:
        if (folder / f"{name}.yaml").is_file():
            return extension
    return None


def conf_text(name: str) -> str:
    """Return the text of a file by its name without suffix (`data/toy_objects`)."""
    for folder in folders():
        path = folder / f"{name}.yaml"
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise FileNotFoundError(name)


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Return an ending for a message about an unknown name: the nearest of `names`, or nothing if none is near."""
    nearest = get_close_matches(name, list(names), cutoff=LEAST_LIKE)
    return f"; did you mean {' or '.join(nearest)}?" if nearest else ""
