"""Counts how often real processes survive kills and signals, and prints a Markdown table: `make reliability`.

Every try that did not go as it should is printed below the table, and the exit status is 1.
"""

import argparse
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from itertools import chain, product
from pathlib import Path
from typing import NamedTuple

from support import SMALL, script, waited_for

from completesplat import cli
from completesplat.commands.jobs import LOCK
from completesplat.errors import WeightsError
from completesplat.results.machine import machine
from completesplat.training.checkpoints import read_checkpoint

MODULES = ("commands.fit", "training.reconstruction", "training.latent_diffusion", "training.sample_pictures")
"""Loaded once, for all processes that are forked."""
KILLS_OF_A_RUN, LANES = 10, 2
GONE_WITHIN, STARTS_WITHIN = 10.0, 300.0
"""Seconds that workers have to end after a process that a signal ended, and that a process has to start."""
KINDS = {name: getattr(signal, name) for name in ("SIGTERM", "SIGINT", "SIGHUP", "SIGUSR1")}
TWICE = "SIGTERM twice"
PLACES = ("fit", "fit -m", "test", "data prepare", "data latents")
ALONE, FIRST, SECOND = "one process", "two processes, to the first", "two processes, to the second"
CPU = "trainer.accelerator=cpu"


class Material(NamedTuple):
    """A folder with toy scenes, a trained model of each stage, and packed scenes."""

    folder: Path

    @property
    def var(self) -> Path:
        return self.folder / "var/checkpoints/last.ckpt"

    @property
    def diffusion(self) -> Path:
        return self.folder / "diffusion/checkpoints/last.ckpt"

    def arguments(self, stage: str) -> list[str]:
        given = ["fit", f"experiment=toy_{stage}", f"data.root={self.folder / 'toy'}", *SMALL, "data.workers=0"]
        own = [f"model.autoreconstructor_checkpoint={self.var}", "sampler.steps=2"]
        return [*given, *(own if stage == "diffusion" else [])]


def make(folder: Path, scenes: int) -> Material:
    """Fill an empty folder."""
    material = Material(folder)
    toy = ["kind=objects", f"scenes={scenes}", "frames=4", "size=32", "workers=1", f"out={folder / 'toy'}"]
    must_work(folder, "data", "toy", *toy)
    data = ["data=toy_objects", f"data.root={folder / 'toy'}", "data.image_size=32", "workers=1"]
    must_work(folder, *material.arguments("var"), f"out={folder / 'var'}")
    must_work(folder, *material.arguments("diffusion"), f"out={folder / 'diffusion'}")
    must_work(folder, "data", "prepare", *data, f"out={folder / 'packed'}")
    return material


def forked(folder: Path, *arguments: str) -> int:
    """A process group that runs the command; without what loading the package costs."""
    sys.stdout.flush()
    if pid := os.fork():
        return pid
    status = 1
    try:
        os.setsid()
        log = os.open(folder / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1)
        os.dup2(log, 2)
        sys.argv = [str(folder / "completesplat"), *arguments]
        cli.main()
        status = 0
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else 1
    finally:
        os._exit(status)


def must_work(folder: Path, *arguments: str) -> None:
    """Run the command."""
    _, status = os.waitpid(forked(folder, *arguments), 0)
    if status:
        raise RuntimeError(f"status {status} of {' '.join(arguments)}\n{(folder / 'log.txt').read_text()[-3000:]}")


# kill -9


def killed(material: Material, number: int, times: int) -> list[str]:
    """Kill a run and continue it, again and again, while it writes a checkpoint at every step; what was wrong."""
    folder, chance, found, step = material.folder / f"killed{number}", random.Random(number), [], 0
    last = folder / "checkpoints/last.ckpt"
    given = [*material.arguments("var"), "trainer.max_steps=100000", "trainer.val_check_interval=1000"]
    given += ["ckpt_path=last", "callbacks.pictures=null"]
    given += ["callbacks.checkpoint.every_n_train_steps=1", "callbacks.checkpoint.keep_every=7", f"out={folder}"]
    for one in range(times):
        before = last.stat().st_mtime_ns if last.is_file() else 0
        process = forked(material.folder, *given)
        begun = waited_for(lambda before=before: last.is_file() and last.stat().st_mtime_ns > before, STARTS_WITHIN)
        time.sleep(chance.uniform(0, 0.5))
        os.killpg(process, signal.SIGKILL)
        os.waitpid(process, 0)
        try:
            reached = read_checkpoint(last)["global_step"] if begun else step
            found += [] if reached > step else [f"kill {one} of run {number}: step {reached} after {step}"]
            step = reached
        except WeightsError as error:
            found.append(f"kill {one} of run {number}: {error}")
    shutil.rmtree(folder)
    return found


