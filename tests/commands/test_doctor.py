"""The doctor's lines on versions, devices, rasterizers, extras and programs."""

from importlib import import_module

import pytest
import torch
from support import strict_json, write_program

from completesplat.commands import doctor
from completesplat.commands.doctor import findings
from completesplat.installation import install_command


def test_each_thing_has_a_line_and_stands_in_the_file(command, tmp_path):
    finished = command.succeeds("doctor", f"out={tmp_path / 'out'}")
    lines = strict_json(tmp_path / "out/doctor.json")
    assert torch.__version__.startswith(lines["torch"])  # PyPI's metadata leave +cu130 out
    assert {"python", "cpu", "used device", "rasterizer tiled", "extra view", "ffmpeg", "node", "blender"} <= set(lines)
    printed = finished.out.splitlines()
    assert [line[:24].rstrip() for line in printed[:-1]] == list(lines)
    assert printed[-1] == str(tmp_path / "out")


def test_a_library_that_fails_is_a_line_and_what_came_before_it_stays():
    def libraries():
        yield "numpy", "2.0"
        import_module("no_such_module")

    lines = findings(libraries)
    assert lines == {"numpy": "2.0", "libraries": "broken: ModuleNotFoundError: No module named 'no_such_module'"}


def test_missing_packages_come_with_what_installs_them(monkeypatch):
    lines = ["numpy; extra == 'view'", "no-such-package; extra == 'colmap'", "torch>=2"]
    monkeypatch.setattr(doctor, "requires", lambda _: lines)
    monkeypatch.setattr(doctor, "LIBRARIES", ("no-such-library",))
    extras = findings(doctor.extras)
    assert extras["extra view"].startswith("numpy ")
    assert extras["extra colmap"].endswith(install_command("colmap"))
    assert findings(doctor.versions)["no-such-library"] == "missing: pip install no-such-library"


def test_programs_are_found_on_the_path_or_come_with_how_to_get_them(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("COMPLETESPLAT_BLENDER", raising=False)
    missing = findings(doctor.programs)
    assert "https://nodejs.org" in missing["node"]
    assert missing["blender"].startswith("missing, for data render: no Blender")
    write_program(tmp_path / "node", "echo v22")  # without npm, it converts nothing
    assert "https://nodejs.org" in findings(doctor.programs)["node"]
    npx = write_program(tmp_path / "npx", "echo 10")
    monkeypatch.setenv("COMPLETESPLAT_BLENDER", str(write_program(tmp_path / "program", "echo Blender 4.5.1 LTS")))
    present = findings(doctor.programs)
    assert present["node"] == str(npx)
    assert present["blender"] == f"4.5.1, {tmp_path / 'program'}"


@pytest.mark.parametrize(
    ("cuda", "mps", "device"), [(True, False, "cuda"), (False, True, "mps"), (False, False, "cpu")]
)
def test_the_device_that_is_used_is_named(cuda, mps, device, monkeypatch):
    monkeypatch.setattr("completesplat.evaluation.provenance.machine", lambda: {"processor": "any"})
    monkeypatch.setattr("torch.cuda.is_available", lambda: device == "cuda")
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: device == "mps")
    lines = findings(doctor.devices)
    assert lines["used device"] == device
    assert ("gpu" in lines) == (device != "cuda")
