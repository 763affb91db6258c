"""The sections of README as its reader follows them: the installed wheel, an empty folder, one scenario a section.

Steps, samples and sizes are small; everything else is as README prints it.
"""

import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData
from support import SMALL, strict_json, write_capture
from turntables import write_turn
from written_commands import README, ROOT, arguments_of, block_commands

pytestmark = pytest.mark.slow
QUICK = ["samples=1", "steps=2", "frames=2"]
TRAINING = [*SMALL, "callbacks.images=null"]
FRUIT = ROOT / "completesplat/weights/fruits/held_out.jpg"
FOR_EACH = {"sheet.png", "scene.json", "photo.png"}
Run = Callable[..., str]


@pytest.fixture
def folder(tmp_path: Path, installed) -> Path:
    """An empty folder, from which Python imports the installed package and not the repository's."""
    place = installed.run(tmp_path, "python", "-c", "import completesplat; print(completesplat.__file__)")
    assert place.startswith(str(installed.environment))
    return tmp_path


@pytest.fixture
def completesplat(folder: Path, installed) -> Run:
    return partial(installed.run, folder, "completesplat")


@pytest.fixture
def python(folder: Path, installed) -> Run:
    return partial(installed.run, folder, "python")


def vertices(path: Path) -> int:
    """Return the number of Gaussians in a file, all of whose values are finite."""
    vertex = PlyData.read(path)["vertex"]
    for name in vertex.data.dtype.names:
        assert np.isfinite(vertex[name]).all(), name
    return vertex.count


def section(title: str) -> str:
    """Return the text of a section of README."""
    return re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", README.read_text(), re.MULTILINE | re.DOTALL)[1]


def python_block(title: str) -> str:
    return re.search(r"```python\n(.*?)```", section(title), re.DOTALL)[1]


def replaced(text: str, *pairs: tuple[str, str]) -> str:
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    return text


def test_one_photograph_becomes_a_scene_by_the_likeliest_weights(completesplat: Run, folder: Path) -> None:
    shutil.copy(FRUIT, folder / "photo.jpg")
    printed = completesplat("predict", "photo.jpg", *QUICK, "out=SCENES")
    scene = folder / "SCENES/photo"
    assert {path.name for path in scene.iterdir()} == FOR_EACH | {"sample_00.ply", "orbit_00.mp4"}
    assert vertices(scene / "sample_00.ply") > 1000
    assert "fruits" in printed + (scene / "scene.json").read_text()
    assert np.asarray(Image.open(scene / "sheet.png")).std() > 5


def test_a_folder_of_photographs_becomes_files_and_videos_and_a_seed_gives_the_same_again(
    completesplat: Run, folder: Path
) -> None:
    (folder / "FOLDER").mkdir()
    for name in ("fruits", "rendered_couches"):
        shutil.copy(ROOT / f"completesplat/weights/{name}/held_out.jpg", folder / f"FOLDER/{name}.jpg")
    formats = "ply,html" if shutil.which("node") else "ply,splat"
    given = [f"formats=[{formats}]", "video=[orbit,swipe]", "samples=2", "seed=1", "steps=2", "frames=2"]
    for out in ("SCENES", "AGAIN"):
        completesplat("predict", "image=FOLDER", *given, f"out={out}")
    suffix = formats.partition(",")[2]
    for name in ("fruits", "rendered_couches"):
        files = {path.name for path in (folder / "SCENES" / name).iterdir()}
        for number in ("00", "01"):
            assert {f"sample_{number}.ply", f"sample_{number}.{suffix}"} <= files
            assert {f"orbit_{number}.mp4", f"swipe_{number}.mp4"} <= files
            scene = f"{name}/sample_{number}.ply"
            assert (folder / "SCENES" / scene).read_bytes() == (folder / "AGAIN" / scene).read_bytes()


