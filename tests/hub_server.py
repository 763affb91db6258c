"""A server that answers as the Hugging Face hub does, for downloads and for commits with files in LFS."""

import base64
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import yaml
from support import serving

COMMIT = "a" * 40
MODEL = "someone/model"
TOKEN = "hf_of_a_test"
LFS_SUFFIXES = (".safetensors", ".onnx", ".jpg")


@dataclass
class Repositories:
    """Repositories in folders: OWNER/NAME below `root`, whether they are private, and what was asked of the server."""

    root: Path
    private: dict[str, bool] = field(default_factory=dict)
    blobs: dict[str, bytes] = field(default_factory=dict)
    requests: list[str] = field(default_factory=list)
    commits: list[list[str]] = field(default_factory=list)

    def folder(self, repository: str) -> Path | None:
        return self.root / repository if repository in self.private else None

    def add(self, repository: str, private: bool = False) -> Path:
        self.private[repository] = private
        (self.root / repository).mkdir(parents=True, exist_ok=True)
        return self.root / repository


class Hub(BaseHTTPRequestHandler):
    """Answers for the repositories of `store`. Whoever changes one, or reads a private one, needs `TOKEN`."""

    store: Repositories

    def do_HEAD(self) -> None:
        self.download()

    def do_GET(self) -> None:
        self.wfile.write(self.download())

    def download(self) -> bytes:
        """Send the status and headers of an answer, and return its body."""
        path = unquote(self.path.partition("?")[0])
        self.store.requests.append(f"{self.command} {path}")
        parts = path.strip("/").split("/")
        repository = "/".join(parts[2:4] if parts[0] == "api" else parts[:2])
        folder = self.store.folder(repository)
        if folder is None or (self.store.private[repository] and not self.has_token()):
            return self.send(404, b"", {"X-Error-Code": "RepoNotFound"})
        names = sorted(file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
        if parts[0] == "api" and parts[4:] in ([], ["revision", "main"]):
            siblings = [{"rfilename": name} for name in names]
            private = self.store.private[repository]
            return self.send_json(
                {"id": repository, "sha": COMMIT, "private": private, "siblings": siblings}, write=False
            )
        if parts[0] == "api" and parts[4:6] == ["tree", COMMIT]:
            sizes = [{"type": "file", "path": x, "size": (folder / x).stat().st_size, "oid": x} for x in names]
            return self.send_json(sizes, write=False)
        name = "/".join(parts[4:])
        if parts[2:4] == ["resolve", COMMIT] and name in names:
            content = (folder / name).read_bytes()
            return self.send(200, content, {"ETag": f'"{sha256(content).hexdigest()}"', "X-Repo-Commit": COMMIT})
        return self.send(404, b"", {"X-Error-Code": "EntryNotFound"})

    def do_POST(self) -> None:
        path = unquote(self.path.partition("?")[0])
        self.store.requests.append(f"POST {path}")
        body = self.body()
        if not self.has_token():
            self.wfile.write(self.send(401, b'{"error": "Invalid username or password."}', {}))
        elif path == "/api/validate-yaml":
            _, metadata, _ = json.loads(body)["content"].split("---\n", 2)
            assert isinstance(yaml.safe_load(metadata), dict)
            self.send_json({"warnings": []})
        elif path == "/api/repos/create":
            self.create(json.loads(body))
        elif path.endswith("/preupload/main"):
            files = [{"path": file["path"], **upload_mode(file["path"])} for file in json.loads(body)["files"]]
            self.send_json({"files": files})
        elif path.endswith(".git/info/lfs/objects/batch"):
            objects = json.loads(body)["objects"]
            self.send_json({"transfer": "basic", "objects": [self.lfs_action(x) for x in objects]})
        elif path.startswith("/lfs/verify"):
            asked = json.loads(body)
            assert len(self.store.blobs[asked["oid"]]) == asked["size"]
            self.send_json({})
        else:
            self.commit(path, body)

    def do_PUT(self) -> None:
        oid = self.path.removeprefix("/lfs/")
        self.store.requests.append("PUT /lfs")
        content = self.body()
        assert sha256(content).hexdigest() == oid
        self.store.blobs[oid] = content
        self.send(200, b"", {})

    def create(self, asked: dict[str, Any]) -> None:
        repository = f"{asked['organization']}/{asked['name']}"
        if self.store.folder(repository) is not None:
            return self.send_json({"error": "You already created this model repo"}, 409)
        self.store.add(repository, asked.get("visibility") == "private" or asked.get("private", False))
        return self.send_json({"url": f"{self.address}/{repository}"})

    def lfs_action(self, asked: dict[str, Any]) -> dict[str, Any]:
        upload = {"href": f"{self.address}/lfs/{asked['oid']}"}
        return {**asked, "actions": {"upload": upload, "verify": {"href": f"{self.address}/lfs/verify"}}}

    def commit(self, path: str, body: bytes) -> None:
        """Apply a commit: the lines of JSON say which files are added, with their contents or LFS ids, and deleted."""
        repository = path.removeprefix("/api/models/").removesuffix("/commit/main")
        folder = self.store.folder(repository)
        assert folder is not None, path
        names = []
        for entry in map(json.loads, body.splitlines()):
            value = entry["value"]
            if entry["key"] == "header":
                continue
            file = folder / value["path"]
            names.append(f"{entry['key']} {value['path']}")
            if entry["key"] == "deletedFile":
                file.unlink()
                continue
            in_lfs = entry["key"] == "lfsFile"
            content = self.store.blobs[value["oid"]] if in_lfs else base64.b64decode(value["content"])
            file.parent.mkdir(exist_ok=True)
            file.write_bytes(content)
        self.store.commits.append(names)
        self.send_json({"commitUrl": f"{self.address}/{repository}/commit/{COMMIT}", "commitOid": COMMIT})

    @property
    def address(self) -> str:
        return f"http://{self.headers['Host']}"

    def has_token(self) -> bool:
        return self.headers.get("Authorization") == f"Bearer {TOKEN}"

    def body(self) -> bytes:
        """Return the body of a request, which may come in chunks."""
        if self.headers.get("Transfer-Encoding") != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))
        parts = []
        while size := int(self.rfile.readline(), 16):
            parts.append(self.rfile.read(size))
            self.rfile.readline()
        self.rfile.readline()
        return b"".join(parts)

    def send_json(self, content: Any, status: int = 200, write: bool = True) -> bytes:
        body = self.send(status, json.dumps(content).encode(), {"Content-Type": "application/json"})
        if write:
            self.wfile.write(body)
        return body

    def send(self, status: int, body: bytes, headers: dict[str, str]) -> bytes:
        self.send_response(status)
        for header, value in {**headers, "Content-Length": str(len(body))}.items():
            self.send_header(header, value)
        self.end_headers()
        return body

    def log_message(self, *_: object) -> None: ...


def upload_mode(name: str) -> dict[str, Any]:
    mode = "lfs" if name.endswith(LFS_SUFFIXES) else "regular"
    return {"uploadMode": mode, "shouldIgnore": False, "oid": None}


@contextmanager
def hub_with(root: Path, weights: Path | None = None) -> Iterator[tuple[str, Repositories]]:
    """Serve an empty hub, or one that has the files of `weights` as `MODEL`; return its address and repositories."""
    store = Repositories(root)
    if weights is not None:
        shutil.copytree(weights, store.add(MODEL), dirs_exist_ok=True)
    with serving(type("FilledHub", (Hub,), {"store": store})) as address:
        yield address, store
