"""Blender as a separate program: where it is, whether it is new enough, and one job."""

import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

from completesplat.errors import CompleteSplatError

LEAST_VERSION = (4, 2)
VARIABLE = "COMPLETESPLAT_BLENDER"
ADVICE = (
    '`python3.11 -m venv BLENDER` and `BLENDER/bin/pip install "bpy==4.2.0" "numpy<2"`, then blender=BLENDER/bin/python'
)
SCRIPT = Path(__file__).with_name("_scene_script.py")
SECONDS_TO_START = 120
# Neither this package's modules nor those beside the script are for Blender's Python.
PYTHON_OPTIONS = ("-E", "-P")


class Blender(NamedTuple):
    """Command that runs a Python script with `bpy`, and Blender's version."""

    command: tuple[str, ...]
    version: str


def find_blender(program: str | None = None) -> Blender:
    """Return the given program, or that of COMPLETESPLAT_BLENDER, `blender` on the path, or this Python with `bpy`.

    A program is Blender, or a Python that has `bpy`.

    Raises:
        CompleteSplatError: there is none, it cannot be run, or it is older than `LEAST_VERSION`.
    """
    this_python = sys.executable if find_spec("bpy") else None
    program = program or os.environ.get(VARIABLE) or shutil.which("blender") or this_python
    if program is None:
        raise CompleteSplatError(f"no Blender: give blender=PATH, or get one by {ADVICE}")
    output = _output_of(program, "--version")
    command: tuple[str, ...] = (program, "--background", "--factory-startup", "--python-exit-code", "1", "--python")
    if re.search(r"^Python 3", output, re.MULTILINE):
        command = (program, *PYTHON_OPTIONS)
        output = _output_of(*command, "-c", "import bpy; print('Blender', bpy.app.version_string)")
    version = re.search(r"^Blender ((\d+)\.(\d+)\S*)", output, re.MULTILINE)
    if version is None:
        last = _last_line(output, "it prints nothing")
        raise CompleteSplatError(f"{program}: neither Blender nor a Python with bpy ({last}); get one by {ADVICE}")
    if (int(version[2]), int(version[3])) < LEAST_VERSION:
        least = ".".join(map(str, LEAST_VERSION))
        raise CompleteSplatError(f"{program}: Blender {version[1]} is older than {least}; get one by {ADVICE}")
    return Blender(command, version[1])


def _last_line(text: str, default: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1] if lines else default


def _output_of(*command: str) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=SECONDS_TO_START)
    except (OSError, ValueError) as error:
        raise CompleteSplatError(f"{command[0]}: cannot be run: {getattr(error, 'strerror', error)}") from None
    except subprocess.TimeoutExpired:
        raise CompleteSplatError(f"{command[0]}: does not answer within {SECONDS_TO_START} seconds") from None
    return done.stdout + done.stderr


def run_job(
    blender: Blender, job: dict[str, Any], folder: Path, stopped: Event, minutes: float = math.inf
) -> dict[str, Any]:
    """Run `_scene_script.py` with a job, and return its result, or `refused` with the reason for which Blender failed.

    Args:
        folder: an existing folder for the job's files and Blender's messages.
        stopped: an event after which Blender is killed.
        minutes: time after which Blender is killed; the job's `memory` (bytes) limits it on Linux.
    """
    end = time.monotonic() + 60 * minutes
    path = folder / "job.json"
    messages = folder / "messages.txt"
    memory = job.get("memory")
    path.write_text(json.dumps(job))
    separator = () if PYTHON_OPTIONS[0] in blender.command else ("--",)
    with messages.open("wb") as output:
        command = [*blender.command, str(SCRIPT), *separator, str(path)]
        env = {**os.environ, "TMPDIR": str(folder)}
        # The script ends when its standard input does, that is, when this process has ended.
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": output, "stderr": subprocess.STDOUT}
        with subprocess.Popen(command, env=env, **pipes) as process:
            if sys.platform == "linux" and memory is not None:
                import resource

                with suppress(OSError, ValueError):  # a lower limit is in force
                    resource.prlimit(process.pid, resource.RLIMIT_DATA, (memory, memory))
            while process.poll() is None:
                if stopped.is_set() or time.monotonic() > end:
                    process.kill()
                time.sleep(0.1)
    result = folder / "result.json"
    if process.returncode == 0 and result.is_file():
        return dict(json.loads(result.read_text()))
    if time.monotonic() > end:
        return {"refused": f"took longer than max_minutes={minutes:g}"}
    if process.returncode < 0:
        limit = "out" if memory is None else f"more than {memory / 1e9:.1f} GB"
        return {"refused": f"Blender ended by signal {-process.returncode} (a crash, or {limit} of memory)"}
    last = _last_line(messages.read_text(errors="replace"), "no message")
    return {"refused": f"Blender failed: {last[:200]}"}
