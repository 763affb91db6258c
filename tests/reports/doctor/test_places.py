"""What the doctor says of weights, data, programs and disks."""

import shutil

import pytest

from completesplat.commands import conf_folder, doctor, doctor_checks
from completesplat.weights import write_sums


@pytest.fixture
def box(tmp_path, monkeypatch):
    """A folder of weights as it comes with the package, and caches with nothing in them."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    folder = tmp_path / "box/small"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text("{}")
    (folder / "model.safetensors").write_bytes(bytes(1000))
    write_sums(folder)
    return folder.parent


def states(findings):
    return {finding.name: finding.state for finding in findings}


def test_weights_with_the_package_are_found(box):
    assert states(doctor_checks.check_weights(box))["small"] == "yes"


def test_a_package_without_weights_is_no_error(box, tmp_path):
    findings = doctor_checks.check_weights(tmp_path / "nowhere")
    assert {finding.state for finding in findings} <= {"yes", "no"}
    assert "weights=FOLDER" in findings[0].said


def test_changed_or_incomplete_weights_are_broken(box):
    (box / "small/model.safetensors").write_bytes(bytes(999) + b"\1")
    assert states(doctor_checks.check_weights(box))["small"] == "broken"
    (box / "small/model.safetensors").unlink()
    assert states(doctor_checks.check_weights(box))["small"] == "broken"


def test_published_weights_are_found_in_the_cache_and_otherwise_named_with_their_address(box, tmp_path):
    name = doctor_checks.PUBLISHED[0][0]
    (before,) = (finding for finding in doctor_checks.check_weights(box) if finding.name == name)
    assert before.state == "no"
    assert "https://" in before.said
    cached = tmp_path / "torch/hub/checkpoints" / doctor_checks.PUBLISHED[0][1].rpartition("/")[2]
    cached.parent.mkdir(parents=True)
    cached.write_bytes(b"x")
    (after,) = (finding for finding in doctor_checks.check_weights(box) if finding.name == name)
    assert after.state == "yes"
    assert str(cached) in after.said


def test_data_are_looked_for_where_the_configuration_says(tmp_path):
    conf = conf_folder() / "data"
    before = doctor.check_data(conf, tmp_path)
    assert {finding.state for finding in before} == {"no"}
    assert len(before) >= 4
    (tmp_path / "outputs/data/toy_rooms/train").mkdir(parents=True)
    after = states(doctor.check_data(conf, tmp_path))
    assert [name for name, state in after.items() if state == "yes"] == ["toy_rooms"]


def test_missing_programs_are_no_error_but_ffmpeg_is_needed(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert states(doctor.check_tools(tmp_path)) == {
        "ffmpeg": "yes",
        "node": "no",
        "splat-transform": "no",
        "free disk": "yes",
    }
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "nothing"))
    assert states(doctor.check_tools(tmp_path))["ffmpeg"] == "broken"


def test_a_full_disk_is_broken(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: usage._replace(free=10_000_000))
    assert states(doctor.check_tools(tmp_path))["free disk"] == "broken"
