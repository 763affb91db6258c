import dataclasses

import pytest
import torch
from support import some_gaussians

from completesplat.errors import CompleteSplatError
from completesplat.export.cleaning import cleaned, storable
from completesplat.gaussians import concatenate


def scene(count: int = 3):
    """Twice as many Gaussians, each in a place of its own."""
    together = concatenate([some_gaussians(1)[0]] * count)
    return dataclasses.replace(together, means=torch.arange(6.0 * count).view(-1, 3))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(
            (field, float(text))
            for field in ("means", "scales", "opacities", "colors")
            for text in ("nan", "inf", "-inf")
        ),
        ("quaternions", float("nan")),
        ("means", 1e30),  # its square is beyond float32
        ("scales", 0.0),
        ("scales", -1.0),
        ("scales", 1e-60),  # nothing is left of it in float32
    ],
)
def test_what_is_broken_in_one_place_is_taken_out_and_counted(caplog, field, value):
    whole = scene().to(torch.float64)
    damaged = getattr(whole, field).clone()
    damaged.view(6, -1)[[1, 4], -1] = value
    broken = dataclasses.replace(whole, **{field: damaged})
    assert storable(broken).tolist() == [True, False, True, True, False, True]
    kept = cleaned(broken, "photo.jpg: sample 0")
    assert torch.equal(kept.means, broken.means[[0, 2, 3, 5]])
    assert caplog.messages == ["photo.jpg: sample 0: left out 2 of 6 Gaussians (not finite, or no extent)"]


def test_a_set_without_a_fault_is_the_same_set_and_says_nothing(caplog):
    whole = scene()
    assert cleaned(whole, "x") is whole
    assert caplog.messages == []


def test_a_set_of_nothing_but_faults_is_refused():
    whole = scene()
    with pytest.raises(CompleteSplatError, match=r"photo: all 6 Gaussians are broken"):
        cleaned(dataclasses.replace(whole, opacities=whole.opacities * torch.nan), "photo")


def test_an_empty_set_is_no_fault():
    nothing = scene().keep(torch.zeros(6, dtype=torch.bool))
    assert cleaned(nothing, "x").count == 0
