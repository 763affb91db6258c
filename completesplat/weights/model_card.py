"""Model cards for the Hugging Face hub: metadata, scores of tests, and how the weights are used."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import yaml

from completesplat.errors import WeightsError
from completesplat.weights import first_line
from completesplat.weights.hub import GRAPHS

CARD_FILE = "README.md"
LIBRARY = "completesplat"
TASK = "image-to-3d"
UNKNOWN = "unknown"  # the hub's word for a licence that nobody stated
FACTS = ("resolution", "scenes", "views", "samples", "seed", "sampler", "steps", "color_fits", "version")
"""Entries of a protocol that a card repeats."""


class CardContents(TypedDict, total=False):
    """What a person says of weights on their card.

    Attributes:
        license: identifier of the licence, such as mit or cc-by-4.0; None: that of the card beside the weights.
        datasets: names of the training data; empty: that of the test.
        pictures: images to show, besides those that lie beside the weights.
        scores: folders of tests of exactly these weights, besides that of their own run.
    """

    license: str | None
    datasets: Sequence[str]
    pictures: Sequence[str]
    scores: Sequence[str]


class ModelScores(NamedTuple):
    """Scores of a model in one test, and the statement of how they were measured."""

    protocol: Mapping[str, Any]
    model: Mapping[str, Any]

    @property
    def data_set(self) -> str:
        return str(self.protocol["data_set"])

    @property
    def checkpoint(self) -> str | None:
        """SHA-256 of the file that was tested, if the test has noted it."""
        tested = self.protocol.get("checkpoint")
        return tested.get("sha256") if isinstance(tested, Mapping) else None

    def values(self) -> list[tuple[str, str, float]]:
        """Return metric, region and views, and value of each score."""
        return list(_numbers({key: part for key, part in self.model.items() if isinstance(part, Mapping)}, ()))


def _numbers(part: Mapping[str, Any], place: tuple[str, ...]) -> Iterator[tuple[str, str, float]]:
    for key, value in part.items():
        if isinstance(value, Mapping):
            if key != "seconds":
                yield from _numbers(value, (*place, key))
        elif isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            yield key, ", ".join(place), value


def read_scores(path: Path) -> ModelScores | None:
    """Return the test in a `metrics.json` of `fit` or `test`, or None if nothing was tested.

    Raises:
        WeightsError: the file cannot be read.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        test = content if "protocol" in content else content.get("test") or {}
        if not test.get("model"):
            return None
        return ModelScores({"data_set": UNKNOWN, "name": UNKNOWN} | test["protocol"], test["model"])
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise WeightsError(f"{path}: no scores that can be read ({first_line(error)})") from error


class Card(NamedTuple):
    """A card to write.

    Attributes:
        repository: OWNER/NAME on the hub.
        architecture: config of the weights.
        parameters: number of the weights.
        said: what the user says.
        scores: scores that may stand on the card, because they are those of these weights.
        pictures: file names of images in the repository.
        graphs: whether the repository has ONNX graphs.
    """

    repository: str
    architecture: Mapping[str, Any]
    parameters: int
    said: CardContents
    scores: Sequence[ModelScores]
    pictures: Sequence[str]
    graphs: bool

    def metadata(self, before: Mapping[str, Any]) -> dict[str, Any]:
        """Return the metadata of the card, which keeps what an earlier card has besides."""
        data_sets = list(self.said.get("datasets") or before.get("datasets") or ())
        for test in self.scores:
            name = test.data_set.partition("/")[0]
            if not self.said.get("datasets") and name not in [*data_sets, UNKNOWN]:
                data_sets.append(name)
        entries = dict(before)
        entries["license"] = self.said.get("license") or before.get("license") or UNKNOWN
        entries["library_name"] = LIBRARY
        entries["pipeline_tag"] = TASK
        if data_sets:
            entries["datasets"] = data_sets
        if self.scores:
            results = [_result(test) for test in self.scores]
            entries["model-index"] = [{"name": self.repository.rpartition("/")[2], "results": results}]
        return entries

    def text(self) -> str:
        """Return the text of a new card."""
        name = self.repository.rpartition("/")[2]
        size = self.architecture["image_size"]
        shown = (self.architecture.get("training") or {}).get("content")
        kind = "several complete 3D scenes" if "denoiser" in self.architecture else "one complete 3D scene"
        lines = [f"# {name}", ""]
        lines.append(f"Weights of completesplat: one photo in, {kind} of Gaussian splats out.")
        lines.append(
            f"They have {self.parameters / 1e6:.1f} million parameters and see images of {size} x {size} pixels."
        )
        if shown:
            lines.append(f"The training images show {shown}.")
        lines += ["", "```", f"completesplat predict image=photo.jpg weights={self.repository}", "```", ""]
        own = sorted(set(own_modules(self.architecture)))
        if own:
            lines += [f"They need {', '.join(own)}, of a module that is not here; `trust=true` allows it.", ""]
        for test in self.scores:
            lines += _table(test)
        return self.with_additions("\n".join(lines))

    def with_additions(self, text: str) -> str:
        """Return a text with the pictures and the note on graphs that it does not have yet."""
        parts = [text.strip()]
        for picture in self.pictures:
            if picture not in text:
                parts.append(f"![{Path(picture).stem}]({picture})")
        if self.graphs and f"`{GRAPHS}/`" not in text:
            graphs = f"`{GRAPHS}/` has the networks as ONNX graphs, for programs without torch"
            parts.append(f"{graphs}, and `pipeline.json`, which says how they are run.")
        return "\n\n".join(parts) + "\n"


