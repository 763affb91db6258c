"""The record of a job, and the settings with which a run may continue."""

import json
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

from omegaconf import OmegaConf

from completesplat.commands.locks import LOCK
from completesplat.errors import CompleteSplatError, DivergenceError
from completesplat.evaluation.provenance import git_commit
from completesplat.evaluation.records import CONFIG, RECORD, SCORES, read_record
from completesplat.files import atomic_path, write_bytes, write_json
from completesplat.version import __version__
from completesplat.weights import RUN_CHECKPOINT

OF_MACHINES = ("trainer.devices", "trainer.num_nodes", "trainer.strategy")
# This class scores the trained model, so a run may continue although an earlier version recorded another name of it.
SCORES_CLASS = "evaluation.scoring._target_"
MAY_CHANGE = (
    "ckpt_path",
    "data.allow_changed",
    "optimized_metric",
    "skip_unchanged",
    "test",
    SCORES_CLASS,
    *OF_MACHINES,
)
ENDS = ("trainer.max_steps", "trainer.max_epochs", "trainer.max_time")
"""`MAY_CHANGE` and `ENDS` are the settings, with all below them, that may differ when a run continues."""


def is_finished(out: Path, config: Mapping[str, object], overrides: Sequence[str] = ()) -> bool:
    """Return whether a job's directory holds its results up to its end, for jobs that can continue (`ckpt_path`).

    Raises:
        CompleteSplatError: the directory holds a run that would be lost, or that had other settings.
    """
    finished = (out / SCORES).is_file()
    begun = finished or any((out / RUN_CHECKPOINT).parent.glob("*.ckpt"))
    if "ckpt_path" not in config or not begun or not (out / CONFIG).is_file():
        return False
    if config["ckpt_path"] != "last":
        raise CompleteSplatError(f"{out} holds a run: continue it with ckpt_path=last, or choose another out=DIR")
    earlier = OmegaConf.load(out / CONFIG)
    _refuse_another_run(out, config, earlier, overrides)
    if not finished:
        return False
    if _ends(config) != _ends(earlier):
        _refuse_earlier_end(out, _ends(config), _ends(earlier))
        return False
    if config.get("test") and not OmegaConf.select(earlier, "test", default=True):
        raise CompleteSplatError(f"{out} is finished, without a test: completesplat test ckpt={out}")
    return True


def _refuse_another_run(out: Path, config: Mapping[str, object], earlier: object, overrides: Sequence[str]) -> None:
    """Raise CompleteSplatError if a directory's run had settings that a run cannot continue with."""
    before = cast(dict[str, object], OmegaConf.to_container(earlier))
    moved = str(before.get("out") or "/nowhere"), str(config.get("out"))
    different = differences(before, config, moved)
    others = {key for key in different if not _may_differ(key)}
    if not others:
        return
    advice = "choose another out=DIR"
    if "model._target_" in others:
        raise CompleteSplatError(f"{out} holds a run with another model: {advice}")
    # `model` repeats settings from outside it.
    names = [key for key in others if key.removeprefix("model.") not in others - {key}]
    names.sort(key=lambda key: (key.count("."), key))
    listed = ", ".join(names[:3])
    if len(names) > 3:
        listed += f" and {len(names) - 3} more"
    if (out / RUN_CHECKPOINT).is_file():
        same = [argument for argument in overrides if not argument.startswith(("out=", "ckpt_path="))]
        again = shlex.join(["completesplat", "fit", *same, f"ckpt_path={out / RUN_CHECKPOINT}", "out=MORE"])
        advice = f"give all settings of {out / RECORD} again, or continue in another folder: {again}"
    raise CompleteSplatError(f"{out} holds a run with another {listed}: {advice}")


def _may_differ(key: str) -> bool:
    """Return whether a setting is one of `MAY_CHANGE` and `ENDS`, or lies below one."""
    return any(key == allowed or key.startswith(f"{allowed}.") for allowed in (*MAY_CHANGE, *ENDS))


