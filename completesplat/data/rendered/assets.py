"""Objects to render: the meshes of a folder, with a check of the files that they name, and procedural objects."""

import json
import os
from collections import Counter
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Any, NamedTuple
from urllib.parse import unquote

from completesplat.data.rendered.blender import Blender, run_job
from completesplat.errors import CompleteSplatError, MissingFile
from completesplat.wording import folder_names

SUFFIXES = ("glb", "gltf", "obj", "ply", "stl", "fbx", "usd", "usda", "usdc", "usdz")
MOST_OPTIONS = 30  # words before the name of a texture


class Asset(NamedTuple):
    """Object to render: the name of its sequence, a key that draws its surroundings, and its mesh or factory."""

    name: str
    key: str
    mesh: Path | None = None
    factory: str | None = None


class BrokenMesh(Exception):
    """Object that cannot be rendered, or of which no image shows anything.

    It is no CompleteSplatError, so that `atomic_folder` looks whether a full disk is the cause.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def find_meshes(folder: Path) -> list[Asset]:
    """List the mesh files below a folder by path. A sequence has its file's path without suffix as name, if unique.

    Raises:
        MissingFile: the folder does not exist or has no mesh.
    """
    if not folder.is_dir():
        raise MissingFile("no such folder", str(folder))
    paths = sorted(path for path in folder.rglob("[!.]*") if path.suffix[1:].lower() in SUFFIXES and path.is_file())
    if not paths:
        raise MissingFile(f"no meshes there ({', '.join(SUFFIXES)})", str(folder))
    relative = [path.relative_to(folder).as_posix() for path in paths]
    objects = [path.removesuffix(Path(path).suffix) for path in relative]
    count = Counter(objects)
    names = folder_names(name if count[name] == 1 else path for name, path in zip(objects, relative, strict=True))
    return [Asset(*mesh) for mesh in zip(names, relative, paths, strict=True)]


def check_named_files(mesh: Path, root: Path) -> None:
    """Refuse files that an OBJ or glTF names and Blender would open, unless they are regular files below `root`.

    Raises:
        BrokenMesh: there is such a file, or an OBJ's material file is missing.
    """
    kind = mesh.suffix.lower()
    names = _uris(mesh) if kind in (".gltf", ".glb") else []
    libraries = _lines(mesh, "mtllib") if kind == ".obj" else []
    for line in libraries:
        library = line.strip('"').replace("\\", "/")
        _check_named_file(mesh, library, root)
        if not os.path.isfile(mesh.parent / library):
            raise BrokenMesh(f"its material file {library} is missing")
        for line in _lines(mesh.parent / library, "map_", "bump", "disp", "decal", "refl", "norm"):
            words = line.split(maxsplit=MOST_OPTIONS)
            names += [" ".join(words[start:]) for start in range(len(words))]  # options may precede the name
    for name in names:
        _check_named_file(mesh, name, root)


def _check_named_file(mesh: Path, name: str, root: Path) -> None:
    named = mesh.parent / name.replace("\\", "/")
    for path in (named, mesh.parent / named.name):  # Blender looks beside the mesh, too
        if not os.path.exists(path) or path.is_dir():
            continue
        if not path.resolve().is_relative_to(root):
            raise BrokenMesh(f"{path.name} lies outside of the folder of meshes")
        if not path.is_file():
            raise BrokenMesh(f"{path.name} is no regular file")


def _lines(path: Path, *starts: str) -> list[str]:
    """Return the text after the first word of each line that starts so."""
    with path.open(errors="replace") as lines:
        selected = [line.strip() for line in lines if line.lstrip().startswith(starts)]
    texts = []
    for line in selected:
        _, *rest = line.split(maxsplit=1)
        texts.append(rest[0] if rest else "")
    return texts


def _uris(mesh: Path) -> list[str]:
    """Return the files that a glTF names, none if it cannot be read, because the renderer says what is wrong."""
    description = gltf_description(mesh)
    with suppress(TypeError, AttributeError):
        files = [*description.get("buffers", ()), *description.get("images", ())]
        return [unquote(file["uri"]) for file in files if "uri" in file]
    return []


def gltf_description(mesh: Path) -> dict[str, Any]:
    """Return the JSON of a glTF file, {} if it cannot be read."""
    with mesh.open("rb") as file:
        start = file.read(20)
        binary = start.startswith(b"glTF")
        content = file.read(int.from_bytes(start[12:16], "little") if binary else -1)
    with suppress(ValueError, RecursionError):
        description = json.loads(content if binary else start + content)
        if isinstance(description, dict):
            return description
    return {}


def procedural_objects(program: Blender, factory: str, count: int) -> list[Asset]:
    """List objects of a factory of Infinigen, or refuse one that the program's Python does not have."""
    if not factory.isidentifier():
        raise CompleteSplatError(f"factory={factory}: must be the name of a class, such as SofaFactory")
    with TemporaryDirectory() as folder:
        result = run_job(program, {"factory": factory, "views": []}, Path(folder), Event())
    if "refused" in result:
        raise CompleteSplatError(f"factory={factory}: {result['refused']}")
    return [Asset(name, name, factory=factory) for name in (f"{factory}_{index:05d}" for index in range(count))]
