"""Folders of trained weights: in this package, of a user, or in a repository of the Hugging Face hub.

A folder holds `config.json`, `model.safetensors` and `SHA256SUMS` (for `sha256sum -c`). Weights in this package have a
model card too, `README.md`.
"""

import hashlib
import os
import re
from pathlib import Path
from urllib.parse import urlparse

from completesplat.errors import WeightsError
from completesplat.files import printable, write_text

BOX = Path(__file__).parent
CONFIG_FILE, WEIGHTS_FILE, SUMS_FILE = "config.json", "model.safetensors", "SHA256SUMS"
# In a training run's folder: its final weights, its config, its newest checkpoint, fitted scenes.
RUN_WEIGHTS, RUN_CONFIG_FILE, RUN_CHECKPOINT, SCENES = "weights", "config.yaml", "checkpoints/last.ckpt", "scenes"
NEWEST = "pictures/newest"  # in a training run's folder, too: its fixed scenes as they are now, with `scenes.json`
CAMERA = "camera"  # in stage 1's checkpoints: the typical camera of the training set
LARGEST_TEXT = 1_000_000
HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")


def checkpoint_of(weights: Path | str) -> Path | None:
    """Return the checkpoint that `weights` means: a file, or the newest of a run without final weights; else None.

    For a run without checkpoints (it has nothing to train), return the path where one would be.
    """
    path = Path(str(weights)).expanduser()
    if str(weights) in in_the_box() or not os.path.exists(path):  # `Path.exists` raises if a name is too long
        return None
    if path.is_file():
        return path
    if any((folder / CONFIG_FILE).is_file() for folder in (path, path / RUN_WEIGHTS)):
        return None
    return path / RUN_CHECKPOINT if (path / RUN_CONFIG_FILE).is_file() else None


def in_the_box() -> list[str]:
    """Return the names of the weights that come with the package."""
    return sorted(path.parent.name for path in BOX.glob(f"*/{WEIGHTS_FILE}"))


def weights_folder(weights: Path | str) -> Path:
    """Return the folder that `weights` means: a name of `in_the_box`, a folder, a run's folder, or an id on the hub.

    Files on the Hugging Face hub are downloaded once; its environment variables set a token, a mirror, or offline use.

    Raises:
        WeightsError: there is no such folder, files are missing, or one has another checksum.
    """
    folder = _locate(str(weights))
    for name in (CONFIG_FILE, WEIGHTS_FILE):
        if not (folder / name).is_file():
            raise WeightsError(f"{folder}: no {name} here; give the folder that training wrote as `weights`")
    sums = folder / SUMS_FILE
    if not sums.is_file():
        return folder
    known = read_small(sums).splitlines()
    for name in (CONFIG_FILE, WEIGHTS_FILE):
        if f"{sha256_of(folder / name)}  {name}" not in known:
            raise WeightsError(
                f"{folder / name}: damaged or changed, its SHA-256 is not the one in {SUMS_FILE}; "
                f"if the change is meant, remove {SUMS_FILE}"
            )
    return folder


def read_small(path: Path) -> str:
    """Return the text of a file about weights; raise WeightsError if it has more than 1 MB."""
    if path.stat().st_size > LARGEST_TEXT:
        raise WeightsError(f"{path}: of {path.stat().st_size} bytes, and {LARGEST_TEXT} are plenty")
    return path.read_text(errors="replace")


def write_sums(folder: Path) -> None:
    """Write the checksums of the two files of a model."""
    lines = [f"{sha256_of(folder / name)}  {name}\n" for name in (CONFIG_FILE, WEIGHTS_FILE)]
    write_text(folder / SUMS_FILE, "".join(lines))


def _locate(weights: str) -> Path:
    if weights in in_the_box():
        return BOX / weights
    local = Path(weights).expanduser()
    if os.path.exists(local):
        of_run = not (local / CONFIG_FILE).is_file() and (local / RUN_WEIGHTS / CONFIG_FILE).is_file()
        return local / RUN_WEIGHTS if of_run else local
    if HUB_ID.fullmatch(weights):
        return _download(weights)
    included = ", ".join(in_the_box()) or "no weights"
    raise WeightsError(f"{printable(weights)}: no such folder; with the package come {included}")


def _download(hub_id: str) -> Path:
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(hub_id, allow_patterns=[CONFIG_FILE, WEIGHTS_FILE, SUMS_FILE]))
    except Exception as error:  # from the hub, its HTTP library or the file system
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise WeightsError(f"{hub_id}: no folder here, and not to be had from the hub ({reason})") from error


def weights_file(weights: str, sha256: str | None, advice: str, hash_setting: str) -> Path:
    """Return the path of a file, or of the file at a URL (http or https), downloaded into torch's hub cache once.

    Args:
        sha256: the file's SHA-256, or its first digits; None takes any file.
        advice: the end of every error message: how to get the right file, and which option takes it.
        hash_setting: the option that `sha256` came from.

    Raises:
        WeightsError: the file is missing, cannot be downloaded, or has another SHA-256.
    """
    expected = None if sha256 is None else sha256.lower()
    url = weights.startswith(("http://", "https://"))
    path = _download_file(weights, expected, advice) if url else Path(weights).expanduser()
    if not path.is_file():
        raise WeightsError(f"{path}: no such file; {advice}")
    if expected is not None and not (actual := sha256_of(path)).startswith(expected):
        raise WeightsError(
            f"{path}: SHA-256 {actual}, not {sha256}; {advice} (if that file is meant, {hash_setting}={actual})"
        )
    return path


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _download_file(url: str, sha256: str | None, advice: str) -> Path:
    """Download a URL's file into torch's hub cache, which torchvision uses too, unless it is there."""
    import torch

    path = Path(torch.hub.get_dir()) / "checkpoints" / Path(urlparse(url).path).name
    if path.is_file():
        return path
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(url, str(path), hash_prefix=sha256)
    except (OSError, RuntimeError) as error:
        raise WeightsError(f"{url} cannot be downloaded to {path.parent} ({error}); elsewhere, {advice}") from error
    return path
