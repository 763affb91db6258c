"""Extensions: installed packages that bring further options of the config groups, and the code that these name.

A distribution declares an extension by an entry point of a group in `ENTRY_POINTS`. Its value is the package that has a
folder `conf`, with the same groups as this package's. The extension's code is imported only when a config names it.
"""

import logging
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

ENTRY_POINTS = ("completesplat.methods", "completesplat.data")
"""Groups of entry points. They mean the same; the second is for packages that bring only data sets."""

log = logging.getLogger(__name__)


class Extension(NamedTuple):
    """Installed package with options.

    Attributes:
        name, version: those of its distribution.
        module: first name of the paths of its modules.
        conf: folder of its options.
    """

    name: str
    version: str
    module: str
    conf: Path

    def __str__(self) -> str:
        return f"{self.name} {self.version}"


class Declaration(NamedTuple):
    """A distribution's name and version, and the package that it declares as an extension."""

    name: str
    version: str
    package: str


class Installed(NamedTuple):
    """Extensions in the order of their names, and the reason for each distribution that is broken, by its name."""

    extensions: list[Extension]
    broken: dict[str, str]


def extensions() -> list[Extension]:
    """Return the extensions that work, in the order of their names."""
    return installed().extensions


def versions_of(paths: Iterable[str]) -> dict[str, str]:
    """Return the extensions that have the modules, classes or functions of these paths: versions by name."""
    tops = {path.partition(".")[0] for path in paths}
    return {extension.name: extension.version for extension in extensions() if extension.module in tops}


def extension_of(path: str) -> Extension | None:
    """Return the extension that has the module, class or function of this path, or None."""
    top = path.partition(".")[0]
    return next((extension for extension in extensions() if extension.module == top), None)


@cache
def installed() -> Installed:
    """Find all extensions once, without importing their code. A warning names each distribution that is broken."""
    result = Installed([], {})
    for name, version, package in sorted(set(_declarations())):
        conf = _conf_folder(package)
        if conf is None:
            result.broken[name] = f"{package!r}, which it declares as an extension, is no package with a folder conf"
        else:
            result.extensions.append(Extension(name, version, package.partition(".")[0], conf))
    for name, reason in result.broken.items():
        log.warning("%s is left out: %s; update or uninstall it", name, reason)
    return result


def _declarations() -> Iterator[Declaration]:
    """Yield what all distributions declare. Of two with one name, Python imports the first."""
    from importlib.metadata import distributions  # takes a tenth of a second, which `completesplat --help` saves

    names = set()
    for distribution in distributions():
        with suppress(Exception):  # metadata that cannot be read may be those of any distribution
            packages = {point.value.strip() for point in distribution.entry_points if point.group in ENTRY_POINTS}
            if not packages or distribution.metadata["Name"] in names:
                continue
            name = str(distribution.metadata["Name"])
            names.add(name)
            for package in packages:
                yield Declaration(name, str(distribution.version), package)


def _conf_folder(package: str) -> Path | None:
    """Return the folder `conf` of a package, or None. Nothing is imported, because only the first name is looked up."""
    top, *others = package.split(".")
    for place in _places(top):
        folder = Path(place, *others, "conf")
        if folder.is_dir():
            return folder
    return None


def _places(top: str) -> Iterator[str]:
    """Yield the folders of a package of one name, which may be none."""
    with suppress(Exception):  # finders of editable installs may raise any error
        spec = find_spec(top)
        if spec is not None:
            yield from spec.submodule_search_locations or []