def test_what_a_box_hides_has_no_influence_on_the_scene(completesplat: Run, folder: Path) -> None:
    photo = Image.open(FRUIT).convert("RGB")
    width, height = photo.size
    photo.save(folder / "a.png")
    hidden = (int(0.55 * width), int(0.25 * height), int(0.85 * width), int(0.75 * height))
    photo.paste((255, 0, 255), hidden)
    photo.save(folder / "b.png")
    scenes = []
    for name in ("a", "b"):
        box = "box=[0.5,0.2,0.9,0.8]"
        completesplat("predict", f"image={name}.png", "weights=fruits", box, *QUICK, "color_fits=2", "out=SCENES")
        scenes.append(PlyData.read(folder / f"SCENES/{name}/sample_00.ply")["vertex"].data)
    assert np.array_equal(*scenes)


def test_several_images_with_known_cameras_become_one_scene(completesplat: Run, folder: Path) -> None:
    write_capture(folder, frames=6, names=("a.jpg", "b.jpg"))
    completesplat("data", "toy", "kind=objects", "scenes=20", "frames=4", "size=32", "workers=1", "out=DATA")
    views = ["experiment=toy_views_var", "data.root=DATA", *TRAINING, "test=false", "out=RUN"]
    completesplat("fit", *views)
    given = ["image=[a.jpg,b.jpg]", "cameras=transforms.json", "weights=RUN/weights", "frames=2", "out=SCENES"]
    completesplat("predict", *given)
    (scene,) = (folder / "SCENES").glob("*/*.ply")
    assert vertices(scene) > 1000