# Signals


def command(material: Material, place: str, who: str) -> list[str]:
    if place in ("data prepare", "data latents"):
        checkpoint = [f"ckpt={material.var}", "trust=true", f"overrides=['data.root={material.folder / 'packed'}']"]
        prepared = ["data=toy_objects", f"data.root={material.folder / 'toy'}", "sequences_per_shard=1"]
        prepared += ["data.image_size=32", f"workers={1 if who == ALONE else 2}"]
        return [*place.split(), *(prepared if place == "data prepare" else [*checkpoint, "batch_size=1"])]
    devices = [] if who == ALONE else ["trainer.devices=2"]
    if place == "test":
        sampled = [f"ckpt={material.diffusion}", "trust=true", "sampler=ddim50", "evaluation.scoring.samples=8"]
        return ["test", *sampled, "overrides=['data.workers=2','data.evaluation_batch_size=1']", CPU, *devices]
    given = [*material.arguments("var"), *devices, "trainer.max_steps=100000", "trainer.log_every_n_steps=1"]
    given += ["trainer.val_check_interval=50", "data.references_per_sequence=4", "data.workers=2"]
    given += ["callbacks.checkpoint.every_n_train_steps=100000"]
    return ["fit", "-m", *given[1:], "seed=0,1"] if place == "fit -m" else given


def processes_of(session: int) -> list[tuple[int, str]]:
    """Number and command line of the processes of a session that have not ended."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            fields = (path / "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == session and fields[0] != "Z":
                found.append((int(path.name), (path / "cmdline").read_text()))
        except OSError:  # has just ended
            continue
    return found


def signalled(material: Material, place: str, kind: str, who: str, seconds: float) -> list[str]:
    """Send a signal at a random moment of a command's work; what was not as it should be."""
    label, chance = f"{kind}, {place}, {who}", random.Random(f"{kind} {place} {who}")
    folder = Path(tempfile.mkdtemp(prefix="signalled", dir=material.folder))
    longest = 3.0
    for number in range(6):
        out = folder / str(number)
        given = [sys.executable, str(material.folder / "completesplat"), *command(material, place, who), f"out={out}"]
        with (folder / "log.txt").open("w") as log:
            process = subprocess.Popen(given, start_new_session=True, stdout=log, stderr=log)
        if not waited_for(partial(at_work, process, place, who, out), STARTS_WITHIN):
            os.killpg(process.pid, signal.SIGKILL)
            return [f"{label}: not at work after {STARTS_WITHIN:g} seconds: {(folder / 'log.txt').read_text()[-1000:]}"]
        time.sleep(chance.uniform(0, longest))
        if process.poll() is None:
            break
        if process.poll() != 0:
            return [f"{label}: status {process.poll()} by itself: {(folder / 'log.txt').read_text()[-1000:]}"]
        longest /= 2  # it had come to its end
    found = outcome(process, place, kind, who, out, folder / "log.txt", seconds)
    shutil.rmtree(folder)
    return [f"{label}: {one}" for one in found]


def at_work(process: subprocess.Popen, place: str, who: str, out: Path) -> bool:
    if process.poll() is not None:
        return True
    if who != ALONE and place != "data prepare" and second_of(process.pid) is None:
        return False
    if place in ("fit", "fit -m"):
        return any(path.stat().st_size for path in (out / "seed-0" if place == "fit -m" else out).glob("metrics.csv"))
    return (out / "config.yaml").is_file()


def second_of(session: int) -> int | None:
    return next((pid for pid, line in processes_of(session) if "--process-of" in line and pid != session), None)


