"""The doctor: what it says of packages, places, weights and rasterizers; one table, one file, one exit status."""

import shutil
from dataclasses import replace
from functools import partial
from importlib import import_module

import pytest
import torch
from packaging.requirements import Requirement
from support import strict_json

from completesplat.commands import conf_folder, doctor, doctor_checks
from completesplat.commands.doctor import applies, extra_packages, findings_of, needed_packages
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.selection import FASTER, failure
from completesplat.weights import write_sums

PARTS = ["packages", "extras", "imports", "device", "rasterizers", "weights", "data", "tools"]


def test_a_machine_that_can_complete_a_photograph_gives_status_0(command, tmp_path):
    finished = command("doctor", f"out={tmp_path / 'out'}")
    assert finished.status == 0, finished.out
    assert all(f" {part} " in finished.out for part in PARTS)
    assert finished.out.splitlines()[-1] == str(tmp_path / "out")
    content = strict_json(tmp_path / "out/doctor.json")
    assert content["works"] is True
    assert {finding["part"] for finding in content["findings"]} == set(PARTS)
    assert all(finding["said"] and finding["state"] in ("yes", "no") for finding in content["findings"])


def test_something_broken_gives_status_1_and_one_line_that_names_it(command, tmp_path, monkeypatch):
    monkeypatch.setattr(doctor_checks, "wrong", lambda rasterizer: "it is upside down")
    finished = command("doctor", f"out={tmp_path / 'out'}")
    assert finished.status == 1
    assert finished.out.splitlines()[-2] == "broken: rasterizers, reference: it is upside down"
    assert strict_json(tmp_path / "out/doctor.json")["works"] is False


def test_what_cannot_be_imported_and_packages_that_are_missing_or_of_another_version_are_named():
    (finding,) = findings_of(partial(import_module, "no_such_module"))
    assert finding.state == "broken"
    assert "ModuleNotFoundError" in finding.said
    missing, older = "no-such-package-anywhere>=2.5", "numpy<1.0"
    first, second, others = needed_packages([Requirement(missing), Requirement(older)])
    assert (first.name, first.state, second.name, second.state) == (missing[:-5], "broken", "numpy", "no")
    assert f'pip install "{missing}"' in first.said
    assert "<1.0: it may or may not work" in second.said
    assert others.said.startswith("0 ")


def test_packages_of_an_extra_that_are_missing_are_no_error():
    requirements = [Requirement("no-such-package-anywhere; extra == 'view'"), Requirement("numpy>=2.0")]
    (finding,) = extra_packages("view", "shows scenes", requirements)
    assert (finding.state, finding.said) == ("no", 'shows scenes: pip install "completesplat[view]"')
    assert list(extra_packages("cuda", "draws", requirements)) == []
    assert not applies(Requirement("torch; python_version < '3'"), "")


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


def test_weights_with_the_package_are_found_broken_if_changed_or_incomplete_and_may_be_absent(box, tmp_path):
    weights = box / "small/model.safetensors"
    assert states(doctor_checks.check_weights(box))["small"] == "yes"
    weights.write_bytes(bytes(999) + b"\1")
    assert states(doctor_checks.check_weights(box))["small"] == "broken"
    weights.unlink()
    assert states(doctor_checks.check_weights(box))["small"] == "broken"
    findings = list(doctor_checks.check_weights(tmp_path / "nowhere"))
    assert {finding.state for finding in findings} <= {"yes", "no"}
    assert "weights=FOLDER" in findings[0].said


def test_published_weights_are_found_in_the_cache_and_otherwise_named_with_their_address(box, tmp_path):
    name, url = doctor_checks.PUBLISHED[0]
    cached = tmp_path / "torch/hub/checkpoints" / url.rpartition("/")[2]
    for state, said in (("no", url), ("yes", str(cached))):
        (finding,) = (finding for finding in doctor_checks.check_weights(box) if finding.name == name)
        assert finding.state == state
        assert said in finding.said
        cached.parent.mkdir(parents=True, exist_ok=True)
        cached.write_bytes(b"x")


def test_data_are_looked_for_where_the_configuration_says(tmp_path):
    (tmp_path / "outputs/data/toy_rooms/train").mkdir(parents=True)
    found = states(doctor.check_data(conf_folder() / "data", tmp_path))
    assert len(found) >= 4
    assert {name for name, state in found.items() if state != "no"} == {"toy_rooms"}
    assert found["toy_rooms"] == "yes"


def test_missing_programs_are_no_error_but_ffmpeg_and_space_are_needed(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    found = {"ffmpeg": "yes", "node": "no", "splat-transform": "no", "free disk": "yes"}
    assert states(doctor.check_tools(tmp_path)) == found
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "nothing"))
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: usage._replace(free=10_000_000))
    assert states(doctor.check_tools(tmp_path)) == found | {"ffmpeg": "broken", "free disk": "broken"}


class Changed:
    """The reference, with something done to its colours."""

    def __init__(self, change):
        self.change = change

    def __call__(self, gaussians, cameras):
        drawn = ReferenceRasterizer()(gaussians, cameras)
        return replace(drawn, color=self.change(drawn.color))


WRONG = {
    "no blur": ReferenceRasterizer(RenderingConstants(blur=0.0)),
    "brighter": Changed(lambda color: color + 0.001),
    "a pixel aside": Changed(lambda color: color.roll(1, dims=-1)),
    "not a number": Changed(lambda color: color * torch.nan),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_picture_is_noticed(wrong):
    assert "wrong by" in (doctor_checks.wrong(WRONG[wrong]) or "")


def test_backends_that_work_here_are_right_and_only_a_wrong_reference_is_broken(monkeypatch):
    sound = states(doctor_checks.check_rasterizers())
    assert sound["reference"] == "yes"
    assert "broken" not in sound.values()
    assert {name for name in FASTER if failure(name, None) is None} <= {n for n, s in sound.items() if s == "yes"}
    monkeypatch.setattr(doctor_checks, "ReferenceRasterizer", lambda: Changed(torch.zeros_like))
    found = states(doctor_checks.check_rasterizers())
    assert [name for name, state in found.items() if state == "broken"] == ["reference"]
