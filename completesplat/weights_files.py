"""Files of published weights: given, or downloaded once, and held to their SHA-256."""

import hashlib
from pathlib import Path
from urllib.parse import urlparse

import torch

from completesplat.errors import WeightsError


def weights_file(weights: str, sha256: str | None, advice: str, hash_setting: str) -> Path:
    """The file, which exists and has the hash.

    Args:
        weights: a file, or a URL (http or https) that is downloaded into torch's hub cache once.
        sha256: the file's SHA-256, or its first digits; None takes any file.
        advice: how to get the right file and where to give it, the end of every refusal.
        hash_setting: the setting that `sha256` came from, named where the file has another.

    Raises:
        WeightsError: the file is missing, cannot be downloaded, or is another one.
    """
    expected = None if sha256 is None else sha256.lower()
    url = weights.startswith(("http://", "https://"))
    path = _download(weights, expected, advice) if url else Path(weights).expanduser()
    if not path.is_file():
        raise WeightsError(f"{path}: no such file; {advice}")
    if expected is not None:
        found = sha256_of(path)
        if not found.startswith(expected):
            raise WeightsError(
                f"{path}: SHA-256 {found}, not {sha256}; {advice} (if that file is meant, {hash_setting}={found})"
            )
    return path


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _download(url: str, sha256: str | None, advice: str) -> Path:
    """The file of a URL in torch's hub cache, where torchvision keeps its own too."""
    path = Path(torch.hub.get_dir()) / "checkpoints" / Path(urlparse(url).path).name
    if path.is_file():
        return path
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(url, str(path), hash_prefix=sha256)
    except (OSError, RuntimeError) as error:
        raise WeightsError(f"{url} cannot be downloaded to {path.parent} ({error}); elsewhere, {advice}") from error
    return path
