"""Export by npm's `@playcanvas/splat-transform`: file formats, and a page with a viewer."""

import json
import math
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.export.ply import write_ply
from completesplat.files import atomic_path, home_path, private_folder
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points

PROGRAM = "splat-transform"
PACKAGE = "@playcanvas/splat-transform@2.7.1"
LIMIT_SECONDS = 600
MOST_LINES = 3  # of what a program says about its failure
WIDEST_WINDOW = 20 / 9
LARGEST_FOV = 120.0  # phones' windows


def convert(program: str, source: Path, target: Path, options: Sequence[str] = ()) -> None:
    """Write `target` in its suffix's format, whole or not at all.

    Raises:
        CompleteSplatError: the program fails.
    """
    with atomic_path(target) as temporary:
        _run([program, "--quiet", "--overwrite", *options, str(source), str(temporary)])
        if not temporary.is_file():
            raise CompleteSplatError(f"{PROGRAM} has not written {target.name}")


def find_splat_transform() -> str:
    """Return the program on PATH or npm's (`npx` downloads 200 MB once).

    Raises:
        CompleteSplatError: neither works.
    """
    return _find(shutil.which(PROGRAM), shutil.which("npx"))


@cache
def _find(program: str | None, npx: str | None) -> str:
    if program is None:
        if npx is None:
            raise CompleteSplatError(
                "formats sog and html need Node.js 20 or newer with npm (https://nodejs.org);"
                " ply, compressed.ply, splat, spz and glb need nothing"
            )
        program = _run([npx, "--yes", f"--package={PACKAGE}", "-c", f"command -v {PROGRAM}"]).strip()
    _run([program, "--version"])
    return program


def _run(command: Sequence[str]) -> str:
    """Run a program in a new session, so that npx's child processes can be killed with it.

    Returns:
        What the program prints.
    """
    name = Path(command[0]).name
    try:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            errors="replace", start_new_session=True, env=_npm_settings(),
        )  # fmt: skip
    except OSError as error:
        raise CompleteSplatError(f"{name} does not start: {error.strerror}") from error
    guard = _end_group_with_this_process(process.pid)
    try:
        output, complaint = process.communicate(timeout=LIMIT_SECONDS)
    except BaseException as error:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        if isinstance(error, subprocess.TimeoutExpired):
            raise CompleteSplatError(f"{name} has not finished within {LIMIT_SECONDS} seconds") from error
        raise
    finally:
        guard.kill()
        guard.communicate()
    if process.returncode != 0:
        raise CompleteSplatError(f"{name} failed with status {process.returncode}: {_reason(complaint)}")
    return output


def _end_group_with_this_process(group: int) -> "subprocess.Popen[bytes]":
    """Start a shell that kills a group of processes when this process has ended in whatever way, also by SIGKILL.

    The shell waits for a pipe to close, whose other end this process holds alone. It is to be killed when the group's
    work is done.
    """
    command = ["/bin/sh", "-c", f"read -r _; kill -9 -{group}"]
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def _reason(complaint: str) -> str:
    """Return what a program says about its failure, without npm's hints and labels and Node's stack trace."""
    lines = []
    for line in complaint.splitlines():
        label, _, text = line.partition(" ")
        kind, _, said = text.partition(" ")
        if label == "npm" and kind in ("error", "ERR!"):
            line = said
        unhelpful = line.startswith(("npm warn", "    at ", "code E", "errno ", "syscall ", "path ", "A complete log"))
        if not unhelpful and line.strip():
            lines.append(line)
    return " ".join(" ".join(lines[:MOST_LINES]).split())[:500] or "it does not say why"


def _npm_settings() -> dict[str, str]:
    """Return the environment of npx, with another cache if npm's own cannot be written, for which npx would wait."""
    environment = dict(os.environ)
    own = Path(environment.get("npm_config_cache") or home_path("~/.npm"))
    existing = next((folder for folder in (own, *own.parents) if folder.is_dir()), own)
    temporary = private_folder()
    if not os.access(existing, os.W_OK) and temporary is not None:
        environment["npm_config_cache"] = str(temporary / "npm")
    return environment


@dataclass(frozen=True)
class PageView:
    """Initial view of a page: the reference camera (unbatched), the pivot of its turn, up, and a grey background."""

    reference: Cameras
    pivot: Float[Tensor, "3"]
    up: Float[Tensor, "3"]
    background: float


def write_turning_page(path: Path, gaussians: Gaussians, view: PageView) -> None:
    """Write a page with the upright scene, seen from the front and turning until a person touches it.

    The viewer in the page turns its camera about the object if the camera lies outside of the scene's bounding box, and
    on the spot if it lies within.
    """
    turn = upright_rotation(view.up)
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.ply"
        settings = Path(folder) / "settings.json"
        write_ply(scene, gaussians.transform(turn))
        settings.write_text(json.dumps(viewer_settings(view, turn)))
        convert(find_splat_transform(), scene, path, ["--viewer-settings", str(settings)])


def upright_rotation(up: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """Return the rotation that turns `up` to -y, as the viewer expects in files, and keeps forward in front."""
    down = -torch.nn.functional.normalize(up, dim=-1)
    axes = torch.eye(3, dtype=up.dtype, device=up.device)
    # If the camera looks straight down or up, any direction may be the front.
    ahead = axes[2] if down[2].abs() < 0.99 else axes[1]
    right = torch.nn.functional.normalize(torch.linalg.cross(down, ahead), dim=-1)
    matrix = torch.eye(4, dtype=up.dtype, device=up.device)
    matrix[:3, :3] = torch.stack([right, down, torch.linalg.cross(right, down)])
    return matrix


def viewer_settings(view: PageView, turn: Float[Tensor, "4 4"]) -> dict[str, Any]:
    """Return the viewer's settings (version 2 of its schema).

    The viewer turns a file by 180 degrees about z, so that +y points up, before it places the camera. Its field of view
    belongs to the window's longer side; it is wide enough for the shorter side to hold what the photo shows.
    """
    points = torch.stack([view.reference.centers, view.pivot])
    flip = torch.tensor([-1.0, -1.0, 1.0], dtype=points.dtype, device=points.device)
    position, target = (transform_points(turn, points) * flip).tolist()
    half = max(view.reference.image_size) / 2 / view.reference.intrinsics[0, 0].item()
    fov = min(LARGEST_FOV, math.degrees(2 * math.atan(half * WIDEST_WINDOW)))
    return {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": [view.background] * 3},
        "postEffectSettings": {
            "sharpness": {"enabled": False, "amount": 0},
            "bloom": {"enabled": False, "intensity": 1, "blurLevel": 2},
            "grading": {"enabled": False, "brightness": 0, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
            "vignette": {"enabled": False, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
            "fringing": {"enabled": False, "intensity": 0.5},
        },
        "animTracks": [],
        "cameras": [{"initial": {"position": position, "target": target, "fov": fov}}],
        "annotations": [],
        "startMode": "default",
    }
