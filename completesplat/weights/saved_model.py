"""Base class of models that are saved as folders of weights and sent to the Hugging Face hub."""

import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Unpack

import torch
from safetensors.torch import save
from torch import nn

from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.files import home_path, make_folder, write_bytes
from completesplat.weights import (
    CONFIG_FILE,
    RUN_CHECKPOINT,
    RUN_WEIGHTS,
    SUMS_FILE,
    WEIGHTS_FILE,
    first_line,
    sha256_of,
    sums_of,
)
from completesplat.weights.hub import GRAPHS, check_destination, send
from completesplat.weights.model_card import CARD_FILE, Card, CardContents, ModelScores, card_text, read_scores
from completesplat.weights.opening import StoredModel, read_model

PICTURES = (".jpg", ".jpeg", ".png", ".webp")
LICENSE_FILES = "LICENSE*"
METRICS_FILE = "metrics.json"
PIPELINE_FILE = "pipeline.json"  # that of `completesplat.onnx_graphs`


class SavedModel(nn.Module):
    """Base class of models whose config and tensors are files.

    Args:
        architecture: the config that is written beside the weights.

    Attributes:
        file: file of tensors that it was read from, if it was.
    """

    def __init__(self, architecture: dict[str, Any]) -> None:
        super().__init__()
        self.architecture = architecture
        self.file: Path | None = None

    def weight_files(self) -> dict[str, bytes]:
        """Return the contents of `config.json`, `model.safetensors` and their checksums, by file name."""
        tensors = {key: value.contiguous().cpu() for key, value in self.state_dict().items()}
        files = {CONFIG_FILE: (json.dumps(self.architecture, indent=2) + "\n").encode(), WEIGHTS_FILE: save(tensors)}
        sums = [f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in files.items()]
        return files | {SUMS_FILE: "".join(sums).encode()}

    def save_pretrained(self, path: Path | str) -> None:
        """Write `config.json`, `model.safetensors` and their checksums into a folder, as `from_pretrained` reads them.

        Raises:
            CompleteSplatError, DiskError: see `make_folder`.
        """
        files = self.weight_files()
        folder = Path(path)
        folder.parent.mkdir(parents=True, exist_ok=True)
        make_folder(folder)
        for name, content in files.items():  # safetensors' own files are readable by their owner alone
            write_bytes(folder / name, content)

    def push_to_hub(
        self,
        repository: str,
        private: bool = False,
        confirm: bool = False,
        graphs: Path | str | None = None,
        **card: Unpack[CardContents],
    ) -> str:
        """Send weights, card and pictures to the Hugging Face hub, so that `from_pretrained(repository)` reads them.

        The token is that of `hf auth login`, or HF_TOKEN. Weights that have not changed since they were read are sent
        as their files are, with card, licence and images that lie beside them. Scores come from a test of exactly these
        weights, in their run's `metrics.json` or in `scores`.

        Args:
            repository: OWNER/NAME; it is made if there is none.
            private: make a new repository private.
            confirm: send without a question; otherwise ask on the terminal.
            graphs: folder that `to_onnx` wrote for these weights, sent as `try/`.
            **card: see `CardContents`.

        Returns:
            The address of the repository.

        Raises:
            CompleteSplatError: there is no token or no yes, or a picture or graph is missing.
            WeightsError: the hub refuses, or scores are of other weights.
        """
        check_destination(repository)
        files = self._files_to_send(repository, None if graphs is None else home_path(graphs), card)
        return send(repository, files, private, confirm)

    def _files_to_send(self, repository: str, graphs: Path | None, said: CardContents) -> dict[str, Path | bytes]:
        """Return all files of a repository by their paths in it. The card comes first."""
        folder = None if self.file is None else self.file.parent
        unchanged = False
        if self.file is not None and self.file.is_file():
            # It was opened before, with as much trust as it needs.
            unchanged = self._is(read_model(self.file, trust=True))
        as_stored = unchanged and self.file is not None and self.file.name == WEIGHTS_FILE
        files: dict[str, Path | bytes] = {}
        stored_pictures: list[Path] = []
        if as_stored:
            assert folder is not None
            files[CONFIG_FILE] = folder / CONFIG_FILE
            files[WEIGHTS_FILE] = folder / WEIGHTS_FILE
            files[SUMS_FILE] = sums_of(folder).encode()
            stored_pictures = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
        else:
            files.update(self.weight_files())
        pictures = _with_pictures(stored_pictures, said.get("pictures", ()))
        _add_files(files, [*_licenses(folder), *pictures])
        if graphs is not None:
            files.update(_graph_files(graphs))
        written = Card(
            repository,
            self.architecture,
            sum(parameter.numel() for parameter in self.parameters()),
            said,
            self._scores(unchanged, said.get("scores", ())),
            [path.name for path in pictures],
            graphs is not None,
        )
        before = None if folder is None else folder / CARD_FILE
        text = before.read_text(encoding="utf-8") if before is not None and before.is_file() else None
        return {CARD_FILE: card_text(written, text, as_stored).encode(), **files}

    def _is(self, stored: StoredModel, but: str = "") -> bool:
        """Return whether a stored model has this model's tensors and config, but for one setting."""
        state = self.state_dict()
        if stored.tensors.keys() != state.keys():
            return False
        if {**stored.architecture, but: None} != {**self.architecture, but: None}:
            return False
        return all(torch.equal(value.cpu(), stored.tensors[name].to(value.dtype)) for name, value in state.items())

    def _scores(self, unchanged: bool, folders: Sequence[str]) -> list[ModelScores]:
        """Return the scores of these weights: of their run, if it was tested, and in the folders of other tests.

        Raises:
            WeightsError: a test in the folders is of other weights.
        """
        if self.file is None or not unchanged:
            if folders:
                raise WeightsError(f"scores={folders[0]}: the model is not that of a file, which a test is of")
            return []
        run = self.file.parent.parent
        tested = {sha256_of(self.file)}
        for file in (run / RUN_CHECKPOINT, run / RUN_WEIGHTS / WEIGHTS_FILE):  # of one run, with the same weights
            with suppress(WeightsError):
                if file.is_file() and self._is(read_model(file, trust=False), but="training"):
                    tested.add(sha256_of(file))
        tests = []
        if (run / METRICS_FILE).is_file():
            test = read_scores(run / METRICS_FILE)
            if test is not None and test.checkpoint in tested:
                tests.append(test)
        for name in folders:
            path = home_path(name)
            path = path / METRICS_FILE if path.is_dir() else path
            test = read_scores(path)
            if test is None:
                raise WeightsError(f"{path}: there are no scores of a model in it")
            if test.checkpoint not in tested:
                advice = "test these by `completesplat test weights=...`"
                raise WeightsError(f"{path}: a test of other weights, by its SHA-256 of the file; {advice}")
            tests.append(test)
        return tests


