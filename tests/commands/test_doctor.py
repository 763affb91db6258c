"""The doctor's findings on packages, weights, programs and rasterizers; its table, file and exit status."""

import shutil
from functools import partial
from importlib import import_module

from packaging.requirements import Requirement
from support import strict_json, write_program

from completesplat.commands import doctor
from completesplat.commands.doctor import Finding, findings_of, required_packages
from completesplat.weights import write_sums

PARTS = ["packages", "extras", "imports", "device", "weights", "tools"]


def states(findings):
    return {finding.name: finding.state for finding in findings}


def test_a_machine_that_can_complete_a_photo_gives_status_0(command, tmp_path):
    finished = command("doctor", f"out={tmp_path / 'out'}")
    assert finished.status == 0, finished.out
    assert all(f" {part} " in finished.out for part in PARTS)
    assert finished.out.splitlines()[-1] == str(tmp_path / "out")
    content = strict_json(tmp_path / "out/doctor.json")
    assert content["works"] is True
    assert {finding["part"] for finding in content["findings"]} == set(PARTS)
    assert all(finding["details"] and finding["state"] in ("yes", "no") for finding in content["findings"])


def test_something_broken_gives_status_1_and_one_line_that_names_it(command, tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "check_weights", lambda: [Finding("toy", "broken", "another checksum")])
    finished = command("doctor", f"out={tmp_path / 'out'}")
    assert finished.status == 1
    assert finished.out.splitlines()[-2] == "broken: weights, toy: another checksum"
    assert strict_json(tmp_path / "out/doctor.json")["works"] is False


def test_failing_imports_and_packages_that_are_missing_or_of_another_version_are_named():
    (finding,) = findings_of(partial(import_module, "no_such_module"))
    assert finding.state == "broken"
    assert "ModuleNotFoundError" in finding.details
    lines = ["no-such-package>=2.5", "numpy<1.0", "torch>=99; python_version < '3'", "no-viewer; extra == 'view'"]
    missing, older, others = required_packages(map(Requirement, lines))
    assert (missing.name, missing.state, older.name, older.state) == ("no-such-package", "broken", "numpy", "no")
    assert 'pip install "no-such-package>=2.5"' in missing.details
    assert "<1.0: it may or may not work" in older.details
    assert others.details.startswith("0 ")


def test_the_packages_of_extras_are_listed_and_may_be_missing():
    present, missing = doctor.check_extras(["numpy; extra == 'view'", "no-such-package; extra == 'colmap'", "torch>=2"])
    assert (present.name, present.state, missing.state) == ("view: numpy", "yes", "no")
    assert 'pip install "completesplat[colmap]"' in missing.details


def test_weights_are_broken_if_changed_or_incomplete(tmp_path):
    folder = tmp_path / "small"
    folder.mkdir()
    (folder / "config.json").write_text("{}")
    weights = folder / "model.safetensors"
    weights.write_bytes(bytes(1000))
    write_sums(folder)
    assert states(doctor.check_weights(tmp_path)) == {"small": "yes"}
    for damage in (lambda: weights.write_bytes(bytes(999) + b"\1"), weights.unlink):
        damage()
        assert states(doctor.check_weights(tmp_path)) == {"small": "broken"}


def test_missing_node_and_blender_are_no_errors_but_ffmpeg_and_space_are_needed(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("COMPLETESPLAT_BLENDER", raising=False)
    expected = {"ffmpeg": "yes", "node": "no", "blender": "no", "free disk": "yes"}
    assert states(doctor.check_tools(tmp_path)) == expected
    blender = write_program(tmp_path / "program", "echo Blender 4.5.1 LTS")
    monkeypatch.setenv("COMPLETESPLAT_BLENDER", str(blender))
    expected["blender"] = "yes"
    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: 1 / 0)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: usage._replace(free=10_000_000))
    assert states(doctor.check_tools(tmp_path)) == expected | {"ffmpeg": "broken", "free disk": "broken"}


def test_the_device_is_named_with_what_runs_on_it(monkeypatch):
    monkeypatch.setattr("completesplat.evaluation.provenance.machine", lambda: {"processor": "any"})
    monkeypatch.setattr("completesplat.rasterizers.selection.FASTER", {})
    for cuda, mps, device in ((True, False, "cuda"), (False, True, "mps"), (False, False, "cpu")):
        monkeypatch.setattr("torch.cuda.is_available", lambda cuda=cuda: cuda)
        monkeypatch.setattr("torch.backends.mps.is_available", lambda mps=mps: mps)
        details = {finding.name: finding.details for finding in doctor.check_device()}
        assert details["used device"] == f"{device}: {doctor.DEVICES[device]}"


def test_node_without_its_package_manager_converts_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor.shutil, "which", {"node": "/usr/bin/node"}.get)
    assert states(doctor.check_tools(tmp_path))["node"] == "no"
    monkeypatch.setattr(doctor.shutil, "which", {"npx": "/usr/bin/npx"}.get)
    assert states(doctor.check_tools(tmp_path))["node"] == "yes"
