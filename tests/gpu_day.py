"""Tests, times and trainings that need a GPU, step by step into one folder: `make gpu`.

A step that is done is not done again. One that fails holds up no other but those that need its files, and is tried
again the next time. `--small` goes through the same steps at tiny sizes, on any machine.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from completesplat.evaluation.provenance import git_commit, machine
from completesplat.files import write_json

RASTERIZERS = ["sizes=[16]", "views=[1]", "repeats=1"]
PLAN = ["data.image_size=32", "data.batch_size=2", "data.targets=1", "timed_steps=1"]
STAGE1 = ["trainer.max_steps=2", "trainer.val_check_interval=2", "trainer.limit_val_batches=1", "data.batch_size=2"]
STAGE1 += ["autoreconstructor.encoder.channels=[8,8,16]"]
STAGE2 = [*STAGE1, "conditioning.channels=[8,8,16]", "denoiser.channels=[16,32]", "sampler.steps=2"]


class Step(NamedTuple):
    """Arguments of Python, without those that name the folder; the step whose files it needs."""

    name: str
    arguments: list[str]
    needs: str | None = None


def verb(name: str, *arguments: str, needs: str | None = None, out: Path) -> Step:
    return Step(name, ["-m", "completesplat", *arguments, f"out={out / name}"], needs)


def steps(out: Path, small: bool) -> Iterator[Step]:
    """In the order of what one wants to know first, if time runs out."""

    def if_small(settings: list[str], otherwise: list[str] | None = None) -> list[str]:
        return settings if small else otherwise or []

    yield Step("tests", ["-m", "pytest", "-q", "-rs", "-m", "gpu", "tests/rasterizers", "tests/training/test_waits.py"])
    yield verb("rasterizers", "bench", "rasterizers", *if_small(RASTERIZERS), out=out)
    for stage in ("var_stage1", "diffusion"):
        experiment = f"experiment={'toy_var' if small else 'paper_' + stage}"
        yield verb(f"plan_{stage}", "plan", experiment, *if_small(PLAN, ["timed_steps=20"]), out=out)
    yield verb("data", "data", "toy", "kind=objects", "size=128", f"scenes={20 if small else 1000}", out=out)
    for size in (32, 48) if small else (64, 128):
        yield from training(out, size, small)
    yield verb("report", "report", f"runs={out}", out=out)


def training(out: Path, size: int, small: bool) -> Iterator[Step]:
    """Both stages on toy objects, two and a half minutes each, and their scores."""
    data = [f"data.root={out / 'data'}", f"data.image_size={size}", "test=false"]
    limit = [] if small else ["trainer.max_time=00:00:02:30", "trainer.max_steps=20000", "data.batch_size=64"]
    stage1 = ["fit", "experiment=toy_views_var", *data, "data.targets=6", *limit, *(STAGE1 if small else [])]
    yield verb(f"var_{size}", *stage1, needs="data", out=out)
    stage2 = ["fit", "experiment=toy_views_diffusion", *data, *limit, *(STAGE2 if small else [])]
    trained = f"model.autoreconstructor_checkpoint={out / f'var_{size}/checkpoints/last.ckpt'}"
    yield verb(f"diffusion_{size}", *stage2, trained, needs=f"var_{size}", out=out)
    arguments = ["test", f"ckpt={out / f'diffusion_{size}/checkpoints/last.ckpt'}"]
    yield verb(f"test_{size}", *arguments, needs=f"diffusion_{size}", out=out)


def done(step: Step, out: Path) -> bool:
    """Do a step; whether it worked. What it prints is in `NAME.txt`, or in `NAME.failed.txt`."""
    log, failed = out / f"{step.name}.txt", out / f"{step.name}.failed.txt"
    begun = time.monotonic()
    with failed.open("w") as written:
        process = subprocess.run(
            [sys.executable, *step.arguments], stdout=written, stderr=subprocess.STDOUT, check=False
        )
    if process.returncode == 0:
        failed.replace(log)
    result = f"done, {log}" if process.returncode == 0 else f"status {process.returncode}, {failed}"
    print(f"{step.name}: {result} ({time.monotonic() - begun:.0f} s)", flush=True)
    return process.returncode == 0


def run(out: Path, small: bool) -> list[str]:
    """Do what is not done yet; names of the steps that failed or could not be done."""
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "machine.json", machine() | {"commit": git_commit()})
    lacking: list[str] = []
    for step in steps(out, small):
        if (out / f"{step.name}.txt").is_file():
            continue
        if step.needs in lacking:
            print(f"{step.name}: needs {step.needs}", flush=True)
            lacking.append(step.name)
        elif not done(step, out):
            lacking.append(step.name)
    return lacking


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="tiny sizes, on any machine")
    parser.add_argument("--out", type=Path, help="folder; default: outputs/gpu, or outputs/gpu_small")
    options = parser.parse_args()
    lacking = run(options.out or Path("outputs/gpu_small" if options.small else "outputs/gpu"), options.small)
    sys.exit(f"not done: {', '.join(lacking)}" if lacking else 0)


if __name__ == "__main__":
    main()
