"""Files of weights from disk and from URLs: the right ones, or a refusal that says what to do."""

import hashlib
import socket
from functools import partial
from http.server import SimpleHTTPRequestHandler
from pathlib import Path

import pytest
import torch
from support import serving

from completesplat.errors import WeightsError
from completesplat.weights import weights_file

CONTENTS = b"weights"
HASH = hashlib.sha256(CONTENTS).hexdigest()


def find(weights: object, sha256: str | None = None) -> Path:
    return weights_file(str(weights), sha256, "do this", "its.hash")


def refusal(weights: object, sha256: str | None = None) -> str:
    with pytest.raises(WeightsError, match=r"^[^\n]*do this[^\n]*$") as caught:
        find(weights, sha256)
    return str(caught.value)


@pytest.fixture
def file(tmp_path):
    (tmp_path / "net.pth").write_bytes(CONTENTS)
    return tmp_path / "net.pth"


def test_the_right_hash_its_first_digits_or_none_find_the_file(file, monkeypatch):
    for sha256 in (None, HASH, HASH[:8], HASH.upper()):
        assert find(file, sha256) == file
    monkeypatch.setenv("HOME", str(file.parent))
    assert find("~/net.pth") == file


def test_missing_and_other_files_are_refused(file):
    for path in (file.with_name("none.pth"), file.parent):
        assert refusal(path) == f"{path}: no such file; do this"
    message = refusal(file, "0" * 64)
    assert f"{file}: SHA-256 {HASH}, not {'0' * 64}" in message
    assert f"its.hash={HASH}" in message


@pytest.fixture
def hub(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "_hub_dir", None)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    return tmp_path / "torch" / "hub" / "checkpoints"


@pytest.fixture
def url(file):
    """Serve the file's folder at this address."""
    handler = partial(SimpleHTTPRequestHandler, directory=str(file.parent))
    with serving(handler) as address:
        yield address


def test_a_url_is_downloaded_once_into_torchs_cache(hub, file, url):
    assert find(f"{url}/net.pth?token=1", HASH.upper()) == hub / "net.pth"
    file.unlink()
    assert find(f"{url}/net.pth").read_bytes() == CONTENTS
    (hub / "net.pth").write_bytes(b"another")
    assert f"{hub / 'net.pth'}: SHA-256" in refusal(f"{url}/net.pth", HASH)


def test_a_download_that_fails_or_has_another_hash_is_refused_and_not_kept(hub, url):
    assert "cannot be downloaded" in refusal(f"{url}/net.pth", "0" * 64)
    assert "404" in refusal(f"{url}/none.pth")
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        assert "cannot be downloaded" in refusal(f"http://127.0.0.1:{unused.getsockname()[1]}/net.pth")
    for malformed in ("http://127.0.0.1:1/a b.pth", "https://[x/a.pth"):
        assert "cannot be downloaded" in refusal(malformed)
    assert list(hub.iterdir()) == []
