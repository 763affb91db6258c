"""Protocol of a measurement: what was measured, with which program, and how."""

import subprocess
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from completesplat.results.machine import machine
from completesplat.results.runs import read_record, shell_command
from completesplat.version import __version__

if TYPE_CHECKING:
    from completesplat.data.loading.data_module import SceneDataModule
    from completesplat.metrics import Style


def git_commit() -> str | None:
    """Return the commit of the source, with `-dirty` if files have changed since; None without a repository."""

    def git(*arguments: str) -> str:
        command = ["git", "--no-optional-locks", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    try:
        if not git("ls-files", "."):  # the package is installed inside another repository
            return None
        return git("rev-parse", "HEAD").strip() + ("-dirty" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


Config = Mapping[str, Any]

METRICS: dict[str, dict[str, object]] = {
    "completesplat.metrics.images.psnr": {"range": [0, 1], "limit_db": 100},
    "completesplat.metrics.images.ssim": {"window": 11, "sigma": 1.5, "border": "mirrored, counted", "range": [0, 1]},
    "completesplat.metrics.images.perceptual_metric": {"net": "vgg", "version": "0.1", "range": [-1, 1]},
}
"""How the package's image metrics measure, by the `_target_` of their config."""


def protocol(evaluation: Config, module: Any, data: Any, results: dict[str, Any], out: Path) -> dict[str, Any]:
    """Describe what was measured and how, in a test by a config of `conf/evaluation/` with results in `out`."""
    from completesplat.metrics.scoring import BEST_RULES

    scored = module.evaluation
    model = results["model"]
    described = {
        "name": evaluation["name"],
        "method": module.method,
        **data.describe(),
        "image_size": (data.low_resolution or data).image_size,
        "resolution": data.image_size,
        **({} if data.background is None else {"background": data.background}),
        "precision": evaluation["precision"],
        "scenes_listed": data.source("test").listed,
        **{"scenes": model["scenes"], "skipped": len(scored.skipped), "views": model["views"]},
        **{"samples": scored.samples, "criterion": scored.criterion, "seed": scored.seed},
        **({"best": BEST_RULES} if scored.samples > 1 else {}),
        **sampler_settings(module),
        **({} if module.fitted_to is None else {"fitted_to": module.fitted_to}),
        "object_pixels": "background black in both, by the true mask cut at 0.5",
        "average": "over the views of a scene, then over scenes",
        "sharpness": "squared differences of neighbours, summed over a scene's novel views, over the truth's",
        "metrics": {name: described_metric(evaluation["metrics"][name], x) for name, x in scored.styles.items()},
        "missing": scored.missing,
        **provenance(data, out),
    }
    for metric in scored.set_metrics:
        described["metrics"] |= metric.settings()
    return described


def described_metric(config: Mapping[str, object], style: "Style") -> dict[str, object]:
    """Return how an image metric measures; of those that are not in `METRICS`, the config, and `style` for tables."""
    return METRICS.get(str(config["_target_"]), {**config, "style": asdict(style)})


def provenance(data: "SceneDataModule", out: Path) -> dict[str, object]:
    """Return the test data's fingerprint, and program, command (that of `run.json` in `out`) and machine."""
    command = shell_command(read_record(out).get("command", []))
    program = {"version": __version__, "commit": git_commit(), "command": command}
    return {"data_fingerprint": data.source("test").fingerprint(), **program, "machine": machine()}


def sampler_settings(module: Any) -> dict[str, object]:
    """Return the settings of the sampler; nulls for deterministic models and for scenes from files."""
    controls = ("skip_weight", "guidance_weight", "color_fits")
    if not hasattr(module, "completesplat"):
        return dict.fromkeys(("sampler", "steps", *controls))
    sampler = module.completesplat.sampler
    described = {"sampler": type(sampler.scheduler).__name__, "steps": sampler.steps}
    return described | {name: getattr(module, name) for name in controls}


def checkpoint_facts(path: Path) -> dict[str, Any]:
    """Return path, checksum and step of a checkpoint, and whether it holds averages (`WeightAveraging`)."""
    from completesplat.weights import sha256_of
    from completesplat.weights.checkpoint_reading import read_checkpoint

    contents = read_checkpoint(path)
    facts = {"path": str(path), "sha256": sha256_of(path), "step": contents.get("global_step")}
    return {"checkpoint": facts, "ema": "averaging_state" in contents}
