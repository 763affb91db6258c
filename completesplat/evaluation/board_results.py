"""Results for the board: `result.json` and `result.jpg` of a test by a protocol that has a list of scenes.

A result states the conditions of its measurement. It stands in a protocol's table only if these are the protocol's
(`board.conditions` in `conf/evaluation/`), and if its copy of the input image scores as in the other results, because
that depends on the true images alone.
"""

import hashlib
import math
import statistics
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from PIL import Image

from completesplat.data.lists import listed_names
from completesplat.evaluation.protocol import PACKAGE_METRICS
from completesplat.evaluation.provenance import shell_command
from completesplat.evaluation.records import MODEL, read_mapping
from completesplat.evaluation.scene_scores import SceneScores
from completesplat.evaluation.scorer import PicturedScene, Scorer
from completesplat.export.images import to_pixels
from completesplat.files import write_json
from completesplat.photo.saving import save_image
from completesplat.wording import SHORT, printable

RESULT = "result.json"
PICTURE = "result.jpg"
COPY = "copy_reference"
COPY_SCORE = "full_novel_psnr"
SAME_IMAGES = 0.05  # dB; renders of other machines differ in their last digits
COLUMN_METRICS = {
    "psnr": "completesplat.metrics.images.psnr",
    "ssim": "completesplat.metrics.images.ssim",
    "lpips": "completesplat.metrics.images.perceptual_metric",
}
PICTURED = 3
"""Number of scenes in a picture: the first ones of the list."""
PICTURE_SIDE = 96  # pixels of an image in a picture
QUALITY = 80  # of its JPEG
MEAN = "mean"
ERROR = "standard_error"
FORM: Mapping[str, type] = {"protocol": str, "method": str, "conditions": dict, "scores": dict, "described": dict}
"""Entries of a result, each with its type in JSON."""
FORM_OF_DESCRIPTION: Mapping[str, type] = {"samples": int, "machine": dict}
"""Entries of `described` that the board's tables need."""
KINDS = {str: "a text", int: "a whole number", dict: "a mapping"}
"""These types in words."""

Board = Mapping[str, Any]
"""Entry `board` of a protocol's config."""
ByScene = Mapping[str, Mapping[str, Mapping[str, float | None]]]
"""Scores by predictor, scene and name (`REGION_VIEW_METRIC`)."""


@dataclass(frozen=True)
class BoardResult:
    """One method's scores by one protocol, and the file that holds them."""

    file: Path
    content: Mapping[str, Any]

    @property
    def protocol(self) -> str:
        return str(self.content["protocol"])

    @property
    def method(self) -> str:
        return printable(self.content["method"])

    @property
    def picture(self) -> Path | None:
        """Return the picture beside the file, if there is one."""
        path = self.file.with_suffix(".jpg")
        return path if path.is_file() else None

    def score(self, predictor: str, name: str) -> tuple[float | None, float | None]:
        """Return mean and standard error of a predictor's score, None where there is none."""
        score = self.content["scores"].get(predictor, {}).get(name, {})
        return score.get(MEAN), score.get(ERROR)


class FoundResults(NamedTuple):
    """Results in the order of their paths, and a line for each file that is left out."""

    results: list[BoardResult]
    left_out: list[str]


def digest_of(names: Iterable[str]) -> str:
    """Return the SHA-256 of a sorted list with one name a line, as are the files in `conf/evaluation/lists`."""
    text = "".join(f"{name}\n" for name in sorted(names))
    return hashlib.sha256(text.encode()).hexdigest()


def measured_conditions(described: Mapping[str, Any], names: Collection[str]) -> dict[str, object]:
    """Return the conditions of a test from its description (`describe_test`) and the names of its scored scenes."""
    reference, _, targets = str(described["protocol_views"]).partition("; targets: ")
    return {
        "data_set": str(described["data_set"]).partition("/")[0],
        "list_sha256": digest_of(names),
        "scenes": len(names),
        "resolution": described.get("resolution", described["image_size"]),
        "background": described.get("background"),
        "reference": reference.removeprefix("reference: "),
        "targets": targets,
    }


def scores_by_scene(evaluation: SceneScores) -> ByScene:
    """Return the scores of a test of images, with the names of `flat_scores`."""
    flat: dict[str, dict[str, dict[str, float | None]]] = {}
    for predictor, scenes in evaluation.scores.items():
        for scene, scores in scenes.items():
            named = {"_".join(key): value for key, value in scores.items()}
            flat.setdefault(predictor, {})[scene] = dict(named)
    return flat


def with_errors(by_scene: ByScene) -> dict[str, dict[str, dict[str, float | None]]]:
    """Return mean and standard error over the scenes of each score by predictor. One scene has no error."""
    results: dict[str, dict[str, dict[str, float | None]]] = {}
    for predictor, scenes in by_scene.items():
        results[predictor] = {}
        for name in dict.fromkeys(name for scores in scenes.values() for name in scores):
            given = [scores.get(name) for scores in scenes.values()]
            values = [value for value in given if value is not None]
            error = statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None
            if values:
                results[predictor][name] = {MEAN: statistics.fmean(values), ERROR: error}
    return results


