"""Several jobs that render into one folder: each object once, and the files of one job, whichever ends last."""

import json
import re
import subprocess
import sys
from collections import Counter

import meshes
import numpy as np
import pytest
from packed_sequences import contents
from PIL import Image
from support import strict_json, waited_for, write_program

QUICK = ["views=2", "size=8", "samples=1", "workers=1", "renderer=blender"]
# Stands for Blender: copies files of two views; refuses `c_broken`; lists the meshes that it got.
STAND_IN = """
if [ "$1" = --version ]; then echo Blender 4.2.0; exit; fi
for job; do :; done
files=$(dirname "$0")/files
name=$(grep -o '[a-z_]*\\.obj' "$job" | head -1)
echo "$name" >> "$(dirname "$0")/started"
if [ "$name" = c_broken.obj ]; then echo '{"refused": "it has no faces"}' > "$(dirname "$job")/result.json"; exit; fi
cp "$files"/* "$(dirname "$job")"
"""
TOTALS = [(0, 0), (2, 2), (4, 2)]  # after each of three jobs, of which the first has the broken mesh


@pytest.fixture
def render(command, tmp_path):
    """Render five meshes, of which one is broken, by a stand-in for Blender; return the arguments of the command."""
    (tmp_path / "meshes").mkdir()
    for name in ("a", "b", "c_broken", "d", "e"):
        meshes.write_triangle(tmp_path / f"meshes/{name}.obj")
    (tmp_path / "files").mkdir()
    for view in range(2):
        Image.new("RGB", (8, 8), (90, 60, 30)).save(tmp_path / f"files/000{view}.png")
        np.save(tmp_path / f"files/000{view}.npy", np.ones((8, 8, 3), np.float32))
    result = {"center": [0, 0, 0], "scale": 1.0, "ground": -1.0, "left_out": 0}
    (tmp_path / "files/result.json").write_text(json.dumps(result))
    program = write_program(tmp_path / "blender", STAND_IN)
    return lambda out, *more: [
        *("data", "render", f"meshes={tmp_path / 'meshes'}", f"blender={program}", *QUICK),
        *(f"out={tmp_path / out}", *more),
    ]


def test_a_sweep_of_shards_leaves_the_files_of_one_job_in_whatever_order_they_end(command, render, tmp_path):
    assert "4 objects in rendered/, 4 of them new, 1 left out" in command.succeeds(*render("whole")).out
    lines = command.succeeds(*render("out", "-m", "shard=2,0,1", "shards=3")).out
    assert all(f"{count} objects in rendered/, {new} of them new, 1 left out" in lines for count, new in TOTALS)
    assert contents(tmp_path / "out/rendered") == contents(tmp_path / "whole/rendered")
    assert strict_json(tmp_path / "out/shard-2/run.json")["overrides"][-2:] == ["shard=2", "shards=3"]
    assert {path.name for path in (tmp_path / "out").glob("*/")} == {"rendered", "shard-0", "shard-1", "shard-2"}
    assert set(strict_json(tmp_path / "whole/rendered/broken.json")) == {"c_broken"}
    times = Counter((tmp_path / "started").read_text().split())
    assert times == {"a.obj": 2, "b.obj": 2, "c_broken.obj": 2, "d.obj": 2, "e.obj": 2}
    assert "shard=3: must lie between 0 and 2" in command.refuses(*render("out", "shard=3", "shards=3"))


def test_a_shard_whose_objects_are_all_broken_fails_only_if_no_other_is_left(command, render, tmp_path):
    for name in ("a", "b", "e"):
        (tmp_path / f"meshes/{name}.obj").unlink()
    command.succeeds(*render("out", "shard=0", "shards=2"))  # c_broken
    command.succeeds(*render("out", "shard=4", "shards=5"))  # nothing is left for it
    (tmp_path / "meshes/d.obj").unlink()
    assert "none of 1 objects can be rendered: it has no faces" in command.refuses(*render("none"))


@pytest.mark.processes
def test_jobs_at_the_same_time_share_a_folder_unless_one_is_for_all_objects(command, render, tmp_path):
    command.succeeds(*render("whole"))
    wait = tmp_path / "wait"
    write_program(tmp_path / "blender", STAND_IN.replace("cp ", f"while [ -e {wait} ]; do sleep 0.1; done\ncp "))
    wait.touch()
    (tmp_path / "started").unlink()
    started = [sys.executable, "-P", "-m", "completesplat"]
    shards = [subprocess.Popen([*started, *render("out", f"shard={shard}", "shards=2")]) for shard in (0, 1)]
    begun = tmp_path / "started"
    assert waited_for(lambda: begun.is_file() and len(begun.read_text().split()) == 2, 60)
    refusal = command.refuses(*render("out"))
    assert re.search(r"out/shard-\d: process \d+ on .* is at work in it", refusal)
    assert "is at work in it" in command.refuses(*render("out", "shard=0", "shards=2"))
    wait.unlink()
    assert [process.wait() for process in shards] == [0, 0]
    assert contents(tmp_path / "out/rendered") == contents(tmp_path / "whole/rendered")
    assert sorted(begun.read_text().split()) == ["a.obj", "b.obj", "c_broken.obj", "d.obj", "e.obj"]
