"""Predictions by several processes that are killed: nothing is left behind, and what is finished is not repeated."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image
from support import waited_for

pytestmark = pytest.mark.processes
COUNT = 16


def left(mark: str) -> list[int]:
    """Processes that run with this text in their environment, but for those that have ended."""
    numbers = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            if mark.encode() in path.read_bytes():
                numbers.append(int(path.parent.name))
        except OSError:  # of another user, or gone
            continue
    return numbers


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_two_killed_processes_leave_no_process_and_what_is_finished(command, tmp_path, number):
    (tmp_path / "x").mkdir()
    for index in range(COUNT):
        Image.new("RGB", (32, 32), (4 * index, 90, 60)).save(tmp_path / f"x/{index:02}.png")
    given = [f"image={tmp_path / 'x'}", "weights=toy_objects", f"out={tmp_path / 'out'}", "samples=1", "frames=8"]
    given += ["steps=1", "rasterizer=tiled", "color_fits=0"]
    program = [sys.executable, "-P", "-m", "completesplat", "predict", *given, "devices=2"]
    environment = os.environ | {"MARK": str(tmp_path)}
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(program, env=environment, stdout=log, stderr=log, start_new_session=True)
    finished = tmp_path / "out"
    assert waited_for(lambda: len(list(finished.glob("*/scene.json"))) > 1 or process.poll() is not None)
    (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
    assert process.wait() == (130 if number == signal.SIGINT else -number)
    assert waited_for(lambda: not left(f"MARK={tmp_path}"), 10), left(f"MARK={tmp_path}")
    text = (tmp_path / "log").read_text()
    assert (text.count("Traceback"), text.count("weights: ")) == (0, 1), text
    if number == signal.SIGINT:
        assert text.splitlines()[-1].startswith("ended by SIGINT; start again with: completesplat predict "), text
    before = {path.parent.name: path.stat().st_mtime_ns for path in finished.glob("*/scene.json")}
    assert 1 < len(before) < COUNT
    again = command.succeeds("predict", *given)
    assert f"{len(before)} of {COUNT} images: predicted before by the same settings" in again.out
    assert len(re.findall(r"^\d+/\d+ ", again.out, re.M)) == COUNT - len(before)
    assert {name: (finished / name / "scene.json").stat().st_mtime_ns for name in before} == before
    assert len(list(finished.glob("*/scene.json"))) == COUNT
