"""Finding Blender, and programs that are none, are too old, crash or fail: small scripts stand for them."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import meshes
import pytest
from support import refused, waited_for, write_program

from completesplat import files
from completesplat.data.rendered import blender
from completesplat.data.rendered.blender import VARIABLE, find_blender
from completesplat.data.rendered.rendering import render
from completesplat.errors import DataError, DiskError

QUICK = ["views=2", "size=8", "workers=1", "renderer=blender"]


@pytest.fixture(autouse=True)
def bare(tmp_path, monkeypatch):
    """Leave no Blender to be found."""
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(blender, "find_spec", lambda name: None)
    monkeypatch.setattr(blender.shutil, "which", lambda name: None)


@pytest.fixture
def program(tmp_path):
    """Write a shell script."""
    return lambda text, name="blender": str(write_program(tmp_path / name, text))


VERSION = 'if [ "$1" = --version ]; then echo "Color management: a warning"; echo "Blender {}"; exit; fi\n'


@pytest.fixture
def line(tmp_path):
    """Render one cube and return the line that refuses it."""
    meshes.write_cube(tmp_path / "meshes/cube.obj")
    return lambda *given: refused("data", "data_task=render", f"meshes={tmp_path / 'meshes'}", *QUICK, *given)


@pytest.fixture
def into(line, tmp_path):
    """Render the cube into a folder and return the reason for which that fails."""

    def run(out, program, error=DataError, **settings):
        given = meshes.SETTINGS | {"views": 2, "size": 8, "samples": 1, "blender": program} | settings
        with pytest.raises(error) as caught:
            render(str(tmp_path / "meshes"), out=out, **given)
        return str(caught.value)

    return run


def test_without_blender_two_commands_say_how_to_get_one(line):
    message = line()
    assert message.startswith("no Blender: give blender=PATH, or get one by `python3.11 -m venv BLENDER` and `")
    assert message.count("`") == 4


def test_the_given_program_goes_before_the_variable_and_that_before_the_path(program, monkeypatch):
    given, variable, path = (program(VERSION.format(f"4.{n}.1 LTS"), str(n)) for n in (2, 3, 4))
    monkeypatch.setattr(blender.shutil, "which", lambda name: path)
    assert find_blender().version == "4.4.1"
    monkeypatch.setenv(VARIABLE, variable)
    assert find_blender().version == "4.3.1"
    found = find_blender(given)
    assert (found.version, found.command[0]) == ("4.2.1", given)
    assert found.command[-1] == "--python"


def test_programs_that_are_no_blender_or_too_old_are_refused(line, program, tmp_path):
    for text, message in {
        "echo hello": "neither Blender nor a Python with bpy (hello)",
        "exit 3": "(it prints nothing)",
        **{VERSION.format(old): f"Blender {old} is older than 4.2; get one by " for old in ("4.1.1", "3.6.12", "2.79")},
    }.items():
        assert message in line(f"blender={program(text)}")
    assert f"{tmp_path / 'gone'}: cannot be run: No such file or directory" in line(f"blender={tmp_path / 'gone'}")
    assert f"{tmp_path}: cannot be run: Permission denied" in line(f"blender={tmp_path}")
    # The Python of these tests is one without bpy.
    message = line(f"blender={sys.executable}")
    assert "neither Blender nor a Python with bpy (ModuleNotFoundError: No module named 'bpy')" in message


def test_a_blender_that_crashes_fails_or_hangs_leaves_meshes_out(into, program, tmp_path):
    for text, reason in {
        "kill -SEGV $$": "Blender ended by signal 11 (a crash, or more than 4.0 GB of memory)",
        "echo; echo Error: no license; exit 1": "Blender failed: Error: no license",
        "exit 0": "Blender failed: no message",
        "exec sleep 60": "took longer than max_minutes=0.01",
    }.items():
        limit = {"max_minutes": 0.01} if "sleep" in text else {}
        message = into(tmp_path / "data", program(VERSION.format("4.2.0") + text), **limit)
        assert message == f"{tmp_path / 'data/rendered'}: none of 1 objects can be rendered: {reason}"
        assert [path.name for path in (tmp_path / "data/rendered").glob("*/")] == []


# Runs the script for Blender with modules that stand for Blender's; its first step writes a file and never ends.
ENDLESS = """
import runpy, sys, time
from pathlib import Path
from unittest.mock import MagicMock
for name in ("bmesh", "bpy", "mathutils"):
    sys.modules[name] = MagicMock()
