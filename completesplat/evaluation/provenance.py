"""Provenance of results: program, command, machine, data and weights."""

import os
import platform
import shlex
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from completesplat.evaluation.records import read_record
from completesplat.settings.extensions import versions_of
from completesplat.version import __version__

if TYPE_CHECKING:
    from completesplat.data.loading.data_module import SceneDataModule
    from completesplat.evaluation.scorer import Scorer


def git_commit() -> str | None:
    """Return the commit of the source, with `-dirty` if files have changed since, or None without a repository."""

    def git(*arguments: str) -> str:
        command = ["git", "--no-optional-locks", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    try:
        if not git("ls-files", "."):  # the package is installed inside another repository
            return None
        commit = git("rev-parse", "HEAD").strip()
        changed = git("status", "--porcelain")
    except (OSError, subprocess.CalledProcessError):
        return None
    return f"{commit}-dirty" if changed else commit


def machine() -> dict[str, Any]:
    """Return processor, `gpu` (if there is one), versions and the date, as values that JSON can hold."""
    import torch

    described: dict[str, Any] = {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "system": platform.system(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "date": time.strftime("%Y-%m-%d"),
    }
    if torch.cuda.is_available():
        described["gpu"] = torch.cuda.get_device_name()
    return described


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def provenance(module: "Scorer", data: "SceneDataModule", out: Path) -> dict[str, object]:
    """Return the test data's fingerprint, program, command (that of `run.json` in `out`), extensions and machine."""
    record = read_record(out)
    parts = [type(part).__module__ for part in (*module.modules(), data)]
    return {
        "data_fingerprint": data.source("test").fingerprint(),
        "version": __version__,
        "commit": git_commit(),
        "command": shell_command(record.get("command", [])),
        "extensions": record.get("extensions", {}) | versions_of(parts),
        "machine": machine(),
    }


def shell_command(command: Sequence[str]) -> str:
    """Return a command as it could be typed. Its first part is the program and its verb."""
    return " ".join([*command[:1], *map(shlex.quote, command[1:])])


def checkpoint_facts(path: Path) -> dict[str, Any]:
    """Return path, checksum and step of a checkpoint, and whether it holds averages (`WeightAveraging`)."""
    from completesplat.weights import sha256_of
    from completesplat.weights.checkpoint_reading import read_checkpoint

    contents = read_checkpoint(path)
    return {
        "checkpoint": {"path": str(path), "sha256": sha256_of(path), "step": contents.get("global_step")},
        "ema": "averaging_state" in contents,
    }