def board_result(
    evaluation: Mapping[str, Any], described: Mapping[str, Any], by_scene: ByScene, method: str | None
) -> dict[str, object]:
    """Return the content of `result.json`.

    Args:
        evaluation: config of the protocol.
        described: description of the test and of what is tested.
        by_scene: scores of its scenes.
        method: name of the row; None: that in the description.
    """
    facts = dict(described)
    facts.pop("name")
    known = facts.pop("method")
    return {
        "protocol": evaluation["name"],
        "method": known if method is None else method,
        "conditions": measured_conditions(described, by_scene[MODEL]),
        "scores": with_errors(by_scene),
        "described": facts,
        "upper_bound": False,
    }


def refusal(result: BoardResult, conditions: Mapping[str, object], copied: float | None) -> str | None:
    """Return why a result does not belong into a protocol's table, or None.

    Args:
        conditions: `conditions` of the protocol's `board`. One that is not among the result's conditions, such as the
            number of samples, is in its description.
        copied: PSNR of the copy of the input image in other results; None: there are none.
    """
    measured = result.content["described"] | result.content["conditions"]
    for name, value in conditions.items():
        if measured.get(name) != value:
            return f"{name} is {measured.get(name)}, that of the protocol {value}"
    metrics = result.content["described"].get("metrics") or {}
    for name, target in COLUMN_METRICS.items():
        if name in metrics and metrics[name] != PACKAGE_METRICS[target]:
            return f"{name} was measured with {metrics[name]}, by the protocol with {PACKAGE_METRICS[target]}"
    copy, _ = result.score(COPY, COPY_SCORE)
    if copied is not None and copy is not None and abs(copy - copied) > SAME_IMAGES:
        return f"a copy of the input image has {copy:.2f} dB, in other results {copied:.2f}: the true images differ"
    return None


def prepare_for_board(module: Scorer, evaluation: Mapping[str, Any]) -> None:
    """Set a module's background and the scenes of its picture, if the protocol is on the board."""
    board = evaluation["board"]
    if board is None:
        return
    background = board["conditions"].get("background")
    if background is not None:
        module.background = background
    if board["pictures"]:
        module.pictured = dict.fromkeys(listed_names(board["list"])[:PICTURED])


def write_for_board(
    module: Scorer, evaluation: Mapping[str, Any], described: Mapping[str, Any], method: str | None, out: Path
) -> None:
    """Write `result.json`, and `result.jpg` where the data's licence allows it, if the protocol is on the board."""
    if evaluation["board"] is None:
        return
    result = board_result(evaluation, described, scores_by_scene(module.evaluation), method)
    result["upper_bound"] = module.upper_bound
    scenes = {name: scene for name, scene in module.pictured.items() if scene is not None}
    if scenes:
        write_picture(scenes, out / PICTURE)
    write_result(result, out)


def write_result(result: Mapping[str, object], out: Path) -> None:
    """Write `result.json`, and print the command that shows its row."""
    write_json(out / RESULT, result)
    command = shell_command(["completesplat report board", f"results={out}"])
    print(f"for the board: {out / RESULT}; {command} shows its row")


def read_results(folder: Path) -> FoundResults:
    """Read all results below a folder. JSON files with other names and other entries are no results."""
    found = FoundResults([], [])
    for path in sorted(folder.rglob("*.json")):
        content = read_mapping(path)
        if path.name != RESULT and not FORM.keys() <= content.keys():
            continue
        fault = fault_of(content)
        if fault is None:
            found.results.append(BoardResult(path, content))
        else:
            found.left_out.append(f"{path}: left out, because {fault}; write it again by completesplat test")
    return found


def fault_of(content: Mapping[str, Any]) -> str | None:
    """Return how a result's content differs in form from that of `board_result`, or None."""
    if not content:
        return "it cannot be read as a mapping in JSON"
    fault = _fault_of_entries(content, FORM) or _fault_of_entries(content["described"], FORM_OF_DESCRIPTION)
    if fault is not None:
        return fault
    if MODEL not in content["scores"]:
        return f"it has no scores of the method ({MODEL})"
    for predictor, scores in content["scores"].items():
        if not isinstance(scores, dict):
            return f"the scores of {predictor} are no mapping"
        for name, score in scores.items():
            if not _is_score(score):
                return f"{name} of {predictor} is {printable(score, SHORT)}, not a {MEAN} and a {ERROR}"
    return None


def _fault_of_entries(content: Mapping[str, Any], form: Mapping[str, type]) -> str | None:
    for name, kind in form.items():
        if name not in content:
            return f"it has no {name}"
        if not isinstance(content[name], kind):
            return f"{name} is {printable(content[name], SHORT)}, not {KINDS[kind]}"
    return None


def _is_score(score: object) -> bool:
    """Return whether this is a score: a finite mean, and a finite standard error or null."""
    if not isinstance(score, dict):
        return False
    error = score.get(ERROR)
    return _is_finite(score.get(MEAN)) and (error is None or _is_finite(error))


def _is_finite(number: object) -> bool:
    return isinstance(number, int | float) and math.isfinite(number)


def write_picture(scenes: Mapping[str, PicturedScene], path: Path) -> None:
    """Write a JPEG with a row for each scene: its input, then pairs of a true view and its render."""
    rows = []
    for scene in scenes.values():
        images = [scene.truth[0]]
        for true, rendered in zip(scene.truth[1:], scene.renders[1:], strict=True):
            images += [true, rendered]
        row = torch.nn.functional.interpolate(torch.stack(images), (PICTURE_SIDE, PICTURE_SIDE), mode="area")
        rows.append(torch.cat(list(row), dim=-1))
    image = Image.fromarray(to_pixels(torch.cat(rows, dim=-2)))
    save_image(image, path, quality=QUALITY)