def begin(**_):
    Path({begun!r}).write_text(str(__import__("os").getpid()))
    time.sleep(1000)
sys.modules["bpy"].ops.wm.read_factory_settings = begin
sys.argv = sys.argv[sys.argv.index("--python") + 1 :]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.processes
def test_blender_ends_with_the_process_that_started_it_even_in_the_middle_of_a_view(line, program, tmp_path):
    (tmp_path / "stand_in.py").write_text(ENDLESS.format(begun=str(begun := tmp_path / "begun")))
    found = program(VERSION.format("4.2.0") + f'exec {sys.executable} {tmp_path / "stand_in.py"} "$@"')
    command = ["data", "render", f"meshes={tmp_path / 'meshes'}", f"out={tmp_path / 'out'}", f"blender={found}", *QUICK]
    process = subprocess.Popen([sys.executable, "-P", "-m", "completesplat", *command])
    try:
        assert waited_for(lambda: process.poll() is not None or (begun.is_file() and begun.read_text()))
    finally:
        process.kill()
        process.wait()
    child = Path(f"/proc/{begun.read_text()}")
    ended = waited_for(lambda: not child.exists() or child.joinpath("stat").read_text().split()[2] == "Z", seconds=30)
    if not ended:
        os.kill(int(child.name), signal.SIGKILL)
    assert ended


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits the memory of another process")
def test_a_mesh_gets_memory_by_the_size_of_its_file(into, program, tmp_path):
    limited = program(VERSION.format("4.2.0") + "sleep 1; echo $(ulimit -d); exit 1")
    size = (tmp_path / "meshes/cube.obj").stat().st_size
    kilobytes = (4 * 10**9 + 20 * size) // 1024
    assert into(tmp_path / "data", limited).endswith(f"Blender failed: {kilobytes}")


def test_a_full_disk_is_no_reason_to_leave_meshes_out(into, program, tmp_path, monkeypatch):
    failing = program(VERSION.format("4.2.0") + "echo cannot write; exit 1")
    monkeypatch.setattr(files, "_test_write_error", lambda path: OSError(errno.ENOSPC, "No space left on device"))
    assert "No space left on device" in into(tmp_path / "data", failing, DiskError)
    assert not (tmp_path / "data/rendered/broken.json").exists()


def test_bad_settings_are_refused_before_anything_is_written(line, program, tmp_path):
    found = f"blender={program(VERSION.format('4.2.0'))}"
    (tmp_path / "empty").mkdir()
    (tmp_path / "cameras.json").write_text('{"frames": []}')
    assert line("meshes=null").startswith("give either meshes=FOLDER or factory=NAME")
    message = line("meshes=null", "factory=a.b", found)
    assert message == "factory=a.b: must be the name of a class, such as SofaFactory"
    for given, message in {
        f"meshes={tmp_path / 'empty'}": f"{tmp_path / 'empty'}: no meshes there (glb, gltf, obj, ply, stl, fbx, usd",
        f"meshes={tmp_path / 'gone'}": f"{tmp_path / 'gone'}: no such folder",
        "light=lamp": "light=lamp: neither random nor a file (.hdr, .exr)",
        "light=gone.hdr": "gone.hdr: no such file",
        "floor=gone": "gone: no textures there (.jpg, ",
        f"wall={tmp_path / 'empty'}": f"{tmp_path / 'empty'}: no textures there",
        "cameras=circle": "cameras=circle: choose turn, hemisphere, fixed or the path of a transforms.json",
        f"cameras={tmp_path / 'cameras.json'}": f"{tmp_path / 'cameras.json'}: 0 frames; at least 2 are rendered",
        "factory=SofaFactory": "give either meshes=FOLDER or factory=NAME",
        "hidden=front": "hidden=front: ",
        "views=1": "views=1: must lie between 2 and 1000",
        "fov=[5]": "fov=[5]: must have 2 entries",
        "fov=[0,50]": "fov=[0, 50]: must lie between 5 and 120",
    }.items():
        assert message in line(found, given), given


def test_a_folder_of_other_settings_or_among_the_meshes_is_refused(into, program, tmp_path):
    found, out = program(VERSION.format("4.2.0")), tmp_path / "data"
    assert "none of 1 objects" in into(out, found)
    assert into(out, found, seed=1).startswith(f"{out / 'rendered'} already holds something else")
    within = tmp_path / "meshes/data"
    assert into(within, found).startswith(f"out={within}: lies in meshes={tmp_path / 'meshes'}, and its points would")
