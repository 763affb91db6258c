"""The statement of what was measured and how, which stands beside all figures of a test."""

import json
import math
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from completesplat import __version__
from completesplat.files import write_text
from completesplat.results.machine import machine
from completesplat.results.runs import origin


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write results in one step, so that a file that is there is whole.

    JSON has no NaN and no infinities: they become null, and an entry `not_finite` lists what they were.
    """
    found: list[str] = []
    kept = {key: _finite(value, key, found) for key, value in content.items()}
    kept |= {"not_finite": found} if found else {}
    write_text(path, json.dumps(kept, indent=2, allow_nan=False) + "\n")


def _finite(value: Any, place: str, found: list[str]) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(part, f"{place}.{key}", found) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part, f"{place}.{index}", found) for index, part in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        found.append(f"{place}: {value}")
        return None
    return value


def git_commit() -> str | None:
    """The commit of the source, marked when there are changes on top; None where there is no repository."""

    def git(*arguments: str) -> str:
        command = ["git", "--no-optional-locks", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    try:
        if not git("ls-files", "."):  # an installed package inside somebody else's repository
            return None
        return git("rev-parse", "HEAD").strip() + ("-dirty" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


METRICS: dict[str, dict[str, Any]] = {
    "psnr": {"range": [0, 1], "limit_db": 100},
    "ssim": {"window": 11, "sigma": 1.5, "border": "mirrored, counted", "range": [0, 1]},
    "lpips": {"net": "vgg", "version": "0.1", "range": [-1, 1]},
}


def protocol(
    evaluation: Mapping[str, Any], module: Any, data: Any, results: dict[str, Any], out: Path
) -> dict[str, Any]:
    """The statement beside a test's results in `out`, which followed a configuration of `conf/evaluation/`."""
    from completesplat.metrics.scoring import BEST_RULES

    scored, model = module.evaluation, results["model"]
    described = {
        "name": evaluation["name"],
        "method": module.method,
        **data.describe(),
        "image_size": (data.at_model_size or data).image_size,
        "resolution": data.image_size,
        **({} if data.background is None else {"background": data.background}),
        "precision": evaluation["precision"],
        "scenes_listed": data.source("test").listed,
        **{"scenes": model["scenes"], "skipped": len(scored.skipped), "views": model["views"]},
        **{"samples": scored.samples, "criterion": scored.criterion, "seed": scored.seed},
        **({"best": BEST_RULES} if scored.samples > 1 else {}),
        **drawing(module),
        "object_pixels": "background black in both, by the true mask cut at 0.5",
        "average": "over the views of a scene, then over scenes",
        "metrics": {name: METRICS[name] for name in scored.metrics if name in METRICS},
        "missing": scored.missing,
        **provenance(data, out),
    }
    for metric in scored.set_metrics:
        described["metrics"] |= metric.settings()
    return described


def provenance(data: Any, out: Path) -> dict[str, Any]:
    """The test data, and which program measured with it where; its command is that of `run.json` in `out`."""
    program = {"version": __version__, "commit": git_commit(), "command": origin(out, levels=0)["command"]}
    return {"data_fingerprint": data.source("test").fingerprint(), **program, "machine": machine()}


def drawing(module: Any) -> dict[str, Any]:
    """How samples are drawn; nulls for a model that draws none."""
    if not module.draws_samples:
        return dict.fromkeys(("sampler", "steps", "skip_weight", "guidance_weight"))
    sampler = module.completesplat.sampler
    return {
        "sampler": type(sampler.scheduler).__name__,
        "steps": sampler.steps,
        "skip_weight": module.skip_weight,
        "guidance_weight": module.guidance_weight,
    }


def checkpoint_facts(path: Path) -> dict[str, Any]:
    """Path, checksum and step of a checkpoint, and whether it holds an average (Lightning's `WeightAveraging`)."""
    from completesplat.weights import sha256_of
    from completesplat.weights.checkpoint_reading import read_checkpoint

    contents = read_checkpoint(path)
    facts = {"path": str(path), "sha256": sha256_of(path), "step": contents.get("global_step")}
    return {"checkpoint": facts, "ema": "averaging_state" in contents}
