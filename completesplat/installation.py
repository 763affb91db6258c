"""How this package was installed, for messages that say how to add an extra."""

import json
import shlex
from importlib.metadata import PackageNotFoundError, distribution
from typing import Any
from urllib.parse import unquote, urlsplit

NAME = "completesplat"


def install_command(extra: str) -> str:
    """Return the command that adds an extra, from where the package came: an index, a clone, a wheel or a repository.

    Where it came from is in `direct_url.json` (PEP 610), which pip writes unless the package is from an index.
    """
    origin = _origin()
    address = origin.get("url", "")
    path = unquote(urlsplit(address).path)
    if "vcs_info" in origin:
        return f'pip install "{NAME}[{extra}] @ {origin["vcs_info"]["vcs"]}+{address}"'
    if not address.startswith("file:"):
        return f'pip install "{NAME}[{extra}]"'
    option = "-e " if origin.get("dir_info", {}).get("editable") else ""
    return f"pip install {option}{shlex.quote(f'{path}[{extra}]')}"


def _origin() -> dict[str, Any]:
    try:
        text = distribution(NAME).read_text("direct_url.json")
        return json.loads(text) if text else {}
    except (PackageNotFoundError, ValueError):
        return {}
