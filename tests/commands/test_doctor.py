"""`completesplat doctor`: one table, one file, one exit status."""

from functools import partial
from importlib import import_module

from support import strict_json

from completesplat.commands import doctor_checks
from completesplat.commands.doctor import findings_of

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
