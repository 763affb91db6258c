"""Results below a folder: of `completesplat test`, of `completesplat fit`, and of the hidden-modes benchmark."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError
from completesplat.reports.sweeps.jobs import PROTOCOL

SCORES, MODES = "metrics.json", "hidden_modes.json"
NEEDED = {SCORES: ("data_set", "resolution", "scenes"), MODES: ()}
"""Of a protocol, by name of the file."""
REGIONS = ("full", "object")
HOW = "make them with `completesplat test ckpt=RUN/checkpoints/last.ckpt out=DIR`"


@dataclass(frozen=True)
class Run:
    """One file of results: where it lies below the folder, how it was measured, and its entries by predictor."""

    name: str
    protocol: dict[str, Any]
    entries: dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Found:
    """All results below a folder, and a line for each file that could not be used."""

    scores: list[Run] = field(default_factory=list)
    modes: list[Run] = field(default_factory=list)
    sweeps: list[Path] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def find(folder: Path) -> Found:
    """Search a folder and all below it.

    Raises:
        CompleteSplatError: there is no such folder, or no results in it.
    """
    if not folder.is_dir():
        raise CompleteSplatError(f"runs={folder}: no such folder")
    found = Found(sweeps=sorted(path.parent for path in folder.rglob("multirun.yaml")))
    paths = sorted([*folder.rglob(SCORES), *folder.rglob(MODES)])
    if not paths:
        raise CompleteSplatError(f"runs={folder}: no {SCORES} and no {MODES} in it or below it; {HOW}")
    for path in paths:
        try:
            name = str(path.parent.relative_to(folder))
            (found.scores if path.name == SCORES else found.modes).append(_read(path, name))
        except ValueError as error:
            found.warnings.append(f"{path}: left out, {error}")
    return found


def _read(path: Path, name: str) -> Run:
    """Raises ValueError with the reason if the file is not what it should be."""
    content = _object(path)
    if path.name == MODES:
        protocol, entries = _object(path.with_name("protocol.json")), content
    else:
        test = content if PROTOCOL in content else content.get("test")
        if not isinstance(test, dict) or PROTOCOL not in test:
            raise ValueError(f"it does not say how it was measured; {HOW}")
        protocol, entries = test[PROTOCOL], test
        if content.get("upper_bound") and isinstance(test.get("model"), dict):  # which a fit says of its model
            entries = test | {"model": test["model"] | {"upper_bound": True}}
    if not isinstance(protocol, dict):
        raise ValueError("its protocol is no mapping")
    if lacking := [key for key in NEEDED[path.name] if key not in protocol]:
        raise ValueError(f"its protocol does not say {', '.join(lacking)}")
    scored = {key: entry for key, entry in entries.items() if key != PROTOCOL and isinstance(entry, dict)}
    if not scored or not all(map(_is_entry, scored.values())):
        raise ValueError("it holds no scores by predictor")
    return Run(name, protocol, scored)


def _is_entry(entry: dict[str, Any]) -> bool:
    """Whether regions hold views, and views hold metrics, as far as there are any."""
    views = [entry.get(region, {}) for region in REGIONS]
    parts = [part for view in views if isinstance(view, dict) for part in view.values()]
    return all(isinstance(part, dict) for part in [*views, *parts, entry.get("seconds") or {}])


def _object(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path.name} is missing beside it") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"it cannot be read as JSON ({' '.join(str(error).split())})") from None
    if not isinstance(content, dict):
        raise ValueError("it holds no mapping")
    return content
