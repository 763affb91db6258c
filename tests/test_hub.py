"""Weights from the Hugging Face hub: huggingface_hub's own download, from a server that answers as the hub does."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from hashlib import sha256
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest
from support import serving

COMMIT = "a" * 40
MODEL = "someone/model"


class Hub(BaseHTTPRequestHandler):
    """Answers for one repository, `MODEL`, whose files are in the folder `files`; the rest is not found."""

    files: Path

    def do_HEAD(self) -> None:
        self.answer()

    def do_GET(self) -> None:
        self.wfile.write(self.answer())

    def answer(self) -> bytes:
        """Send the status and headers of an answer, and return its body."""
        path, listed = self.path.partition("?")[0], sorted(self.files.iterdir())
        kind, _, name = path.removeprefix(f"/{MODEL}/resolve/{COMMIT}").rpartition("/")
        headers, body = {}, b""
        if path == f"/api/models/{MODEL}/revision/main":
            body = json.dumps(
                {"id": MODEL, "sha": COMMIT, "siblings": [{"rfilename": x.name} for x in listed]}
            ).encode()
        elif path == f"/api/models/{MODEL}/tree/{COMMIT}":
            sizes = [{"type": "file", "path": x.name, "size": x.stat().st_size, "oid": x.name} for x in listed]
            body = json.dumps(sizes).encode()
        elif kind == "" and (self.files / name).is_file():
            body = (self.files / name).read_bytes()
            headers = {"ETag": f'"{sha256(body).hexdigest()}"', "X-Repo-Commit": COMMIT}
        self.send_response(200 if body else 404)
        for header, value in {**headers, "Content-Length": str(len(body))}.items():
            self.send_header(header, value)
        self.end_headers()
        return body

    def log_message(self, *_: object) -> None: ...


@pytest.fixture
def address(tiny_weights: Path) -> Iterator[str]:
    with serving(type("TinyHub", (Hub,), {"files": tiny_weights})) as address:
        yield address


@pytest.mark.processes
def test_weights_are_downloaded_once_with_a_word_and_no_lines_of_requests(address, pipeline, tmp_path):
    def predict(name: str, **environment: str) -> subprocess.CompletedProcess:
        given = [f"image={pipeline.photograph()}", f"weights={MODEL}", "samples=1", "video=[]", "steps=1"]
        known = os.environ | {"HF_HOME": str(tmp_path / "cache"), "HF_ENDPOINT": address, "no_proxy": "127.0.0.1"}
        program = [sys.executable, "-m", "completesplat", "predict", *given, f"out={name}"]
        return subprocess.run(program, cwd=tmp_path, env=known | environment, capture_output=True, text=True)

    first, again = predict("first"), predict("again", HF_HUB_OFFLINE="1")
    assert (first.returncode, again.returncode) == (0, 0), first.stderr + again.stderr
    assert f"{MODEL}: not a folder here; asking the Hugging Face hub" in first.stdout
    assert "HTTP Request" not in first.stdout + first.stderr
    scenes = [next((tmp_path / name).glob("*/sample_00.ply")).read_bytes() for name in ("first", "again")]
    assert scenes[0] == scenes[1]
    missing = predict("other", HF_ENDPOINT=f"{address}/nowhere", HF_HOME=str(tmp_path / "empty"))
    assert (missing.returncode, missing.stderr.count("\n")) == (2, 1), missing.stderr
    assert f"error: {MODEL}: no folder here, and not to be had from the hub" in missing.stderr