def outcome(
    process: subprocess.Popen, place: str, kind: str, who: str, out: Path, log: Path, seconds: float
) -> list[str]:
    number = KINDS.get(kind, signal.SIGTERM)
    target = second_of(process.pid) if who == SECOND else process.pid
    sent = time.monotonic()
    os.kill(target or process.pid, number)
    if kind == TWICE:
        time.sleep(0.1)
        for one in (target, process.pid):
            if process.poll() is None:
                os.kill(one or process.pid, number)
    try:
        status = process.wait(seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return [f"had not ended after {seconds:g} seconds"]
    print(f"{kind}, {place}, {who}: status {status} after {time.monotonic() - sent:.1f} s", file=sys.stderr)
    expected = {128 + number, -number} if kind == TWICE else {128 + number}
    found = [] if status in expected else [f"status {status}: {log.read_text()[-2000:]}"]
    if not waited_for(lambda: not processes_of(process.pid), GONE_WITHIN):
        found += [f"left {line!r}" for _, line in processes_of(process.pid)]
        os.killpg(process.pid, signal.SIGKILL)
    return found + list(left_wrong(place, kind, out, log.read_text()))


def left_wrong(place: str, kind: str, out: Path, log: str) -> Iterator[str]:
    """What a command must not leave behind, and what it must."""
    run = out / "seed-0" if place == "fit -m" else out
    if (run / "metrics.json").exists():
        yield "metrics.json of work that was not done"
    if place in ("fit", "fit -m"):
        last = run / "checkpoints/last.ckpt"
        if last.is_file():
            read_checkpoint(last)
        elif kind != TWICE:
            yield "no checkpoint"
    if kind == TWICE:
        return
    if "leaked" in log:
        yield "leaked semaphores"
    if f"ended by {kind}" not in log:
        yield "no line that says so"
    half = {path for pattern in ("*.unfinished", ".*", "*.npy") for path in run.rglob(pattern)} - {run / LOCK}
    if half and not (place == "data latents" and (run / "latents.json").exists()):
        yield f"half written: {', '.join(path.name for path in half)}"


# The table


class Row(NamedTuple):
    fault: str
    tried: int
    problems: list[str]


def signal_rows(material: Material, repeated: int) -> Iterator[tuple[str, list[tuple[str, str, str]]]]:
    for place, who in product(PLACES, (ALONE, FIRST, SECOND)):
        if (place == "data latents" and who != ALONE) or (place == "data prepare" and who == SECOND):
            continue  # does not start such processes
        yield f"`{place}`, {who}", [(place, kind, who) for kind in (*KINDS, TWICE)] * repeated


def joined(lists: list[list[str]]) -> list[str]:
    return list(chain.from_iterable(lists))


def measured(material: Material, kills: int, repeated: int, seconds: float) -> Iterator[Row]:
    with multiprocessing.get_context("fork").Pool(LANES) as lanes:
        shares = [min(KILLS_OF_A_RUN, kills - first) for first in range(0, kills, KILLS_OF_A_RUN)]
        found = lanes.starmap(killed, [(material, n, share) for n, share in enumerate(shares)], chunksize=1)
        yield Row("`kill -9` while every step writes a checkpoint: it loads, the run goes on", kills, joined(found))
        for label, tries in signal_rows(material, repeated):
            found = lanes.starmap(signalled, [(material, *one, seconds) for one in tries], chunksize=1)
            yield Row(f"{', '.join(KINDS)}, {TWICE}: {label}", len(tries), joined(found))


def main() -> None:
    # Where this was started by `nohup`, or by a script with `&`, some are ignored, and would be by what it starts.
    for number in KINDS.values():
        signal.signal(number, signal.SIG_DFL)
    for module in MODULES:
        import_module(f"completesplat.{module}")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--signals", type=int, default=1, help="how often each signal is sent at each place")
    parser.add_argument("--seconds", type=float, default=10, help="that a process has to end after a signal")
    given, begun = parser.parse_args(), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="reliability") as name:
        script(Path(name))
        counted = measured(make(Path(name), 40), given.kills, given.signals, given.seconds)
        rows = [row for row in counted if row.tried]
    here = machine()
    print("| fault | tried | as it should be |\n|---|---|---|")
    for row in rows:
        print(f"| {row.fault} | {row.tried} | {row.tried - len({p.partition(':')[0] for p in row.problems})} |")
    software = f"{here['system']}, Python {here['python']}, torch {here['torch']}"
    print(f"\n`make reliability`, {here['date']}, {(time.monotonic() - begun) / 60:.0f} minutes;", end=" ")
    print(f"{here['processor']}, {here['cores']} cores, {software}.")
    problems = [problem for row in rows for problem in row.problems]
    print(*problems, sep="\n", end="")
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()
