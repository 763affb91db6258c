"""The README's commands, run as printed (and briefly), in one folder, each with what those before it left."""

import json
import os
import shutil
import signal
import subprocess
import sys

import co3d_trees
import numpy as np
import pytest
from PIL import Image
from support import SMALL
from written_commands import arguments_of, readme_commands

# Later ones need what earlier ones make.
ORDER = [
    "data toy",
    "fit experiment",
    "data prepare data=toy_objects",
    "data latents",
    "fit",
    "predict",
    "data",
    "test",
    "view",
    "report",
    "bench",
    "doctor",
]
# Appended to make them short; everything else is as printed.
BRIEF = {
    "data toy": ["scenes=20", "frames=4", "size=32", "workers=1"],
    "data prepare data=toy_objects": ["data.image_size=32", "workers=1"],
    "fit": [*SMALL, "test=false", "data.scenes=20", "callbacks.pictures=null"],
    "predict": ["frames=2", "steps=2"],
    "test": ["trainer.accelerator=cpu"],
    "report samplers": ["scenes=1", "samples=2"],
}
# What they need cannot be made here: CO3D, eight GPUs, VGG16 (`test_sweeps` has these two sweeps with a random one).
NEEDS_MORE = ("evaluation=co3d", "trainer.devices=8", "PART1")
TAKES_MINUTES = ("completesplat bench",)


def runnable() -> list[str]:
    commands = [one for one in readme_commands() if not any(word in one for word in (*NEEDS_MORE, *TAKES_MINUTES))]

    def rank(command: str) -> int:
        words = command.removeprefix("completesplat ")
        return next(i for i, start in enumerate(ORDER) if words.startswith(start))

    return sorted(commands, key=rank)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A photograph, a folder of them, a mask's picture, a capture, and CO3D's hydrants (in its layout)."""
    place = tmp_path_factory.mktemp("readme")
    rng = np.random.default_rng(0)
    (place / "FOLDER").mkdir()
    for name in ("photo.jpg", "FOLDER/photo.jpg", "FOLDER/other.png"):
        Image.fromarray(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)).save(place / name)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(co3d_trees, "CATEGORY", "hydrant")
        names = [f"{index}_2_3" for index in range(4)]
        splits = {"train": names[:2], "val": names[2:3], "test": names[3:]}
        co3d_trees.write_tree(place / "ROOT", dict.fromkeys(names, 6), splits)
    (place / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": _capture(place)}))
    return place


def _capture(place):
    """Frames around the origin, +y up, looking inwards, each with its picture."""
    frames = []
    for index, angle in enumerate(np.linspace(0.3, 4.0, 6)):
        back = np.array([np.sin(angle), 0.2, np.cos(angle)]) / np.hypot(1, 0.2)
        right = np.cross([0.0, 1.0, 0.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, 4 * back], axis=1)
        shutil.copy(place / "photo.jpg", place / f"frame{index}.jpg")
        frames.append({"file_path": f"frame{index}.jpg", "transform_matrix": pose.tolist()})
    return frames


def run(command: str, folder) -> subprocess.CompletedProcess[str]:
    arguments = arguments_of(command)
    brief = next((extra for start, extra in BRIEF.items() if " ".join(arguments).startswith(start)), [])
    program = [sys.executable, "-m", "completesplat", *arguments, *brief]
    if arguments[0] == "view" and not any("export=" in argument for argument in arguments):
        return _served(program, folder)
    return subprocess.run(program, cwd=folder, capture_output=True, text=True, timeout=600)


def _served(program: list[str], folder) -> subprocess.CompletedProcess[str]:
    """A page is served until it is stopped: until its address is printed."""
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        program, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    )
    assert process.stdout is not None
    said = ""
    for line in process.stdout:
        said += line
        if "http://127.0.0.1" in line:
            process.send_signal(signal.SIGINT)
            process.wait(timeout=60)
            return subprocess.CompletedProcess(program, 0, said, "")
    return subprocess.CompletedProcess(program, process.wait(), said, said)


@pytest.mark.slow
@pytest.mark.parametrize("command", runnable())
def test_the_command_does_what_it_is_printed_for(command, folder):
    if "html" in command and shutil.which("node") is None:
        pytest.skip("no Node.js here, which html needs")
    finished = run(command, folder)
    assert finished.returncode == 0, finished.stderr[-3000:]


def test_the_order_knows_every_command():
    assert len(runnable()) > 20
