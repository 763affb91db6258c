"""Shipped weights, and the files that weights consist of.

A folder of weights holds `config.json`, `model.safetensors` and `SHA256SUMS` (for `sha256sum -c`). Shipped weights have
a model card too, `README.md`.
"""

import hashlib
import logging
import os
import re
from collections.abc import Sequence
from http.client import HTTPException
from pathlib import Path
from urllib.parse import urlparse

from completesplat.errors import WeightsError
from completesplat.files import home_path, write_text
from completesplat.wording import printable

SHIPPED = Path(__file__).parent
CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
SUMS_FILE = "SHA256SUMS"
# In a training run's folder: its final weights, its config, its newest checkpoint, fitted scenes.
RUN_WEIGHTS = "weights"
RUN_CONFIG_FILE = "config.yaml"
RUN_CHECKPOINT = "checkpoints/last.ckpt"
SCENES = "scenes"
AUTO = "auto"  # in place of a name: the shipped weights whose training images are nearest to the photo
NEWEST = "images/newest"  # in a training run's folder, too: its fixed scenes as they are now, with `scenes.json`
CAMERA = "camera"  # in stage 1's checkpoints: the typical camera of the training set
LARGEST_TEXT = 1_000_000
HUB_ID = re.compile(
    r"(?:https?://(?:www\.)?huggingface\.co/|hf://|hf:)?"  # an address, or the hub's own short forms
    r"(?P<repository>[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)"
    r"(?:(?:@|/tree/)(?P<revision>[\w./-]*\w))?/?"
)
POINTER = b"version https://git-lfs"

log = logging.getLogger(__name__)


def shipped() -> dict[str, Path]:
    """Return the names and folders of the weights that come with the package."""
    return {path.parent.name: path.parent for path in sorted(SHIPPED.glob(f"*/{WEIGHTS_FILE}"))}


def locate(weights: Path | str) -> Path:
    """Return the tensor file that a name, folder, run, checkpoint or hub id stands for.

    A run stands for its final weights or, before they exist, for its newest checkpoint, which may not exist yet either.

    Raises:
        WeightsError: there is no such folder, a file is missing, or its checksum differs.
    """
    name = str(weights)
    path = home_path(weights)
    check_name(name)
    if name in shipped():
        path = shipped()[name]
    elif not os.path.exists(path):
        path = from_hub(name)
    elif path.is_file() and path.name != WEIGHTS_FILE:
        return path
    elif path.is_file():
        path = path.parent
    elif not (path / CONFIG_FILE).is_file():
        if (path / RUN_WEIGHTS / CONFIG_FILE).is_file():
            path /= RUN_WEIGHTS
        elif (path / RUN_CONFIG_FILE).is_file():
            return path / RUN_CHECKPOINT
    check_folder(path)
    return path / WEIGHTS_FILE


def check_name(name: str) -> None:
    """Raise WeightsError unless there is such a folder or file, with the package or here, or it may be a hub id."""
    exists = os.path.exists(home_path(name))  # `Path.exists` raises if a name is too long
    if name not in shipped() and not exists and HUB_ID.fullmatch(name) is None:
        included = ", ".join(shipped()) or "no weights"
        raise WeightsError(f"{printable(name)}: no such folder; with the package come {included}")


def check_folder(folder: Path) -> None:
    """Raise WeightsError if a file of weights is missing, or has another checksum than `SHA256SUMS`, if that exists."""
    sums = folder / SUMS_FILE
    known = None
    if sums.is_file():  # `sha256sum --binary` writes an asterisk before the name
        known = [line.replace(" *", "  ", 1) for line in read_small(sums).splitlines()]
    for name in (CONFIG_FILE, WEIGHTS_FILE):
        if not (folder / name).is_file():
            raise WeightsError(f"{folder}: no {name} here; {_missing_part(folder)}")
        if is_pointer(folder / name):
            advice = "run `git lfs pull` in its clone, or download the file itself"
            raise WeightsError(f"{folder / name}: a pointer of Git LFS in place of the file; {advice}")
        if known is not None and f"{sha256_of(folder / name)}  {name}" not in known:
            raise WeightsError(
                f"{folder / name}: damaged or changed, its SHA-256 is not the one in {SUMS_FILE}; "
                f"if the change is meant, remove {SUMS_FILE}"
            )


