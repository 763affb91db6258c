"""The documents' commands, run as printed (and briefly), in one folder, each with what those before it left."""

import os
import re
import shutil
import signal
import subprocess
import sys

import co3d_trees
import meshes
import numpy as np
import pytest
from meshes import need_blender
from PIL import Image
from support import LIMIT, SMALL, write_capture
from turntables import write_turn
from written_commands import CARDS, DOCUMENTS, arguments_of, block_commands

LEVELS = "conditioning.channels=[8,8,16,16]"  # stage 2 has as many levels as the small stage 1
TRAINING = [*SMALL, "test=false", "callbacks.images=null"]
TOYS = [*TRAINING, "data.scenes=20"]
TURNS = [*TRAINING, "data.targets=2", "data.camera_jitter=null"]
CAPTURE = [
    "trainer.max_steps=2",
    "trainer.accelerator=cpu",
    "data.image_size=12",
    "model.formats=[]",
    "model.frames=2",
    "model.fitting.initial=100",
    "model.fitting.most=120",
]
STUDY = ["scenes=1", "samples=2"]
# Appended to commands that begin so, to make them short; everything else is as printed. The longest beginning counts.
BRIEF = {
    "data toy": ["scenes=20", "frames=4", "size=32", "workers=1"],
    "data prepare data=toy_objects": ["data.image_size=32", "workers=1"],
    "data render": ["views=6", "size=32", "samples=1"],
    "data prepare data=rendered": ["data.image_size=32", "workers=1"],
    "data check data=turntable": ["workers=1"],
    "plan experiment=toy_var": ["data.targets=3"],
    "plan experiment=rendered_var": ["data.image_size=32"],
    "fit": TOYS,
    "fit -m hparams_search=optuna": [*TOYS, "hydra.sweeper.n_trials=1"],
    "fit experiment=toy_minis_diffusion": [*TOYS, LEVELS],
    "fit experiment=toy_views_diffusion": [*TOYS, LEVELS],
    "fit experiment=capture": CAPTURE,
    "fit experiment=rendered_var": [*TRAINING, "data.batch_size=1", "data.targets=4"],
    "fit experiment=rendered_diffusion": [*TRAINING, "data.batch_size=2", LEVELS],
    "fit experiment=turntable_var": TURNS,
    "fit experiment=turntable_diffusion": [*TURNS, LEVELS],
    "predict": ["frames=2", "steps=2"],
    "test": ["trainer.accelerator=cpu"],
    "report calibration": STUDY,
    "report controls": STUDY,
    "report depth": STUDY,
    "report ladder": [*STUDY, "fits=1"],
}
NEED_BLENDER = ("RENDERS", "ASSET", "RUN40", "RUN41")
# What they need cannot be made here: Infinigen (`test_rendering` has such commands), CO3D, eight GPUs, VGG16
# (`test_sweeps` has these two sweeps with a random one), Splatter Image's published weights (`test_published` has
# made-up ones), images that Python lines of a README write (`test_scene_files` runs them), photos that COLMAP can pose
# (`test_importing` draws them), published captures, random solids, scanned things, the mixture of things for a
# GPU (MIX, STORE), weights that a GPU made.
NEEDS_MORE = ["IMAGES", "SOFA", "COUCH", "SPLATS", "PART1", "TABLE_OF_A", "PHOTOS", "FOX", "MOUSE", "CUP", "FRUITS"]
NEEDS_MORE += ["FRUIT_TURNS", "ETH80_FRUIT", "RUN7", "evaluation=co3d", "trainer.devices=8", "splatter_image:"]
NEEDS_MORE += ["model_hydrants.pth", "SHAPES", "MIX", "STORE", "RUN90", "TOYS_TEST", "=CAN", "=TRACTOR"]
NEEDS_MORE += ["SCANS", "gpu_weights", "RESULT", "push=me/", "weights=me/"]  # a hub: `test_push`
TAKES_MINUTES = ["completesplat bench"]


