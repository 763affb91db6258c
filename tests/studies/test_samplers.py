"""Which row is named, and what is counted."""

import torch
from support import tiny_generator

from completesplat.studies.controls import PAPER, grid
from completesplat.studies.samplers import Watch, fewest


def row(calls: int, psnr: float, agreement: float = 30.0) -> dict:
    return {"calls": calls, "psnr": psnr, "agreement": agreement}


def test_the_fewest_calls_within_a_tenth_of_a_decibel_are_named():
    reference = row(50, 20.0, 100.0)
    rows = [reference, row(5, 20.2), row(8, 19.85), row(10, 20.05), row(10, 20.0, 40.0), row(20, 20.0)]
    assert fewest(rows) is rows[4]
    assert fewest([reference, row(5, 19.0)]) is reference


def test_calls_are_those_of_the_denoiser():
    model = tiny_generator()
    watch = Watch(model)
    photograph = torch.rand(3, 32, 32)
    for steps in (1, 5):
        with watch:
            model.generate(
                photograph[None], camera(model), model.depth_range[None], samples=2, steps=steps, guidance_weight=0.5
            )
        assert watch.calls == steps
        assert watch.seconds > 0
    model.generate(photograph[None], camera(model), model.depth_range[None])
    assert watch.calls == 5


def camera(model):
    from completesplat.data.pictures.photograph import Photograph

    return model.camera(Photograph(torch.zeros(3, 32, 32), 50.0, "given"))[None]


def test_the_papers_settings_are_always_in_the_grid():
    assert grid([], []) == sorted(PAPER)
    assert set(grid([0, 1], [0.2])) == {(0.0, 0.2), (1.0, 0.2), (0.5, 0.5), (0.0, 0.5)}