def _missing_part(folder: Path) -> str:
    """Return why a file of weights may be missing, and what to do."""
    if any(folder.glob("*.safetensors.index.json")) or any(folder.glob("*-of-*.safetensors")):
        return f"these tensors are in several parts: save them as one {WEIGHTS_FILE}"
    if any((folder / name).is_file() for name in (CONFIG_FILE, WEIGHTS_FILE, SUMS_FILE)):
        return "the copy or download is not complete: fetch the folder again"
    return "give the folder that training wrote as `weights`"


def is_pointer(file: Path) -> bool:
    """Return whether a file is a pointer of Git LFS, which a clone without LFS has in place of a large file."""
    with file.open("rb") as content:
        return content.read(len(POINTER)) == POINTER


def write_sums(folder: Path) -> None:
    """Write the checksums of the two files of a model."""
    write_text(folder / SUMS_FILE, sums_of(folder))


def sums_of(folder: Path) -> str:
    """Return the checksums of the two files of a model, as lines of `sha256sum`."""
    return "".join(f"{sha256_of(folder / name)}  {name}\n" for name in (CONFIG_FILE, WEIGHTS_FILE))


def read_small(path: Path) -> str:
    """Return the text of a file about weights; raise WeightsError if it has more than 1 MB."""
    if path.stat().st_size > LARGEST_TEXT:
        raise WeightsError(f"{path}: {path.stat().st_size} bytes; {LARGEST_TEXT} are plenty")
    return path.read_text(errors="replace")


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def first_line(error: Exception) -> str:
    """Return the first line of an error's message, or the name of its class."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def from_hub(
    hub_id: str, names: Sequence[str] = (CONFIG_FILE, WEIGHTS_FILE, SUMS_FILE), advice: str | None = None
) -> Path:
    """Download files of a repository on the Hugging Face hub once, as far as they exist, and return their folder.

    The repository is `OWNER/NAME`, its address, or either with `@REVISION`. The hub's environment variables set a
    token, a mirror, or offline use. The error message ends with `advice`.
    """
    from huggingface_hub import snapshot_download

    log.info("%s: not a folder here; asking the Hugging Face hub", hub_id)
    place = HUB_ID.fullmatch(hub_id)
    repository, revision = (hub_id, None) if place is None else place.group("repository", "revision")
    try:
        return Path(snapshot_download(repository, revision=revision, allow_patterns=list(names)))
    except Exception as error:  # from the hub, its HTTP library or the file system
        cause = first_line(error).split(". ")[0]
        ending = "" if advice is None else f"; {advice}"
        raise WeightsError(f"{hub_id}: no folder here, and not to be had from the hub ({cause}){ending}") from error


def weights_file(weights: str, sha256: str | None, advice: str, hash_setting: str) -> Path:
    """Return the path of a file, or of the file at a URL, downloaded once into torch's hub cache (as by torchvision).

    Args:
        sha256: the file's SHA-256, or its first digits; None takes any file.
        advice: the end of every error message: how to get the right file, and which option takes it.
        hash_setting: the option that `sha256` came from.

    Raises:
        WeightsError: the file is missing, cannot be downloaded, or has another SHA-256.
    """
    import torch

    expected = None if sha256 is None else sha256.lower()
    path = home_path(weights)
    if weights.startswith(("http://", "https://")):
        folder = Path(torch.hub.get_dir()) / "checkpoints"
        try:
            path = folder / Path(urlparse(weights).path).name
            if not path.is_file():
                folder.mkdir(parents=True, exist_ok=True)
                torch.hub.download_url_to_file(weights, str(path), hash_prefix=expected)
        except (OSError, RuntimeError, ValueError, HTTPException) as error:
            reason = f"cannot be downloaded to {folder} ({error})"
            raise WeightsError(f"{weights} {reason}; elsewhere, {advice}") from error
    if not path.is_file():
        raise WeightsError(f"{path}: no such file; {advice}")
    if expected is None:
        return path
    actual = sha256_of(path)
    if not actual.startswith(expected):
        meant = f"if that file is meant, {hash_setting}={actual}"
        raise WeightsError(f"{path}: SHA-256 {actual}, not {sha256}; {advice} ({meant})")
    return path