def runnable() -> list[str]:
    """The commands of the documents' code blocks, each once; those of the weights' cards have made the weights."""
    commands = [command for path in DOCUMENTS if path not in CARDS for command in block_commands(path)]
    skipped = NEEDS_MORE + TAKES_MINUTES
    return in_order([one for one in dict.fromkeys(commands) if not any(word in one for word in skipped)])


def in_order(commands: list[str]) -> list[str]:
    """Each after those that write the folders it names; what reads all runs comes last."""
    waiting = sorted(commands, key=lambda command: "runs=" in command)
    ordered: list[str] = []
    while waiting:
        unwritten = {written_by(command) for command in waiting}
        ready = next(one for one in waiting if not (named_in(one) - {written_by(one)}) & unwritten)
        waiting.remove(ready)
        ordered.append(ready)
    return ordered


def written_by(command: str) -> str | None:
    return next((word.removeprefix("out=") for word in arguments_of(command) if word.startswith("out=")), None)


def named_in(command: str) -> set[str]:
    """Its words in capitals: folders, as the documents write them."""
    return set(re.findall(r"\b[A-Z][A-Z0-9]+\b", command))


def test_each_folder_that_a_command_needs_is_made_here():
    """A new command of a document that needs other data belongs into `NEEDS_MORE`."""
    commands = runnable()
    written = {written_by(command) for command in commands}
    assert set().union(*map(named_in, commands)) - written == {"ROOT", "FOLDER", "TURNS", "MESHES"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Photographs, a folder of three with cameras, a capture, CO3D's hydrants, six turns, three meshes."""
    place = tmp_path_factory.mktemp("readme")
    rng = np.random.default_rng(0)
    for name in ("photo", "front", "side", "back"):
        Image.fromarray(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)).save(place / f"{name}.jpg")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(co3d_trees, "CATEGORY", "hydrant")
        names = [f"{index}_2_3" for index in range(4)]
        splits = {"train": names[:2], "val": names[2:3], "test": names[3:]}
        co3d_trees.write_tree(place / "ROOT", dict.fromkeys(names, 6), splits)
    write_capture(place, frames=6, names=("a.jpg", "b.jpg"))
    write_capture(place / "FOLDER", frames=6, names=("photo.jpg", "other.png"))
    for index in range(6):
        write_turn(place / f"TURNS/object{index // 2}/turn{index % 2}", 2 * np.pi * np.arange(8) / 8)
    for name in "abc":
        meshes.write_cube(place / f"MESHES/{name}.obj")
    return place


def run(command: str, folder) -> subprocess.CompletedProcess[str]:
    arguments = arguments_of(command)
    starts = [start for start in BRIEF if " ".join(arguments).startswith(start)]
    brief = BRIEF[max(starts, key=len)] if starts else []
    program = [sys.executable, "-m", "completesplat", *arguments, *brief]
    if arguments[0] == "view" and not any("export=" in argument for argument in arguments):
        return _served(program, folder)
    return subprocess.run(program, cwd=folder, capture_output=True, text=True, timeout=LIMIT)


def _served(program: list[str], folder) -> subprocess.CompletedProcess[str]:
    """A page is served until it is stopped: until its address is printed."""
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(program, cwd=folder, env=os.environ | {"PYTHONUNBUFFERED": "1"}, **streams)
    message = []
    for line in process.stdout:
        message.append(line)
        if "http://127.0.0.1" in line:
            process.send_signal(signal.SIGINT)
            process.wait(timeout=LIMIT)
            return subprocess.CompletedProcess(program, 0)
    return subprocess.CompletedProcess(program, process.wait(), stderr="".join(message))


@pytest.mark.slow
@pytest.mark.parametrize("command", runnable())
def test_the_command_does_what_it_is_printed_for(command, folder):
    if "html" in command and shutil.which("node") is None:
        pytest.skip("no Node.js here, which html needs")
    if "=optuna" in command:
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="hydra-optuna-sweeper is not installed")
    if any(word in command for word in NEED_BLENDER):
        need_blender()
    finished = run(command, folder)
    assert finished.returncode == 0, finished.stderr[-3000:]
