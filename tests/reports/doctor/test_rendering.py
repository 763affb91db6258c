"""The doctor's picture that can be worked out by hand, drawn by rasterizers that are right and wrong."""

from dataclasses import replace

import pytest
import torch

from completesplat.commands import doctor_checks
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.selection import FASTER, failure


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
