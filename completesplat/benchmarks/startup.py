"""`completesplat bench startup`: time to the first scene from a cold start."""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from PIL import Image
from rich.console import Console

from completesplat.benchmarks.measuring import Row, report
from completesplat.commands.protocol import git_commit
from completesplat.errors import CompleteSplatError
from completesplat.settings.schema import Positive

TORCH, PREDICT, AGAIN, VIEW = "import torch", "predict", "predict once more", "view, until its page is there"
# The second call needs no imports and no compilation of kernels: it has settings, weights, a sample and files left.
TWICE = """
import json, sys, time
from completesplat.cli import main
arguments = list(sys.argv)
main()
sys.argv, start = arguments, (time.process_time(), time.perf_counter())
main()
print(json.dumps([time.process_time() - start[0], time.perf_counter() - start[1]]))
"""
# The working folder may hold another version of the package.
SETTINGS = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"}


class Seconds(NamedTuple):
    """CPU and wall-clock seconds of a process and its children."""

    cpu: float
    wall: float


def run(weights: str, repeats: Positive, out: Path) -> None:
    """Time whole processes in turn, write `startup.json`, and print a table.

    `conf/bench_task/startup.yaml` explains the settings. An untimed process of each kind comes first.

    Raises:
        CompleteSplatError: a process fails.
    """
    with TemporaryDirectory(prefix="bench_startup_") as folder:
        image = Path(folder) / "image.png"
        Image.new("RGB", (64, 64), "grey").save(image)  # its content does not change the work
        shared = [f"weights={weights}", f"out={folder}/out"]
        programs = {PREDICT: ["predict", str(image), "samples=1", "video=[]", *shared], VIEW: ["view", *shared]}
        if find_spec("viser") is None:
            del programs[VIEW]
        times = timed(programs, repeats)
    rows: list[Row] = [
        {"what": name, "cpu_seconds": x.cpu, "wall_seconds": x.wall, "times_torch": x.cpu / times[TORCH].cpu}
        for name, x in times.items()
    ]
    title = "One sample, without a video, from a cold start, in one thread"
    report(out / "startup.json", {"commit": git_commit(), "rows": rows}, {title: rows})


def timed(programs: Mapping[str, Sequence[str]], repeats: int) -> dict[str, Seconds]:
    """Start processes in turn, each with one thread, and return their median times by name.

    `programs` has the arguments of `PREDICT`, and perhaps of `VIEW`, which is ended when it has printed an address.
    """
    kinds = {TORCH: ["-c", "import torch"]}
    kinds |= {name: ["-m", "completesplat", *arguments] for name, arguments in programs.items()}
    kinds[AGAIN] = ["-c", TWICE, *programs[PREDICT]]
    taken: dict[str, list[Seconds]] = {name: [] for name in kinds}
    with Console(stderr=True).status("") as status:
        for number in range(repeats + 1):
            for name, arguments in kinds.items():
                status.update(f"{name}: {number} of {repeats}")
                before, start = os.times(), time.perf_counter()
                printed = _run(arguments, first_line=name == VIEW)
                after, wall = os.times(), time.perf_counter() - start
                cpu = after.children_user - before.children_user + after.children_system - before.children_system
                seconds = Seconds(cpu, wall) if name != AGAIN else Seconds(*json.loads(printed.splitlines()[-1]))
                taken[name] += [seconds] if number else []  # the first process brings files into memory
    return {name: Seconds(*map(statistics.median, zip(*taken[name], strict=True))) for name in kinds}


def _run(arguments: Sequence[str], first_line: bool = False) -> str:
    """Return the output of Python with this process's package, until its end or its first line.

    Raises:
        CompleteSplatError: the process fails.
    """
    variables, pipe = {**os.environ, **SETTINGS, "PYTHONPATH": str(Path(__file__).parents[2])}, subprocess.PIPE
    with subprocess.Popen([sys.executable, *arguments], env=variables, stdout=pipe, stderr=pipe, text=True) as process:
        line = process.stdout.readline() if first_line and process.stdout is not None else ""
        if line:
            process.kill()
        printed, errors = process.communicate()
    if process.returncode and not line:
        last = (errors.strip().splitlines() or ["no message"])[-1]
        raise CompleteSplatError(f"a process that was timed has failed: {last}")
    return line + printed
