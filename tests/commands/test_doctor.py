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
from completesplat.commands.doctor import applies, check_packages, extra_packages, findings_of, needed_packages
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


def test_what_cannot_be_imported_is_a_finding_and_no_traceback():
    (finding,) = findings_of("device", partial(import_module, "no_such_module"))
    assert finding.state == "broken"
    assert "ModuleNotFoundError" in finding.said


def test_what_is_needed_here_is_installed_here():
    assert [finding for finding in check_packages() if finding.state == "broken"] == []


def test_a_missing_package_is_broken_and_says_how_to_get_it():
    missing, others = needed_packages([Requirement("no-such-package-anywhere>=2.5")])
    assert (missing.name, missing.state) == ("no-such-package-anywhere", "broken")
    assert 'pip install "no-such-package-anywhere>=2.5"' in missing.said
    assert others.said.startswith("0 ")


def test_another_version_is_named_without_being_an_error():
    (found, _) = needed_packages([Requirement("numpy<1.0")])
    assert (found.name, found.state) == ("numpy", "no")
    assert "<1.0" in found.said


def test_packages_of_an_extra_that_are_missing_are_no_error():
    requirements = [Requirement("no-such-package-anywhere; extra == 'view'"), Requirement("numpy>=2.0")]
    (finding,) = extra_packages("view", "shows scenes", requirements)
    assert finding.state == "no"
    assert finding.said == 'shows scenes: pip install "completesplat[view]"'
    assert extra_packages("cuda", "draws", requirements) == []


@pytest.mark.parametrize(
    ("line", "extra", "expected"),
    [
        ("torch", "", True),
        ("torch; python_version < '3'", "", False),
        ("viser; extra == 'view'", "", False),
        ("viser; extra == 'view'", "view", True),
        ("viser; extra == 'view'", "cuda", False),
    ],
)
def test_markers_decide_what_a_requirement_is_for(line, extra, expected):
    assert applies(Requirement(line), extra) is expected


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


class Changed:
    """The reference, with something done to its colours."""

    def __init__(self, change):
        self.change = change

    def __call__(self, gaussians, cameras):
        drawn = ReferenceRasterizer()(gaussians, cameras)
        return replace(drawn, color=self.change(drawn.color))


@pytest.mark.parametrize("name", [name for name in FASTER if failure(name, None) is None])
def test_backends_that_agree_with_the_reference_draw_the_closed_form(name):
    assert doctor_checks.wrong(FASTER[name](None)) is None


def test_the_reference_draws_the_closed_form():
    assert doctor_checks.wrong(ReferenceRasterizer()) is None


@pytest.mark.parametrize(
    "wrong",
    [
        ReferenceRasterizer(RenderingConstants(blur=0.0)),
        Changed(lambda color: color + 0.001),
        Changed(lambda color: color.roll(1, dims=-1)),
        Changed(lambda color: color * torch.nan),
    ],
    ids=["no blur", "brighter", "a pixel aside", "not a number"],
)
def test_a_wrong_picture_is_noticed(wrong):
    assert "wrong by" in (doctor_checks.wrong(wrong) or "")


def test_only_a_wrong_reference_is_broken(monkeypatch):
    assert [finding.state for finding in doctor_checks.check_rasterizers() if finding.name == "reference"] == ["yes"]
    assert all(finding.state != "broken" for finding in doctor_checks.check_rasterizers())
    monkeypatch.setattr(doctor_checks, "ReferenceRasterizer", lambda: Changed(torch.zeros_like))
    assert [finding.name for finding in doctor_checks.check_rasterizers() if finding.state == "broken"] == ["reference"]