def _licenses(folder: Path | None) -> list[Path]:
    return [] if folder is None else sorted(path for path in folder.glob(LICENSE_FILES) if path.is_file())


def _with_pictures(stored: Sequence[Path], names: Sequence[str]) -> list[Path]:
    """Return the images beside the weights and those that a user names, each once."""
    pictures = list(stored)
    for name in names:
        picture = _picture(name)
        if picture.resolve() not in [path.resolve() for path in pictures]:
            pictures.append(picture)
    return pictures


def _add_files(files: dict[str, Path | bytes], paths: Sequence[Path]) -> None:
    """Add files under their own names; raise CompleteSplatError if two have one name."""
    for path in paths:
        if path.name in files:
            raise CompleteSplatError(f"{path}: there are two files of this name; rename one")
        files[path.name] = path


def _picture(name: str) -> Path:
    """Return the path of an image; raise CompleteSplatError if it is missing or of a format that no page shows."""
    path = home_path(name)
    if not path.is_file():
        raise CompleteSplatError(f"pictures: {path}: no such file")
    if path.suffix.lower() not in PICTURES:
        raise CompleteSplatError(f"pictures: {path}: must be one of {', '.join(PICTURES)}")
    return path


def _graph_files(folder: Path) -> dict[str, Path | bytes]:
    """Return the ONNX graphs of `pipeline.json`, and that file, by their paths in a repository.

    Raises:
        CompleteSplatError: a file is missing or unreadable.
    """
    description = folder / PIPELINE_FILE
    try:
        graphs = json.loads(description.read_text(encoding="utf-8"))["graphs"]
        names = [Path(graph["file"]).name for graph in graphs.values()]
        files: dict[str, Path | bytes] = {f"{GRAPHS}/{name}": folder / name for name in [*names, PIPELINE_FILE]}
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        advice = f"model.to_onnx({str(folder)!r}) writes them"
        raise CompleteSplatError(
            f"{description}: no graphs that can be read ({first_line(error)}); {advice}"
        ) from error
    for name in names:
        if not (folder / name).is_file():
            raise CompleteSplatError(f"{folder / name}: no such file, although {PIPELINE_FILE} names it")
    return files