@pytest.mark.skipif(find_spec("viser") is None, reason="the extra completesplat[view] is not installed")
def test_a_photograph_is_viewed_on_a_page_until_it_is_interrupted(folder: Path, installed) -> None:
    shutil.copy(FRUIT, folder / "photo.jpg")
    program = [installed.environment / "bin/completesplat", "view", "photo.jpg"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"PYTHONUNBUFFERED": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(program, cwd=folder, env=environment, **pipes) as process:
        printed = []
        for line in process.stdout:
            printed.append(line)
            address = re.search(r"http://127\.0\.0\.1\S*", line)
            if address:
                assert urlopen(address[0]).status == 200
                process.send_signal(signal.SIGINT)
                break
        rest, _ = process.communicate(timeout=300)
    assert process.returncode == 130, "".join(printed) + rest  # as a shell tells of Ctrl-C


def test_doctor_lists_what_this_machine_has(completesplat: Run) -> None:
    named = {line.split()[0] for line in completesplat("doctor").splitlines() if line.strip()}
    assert {"torch", "rasterizer", "extra", "node", "blender"} <= named


def test_the_lines_of_python_write_a_scene(python: Run, folder: Path) -> None:
    shutil.copy(FRUIT, folder / "photo.jpg")
    lines = replaced(python_block("Your photograph"), ("samples=4", "samples=2, steps=2, color_fits=2"))
    python("-c", lines)
    assert vertices(folder / "scene.ply") > 1000


def test_the_lines_with_lightning_train_score_and_save(completesplat: Run, python: Run, folder: Path) -> None:
    completesplat("data", "toy", "kind=objects", "scenes=20", "frames=4", "size=32", "workers=1", "out=DATA")
    small = ", ".join(f"'{setting}'" for setting in ["data.root=DATA", *TRAINING])
    trainer = "Trainer(max_steps=20)", "Trainer(max_steps=2, accelerator='cpu')"
    lines = replaced(python_block("With Lightning"), ('"data.root=DATA"', small), trainer)
    lines += "\nimport pathlib\nmodel.save_weights(pathlib.Path('W'))\nprint(scores['test/full/novel/psnr'])\n"
    assert 0 < float(python("-c", lines).splitlines()[-1]) < 100
    photo = next(folder.glob("DATA/*/*/images/*.jpg"))
    completesplat("predict", f"image={photo}", "weights=W", "video=[]", "out=SCENES")
    assert vertices(folder / f"SCENES/{photo.stem}/sample_00.ply") > 100


BRIEF = {
    "data toy": ["scenes=20", "frames=4", "size=32", "workers=1"],
    "fit experiment": TRAINING,
    "fit -m": [*TRAINING, "data.root=DATA", "ablation=full,no_skips"],
    "test": ["trainer.accelerator=cpu"],
}


def test_both_stages_train_a_sweep_runs_and_tables_have_all_results(completesplat: Run, folder: Path) -> None:
    """The commands of the section, in their order; the sweep has two of the ablations."""
    document = folder / "section.md"
    document.write_text(section("Train"))
    commands = block_commands(document)
    assert len(commands) == 6
    for command in commands:
        given = arguments_of(command)
        (brief,) = [more for start, more in BRIEF.items() if " ".join(given).startswith(start)] or [[]]
        changed = {setting.partition("=")[0] for setting in brief}
        completesplat(*(argument for argument in given if argument.partition("=")[0] not in changed), *brief)
    photo = next(folder.glob("DATA/*/*/images/*.jpg"))
    completesplat("predict", f"image={photo}", "weights=RUN2/weights", *QUICK, "out=SCENES")
    assert vertices(folder / f"SCENES/{photo.stem}/sample_00.ply") > 100
    jobs = {path.parent.name for path in folder.glob("TABLE/*/metrics.json")}
    assert len(jobs) == 4
    for kind in ("md", "csv", "tex"):
        tables = (folder / f"TABLES/tables.{kind}").read_text()
        assert "Table 2" in tables
        assert "no_skips" in tables.replace(r"\_", "_")
    assert strict_json(folder / "RUN2/metrics.json")["steps"] == 2


def test_a_capture_is_checked_and_fitted(completesplat: Run, folder: Path) -> None:
    write_capture(folder / "FOLDER", frames=12)
    completesplat("data", "import", "FOLDER")
    brief = ["trainer.max_steps=2", "trainer.accelerator=cpu", "data.image_size=12", "model.frames=2"]
    brief += ["model.fitting.initial=100", "model.fitting.most=120", "model.formats=[]", "callbacks.progress=null"]
    completesplat("fit", "experiment=capture", "data.root=FOLDER", *brief, "out=RUN")
    assert vertices(folder / "RUN/scene.ply") > 50
    assert strict_json(folder / "RUN/metrics.json")["test"]["model"]["views"] >= 3


def test_objects_on_a_turntable_become_a_data_set(completesplat: Run, folder: Path) -> None:
    for number in range(6):
        write_turn(folder / f"TURNS/object{number // 2}/turn{number % 2}", 2 * np.pi * np.arange(8) / 8)
    completesplat("data", "import", "TURNS", "cameras=turntable", "out=TURNTABLE")
    assert (folder / "TURNTABLE/sheet.png").is_file()
    completesplat("data", "check", "data=turntable", "data.root=TURNTABLE", "workers=1", "out=CHECK")
    assert (folder / "CHECK/check.json").is_file()


@pytest.mark.parametrize("name", ["toy_objects", "toy_rooms"])
def test_without_data_toys_are_made_on_first_use(completesplat: Run, folder: Path, name: str) -> None:
    few = ["data.scenes=20", "data.frames=8", "data.image_size=32", "workers=1"]
    more = ["data.height=32", "data.max_gap=4", "data.evaluation_gap=4"] if name == "toy_rooms" else []
    completesplat("data", "check", f"data={name}", *few, *more)
    assert any((folder / f"outputs/data/{name}").iterdir())


def test_a_part_of_ones_own_comes_with_a_test_that_passes(completesplat: Run, python: Run, folder: Path) -> None:
    completesplat("new", "loss", "edges")
    assert (folder / "conf/loss/edges.yaml").is_file()
    assert " passed in " in python("-m", "pytest", "-q", "test_loss_edges.py")
