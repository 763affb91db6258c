"""The converter for formats that are not written here: npm's `@playcanvas/splat-transform`, as a program of its own."""

import os
import shutil
import signal
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from completesplat.errors import CompleteSplatError
from completesplat.export.atomic import atomic_path

PROGRAM = "splat-transform"
PACKAGE = "@playcanvas/splat-transform@2.7.1"
LIMIT_SECONDS = 600


@dataclass(frozen=True)
class SplatTransform:
    """The installed program."""

    program: str

    def convert(self, source: Path, target: Path, options: Sequence[str] = ()) -> None:
        """Write `target` in the format that its suffix names; the file appears whole or not at all.

        Raises:
            CompleteSplatError: the program fails, writes nothing, or takes more than ten minutes.
        """
        with atomic_path(target) as temporary:
            _run([self.program, "--quiet", "--overwrite", *options, str(source), str(temporary)])
            if not temporary.is_file():
                raise CompleteSplatError(f"{PROGRAM} has not written {target.name}")


def find_splat_transform() -> SplatTransform:
    """The program on PATH; without one npm's package, which `npx` downloads on first use and keeps (some 200 MB).

    Raises:
        CompleteSplatError: neither is there, or the program does not start.
    """
    program = shutil.which(PROGRAM)
    if program is None:
        npx = shutil.which("npx")
        if npx is None:
            raise CompleteSplatError(
                "formats spz, sog and html need Node.js 20 or newer with npm (https://nodejs.org);"
                " ply and splat need nothing"
            )
        program = _run([npx, "--yes", f"--package={PACKAGE}", "-c", f"command -v {PROGRAM}"]).strip()
    _run([program, "--version"])
    return SplatTransform(program)


def _run(command: Sequence[str]) -> str:
    """What a program prints.

    A session of its own, because npx starts further processes, which have to end with it.
    """
    name = Path(command[0]).name
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
        )
    except OSError as error:
        raise CompleteSplatError(f"{name} does not start: {error.strerror}") from error
    try:
        output, complaint = process.communicate(timeout=LIMIT_SECONDS)
    except BaseException as error:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        if isinstance(error, subprocess.TimeoutExpired):
            raise CompleteSplatError(f"{name} has not finished within {LIMIT_SECONDS} seconds") from error
        raise
    if process.returncode != 0:
        raise CompleteSplatError(f"{name} failed with status {process.returncode}: {_reason(complaint)}")
    return output


def _reason(complaint: str) -> str:
    """What a program said, without npm's hints and node's list of calls."""
    told = [line for line in complaint.splitlines() if not line.startswith(("npm warn", "    at "))]
    return " ".join(" ".join(told).split())[:500] or "it does not say why"