def _refuse_earlier_end(out: Path, ends: Mapping[str, Any], earlier: Mapping[str, Any]) -> None:
    """Raise CompleteSplatError if a finished run cannot go on to new `max_steps` or `max_epochs`.

    `trainer.max_time` is not compared, because the results do not tell how long the run took.
    """
    if not (out / RUN_CHECKPOINT).is_file():
        raise CompleteSplatError(f"{out} has no {RUN_CHECKPOINT} to continue from: choose another out=DIR")
    steps = json.loads((out / SCORES).read_text())["steps"]
    if 0 <= ends["trainer.max_steps"] <= steps:
        raise CompleteSplatError(f"trainer.max_steps={ends['trainer.max_steps']}: {out} has {steps} steps; give more")
    epochs = ends["trainer.max_epochs"]
    before = earlier["trainer.max_epochs"]
    unlimited = (None, -1)
    if epochs not in unlimited and (before in unlimited or epochs < before):
        raise CompleteSplatError(f"trainer.max_epochs={epochs} may end before the run in {out}: choose another out=DIR")


def differences(earlier: object, config: object, moved: tuple[str, str] = ("/", "/"), key: str = "") -> set[str]:
    """Return the keys of settings that differ by more than the folder's move.

    A setting that is off, and that the earlier config did not have, makes no difference.
    """
    if isinstance(earlier, dict) and isinstance(config, dict):
        names: set[str] = set()
        for part in earlier.keys() | config.keys():
            place = f"{key}.{part}" if key else part
            if part not in earlier and not config[part]:
                continue
            names |= differences(earlier.get(part), config.get(part), moved, place)
        return names
    if isinstance(earlier, str) and f"{earlier}/".startswith(f"{moved[0]}/"):
        earlier = moved[1] + earlier.removeprefix(moved[0])
    return set() if earlier == config else {key}


@contextmanager
def recorded(out: Path, job: Mapping[str, object], config: Mapping[str, object]) -> Iterator[None]:
    """Record a job and its config.

    Those of an earlier job are restored if this one ends before it has written a file. The record of a training that
    diverged says so.
    """
    earlier = {path: path.read_bytes() for path in (out / RECORD, out / CONFIG) if path.is_file()}
    before = _written(out)
    renamed = _record(out, job, config)
    with atomic_path(out / CONFIG) as temporary:  # other processes may be reading it
        OmegaConf.save(config, temporary)
    try:
        yield
    except BaseException as error:
        nothing_written = _written(out) == before
        if isinstance(error, DivergenceError) and not (nothing_written and earlier):
            write_json(out / RECORD, {**read_record(out), "diverged": str(error)})
        elif nothing_written:
            for path, content in earlier.items():
                write_bytes(path, content)
            if renamed is not None:
                renamed.rename(out / SCORES)
        raise


def _written(out: Path) -> set[tuple[int, int]]:
    """Return inode and time of change of each file of a job but its lock, record, config, log and W&B's files."""
    files = set()
    for path in out.rglob("*"):
        is_record = path.name in (LOCK, RECORD, CONFIG, "wandb_id") or path.suffix == ".log"
        if is_record or "wandb" in path.relative_to(out).parts or not path.is_file():
            continue
        status = path.stat()
        files.add((status.st_ino, status.st_mtime_ns))
    return files


def _record(out: Path, job: Mapping[str, object], config: Mapping[str, object]) -> Path | None:
    """Write `run.json` with `job_entries`, times and earlier ends.

    Returns:
        The new name of earlier results, if there were any.
    """
    path = out / RECORD
    now = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    record: dict[str, Any] = {"version": __version__, "commit": git_commit(), **job, "started": now}
    renamed = None
    if path.is_file() and (out / RUN_CHECKPOINT).is_file():
        earlier = json.loads(path.read_text())
        record["started"] = earlier["started"]
        record["continued"] = [*earlier.get("continued", []), now]
        record["earlier_ends"] = earlier.get("earlier_ends", [])
        if "ckpt_path" in config:
            ends = _ends(OmegaConf.load(out / CONFIG))
            if ends != _ends(config):
                record["earlier_ends"].append({"until": now, "command": earlier["command"], **ends})
                renamed = _rename_results(out)
    write_json(path, record)
    return renamed


def _rename_results(out: Path) -> Path | None:
    """Name the results of a run that goes on after their number of steps.

    Returns:
        The new path, or None if there are no results.
    """
    results = out / SCORES
    if not results.is_file():
        return None
    steps = json.loads(results.read_text())["steps"]
    return results.rename(out / f"metrics_{steps}_steps.json")


def _ends(config: object) -> dict[str, Any]:
    return {key: OmegaConf.select(OmegaConf.create(config), key) for key in ENDS}  # type: ignore[call-overload]