def own_modules(part: object) -> Iterator[str]:
    """Yield the classes of a user's own modules that a config names."""
    values: Sequence[object] = ()
    if isinstance(part, Mapping):
        target = str(part.get("_target_", ""))
        if "." in target:  # the package's classes are stored by their names alone
            yield target
        values = list(part.values())
    elif isinstance(part, list):
        values = part
    for value in values:
        yield from own_modules(value)


def _result(test: ModelScores) -> dict[str, Any]:
    """Return an entry of the hub's `model-index`."""
    facts = {name: test.protocol[name] for name in FACTS if test.protocol.get(name) is not None}
    metrics = [
        {"type": metric, "name": f"{metric} ({place})", "value": value} for metric, place, value in test.values()
    ]
    protocol = test.protocol["name"]
    return {
        "task": {"type": TASK, "name": "complete scene from one photo"},
        "dataset": {
            "type": test.data_set.partition("/")[0],
            "name": f"{test.data_set}, protocol {protocol}",
            "config": protocol,
            "split": "test",
            "args": facts,
        },
        "metrics": metrics,
    }


def _table(test: ModelScores) -> list[str]:
    """Return the lines of a table of scores."""
    facts = ", ".join(f"{name} {test.protocol[name]}" for name in FACTS if test.protocol.get(name) is not None)
    lines = ["## Scores", "", f"Test on {test.data_set}, protocol `{test.protocol['name']}`: {facts}.", ""]
    lines += ["| score | of | value |", "|---|---|---|"]
    lines += [f"| {metric} | {place} | {value:.4g} |" for metric, place, value in test.values()]
    return [*lines, ""]


def card_text(card: Card, before: str | None, unchanged: bool) -> str:
    """Return a card's file.

    Args:
        before: the card that lies beside the weights, if there is one. Its metadata stays where nothing newer is known.
        unchanged: the weights are those that lie beside it, so its text, scores and licence are theirs.

    Raises:
        WeightsError: the metadata of the card beside the weights cannot be read, or has another licence.
    """
    from huggingface_hub import ModelCard

    if before is None:
        metadata: dict[str, Any] = {}
        text = card.text()
    else:
        try:
            old = ModelCard(before)
        except Exception as error:  # of YAML, or the hub's own
            reason = f"its metadata cannot be read ({first_line(error)})"
            raise WeightsError(f"{CARD_FILE} beside the weights: {reason}") from error
        metadata = old.data.to_dict()  # type: ignore[no-untyped-call]
        text = card.with_additions(old.text) if unchanged else card.text()
        stated = metadata.get("license")
        wanted = card.said.get("license")
        if unchanged and None not in (stated, wanted) and stated != wanted:
            raise WeightsError(
                f"license={wanted}: {CARD_FILE} beside the weights says {stated}; change it there, if you may"
            )
        if not unchanged:
            metadata.pop("model-index", None)
    front = yaml.safe_dump(card.metadata(metadata), sort_keys=False, allow_unicode=True)
    return f"---\n{front}---\n\n{text}"
