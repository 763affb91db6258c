"""What is drawn in each of the comparisons: calls of the networks, and how much goes through them at once."""

from collections.abc import Callable
from typing import NamedTuple

import pytest
from support import compose_config, tiny_generator
from torch import nn

from completesplat.benchmarks.diffusion import Comparison, comparisons
from completesplat.generation import CompleteSplat

FEW = compose_config("fit", "sampler=dpm10", "sampler.steps=3").sampler


class Drawn(NamedTuple):
    """Batch sizes of the calls of each network."""

    encoder: list[int]
    denoiser: list[int]
    reconstructor: list[int]


@pytest.fixture(scope="module")
def model() -> CompleteSplat:
    return tiny_generator()


@pytest.fixture(scope="module")
def compared(model) -> dict[str, Comparison]:
    return {comparison.name: comparison for comparison in comparisons(model, FEW, samples=4, steps=2, batch=3)}


def drawn(model: CompleteSplat, work: Callable[[], object]) -> Drawn:
    seen = Drawn([], [], [])
    networks: list[nn.Module] = [
        model.autoreconstructor.encoder,
        model.denoiser,
        model.autoreconstructor.reconstructor,
    ]
    hooks = [
        network.register_forward_pre_hook(lambda _, inputs, sizes=sizes: sizes.append(len(inputs[0])))
        for network, sizes in zip(networks, seen, strict=True)
    ]
    work()
    for hook in hooks:
        hook.remove()
    return seen


def test_samples_of_one_picture_in_a_batch_and_one_by_one(model, compared):
    comparison = compared["batch_vs_one_by_one_k4"]
    assert drawn(model, comparison.a[1]) == Drawn([1], [4] * 2, [4])
    # By turns: a sample is denoised and reconstructed before the next.
    assert drawn(model, comparison.b[1]) == Drawn([1], [1] * 2 * 4, [1] * 4)


def test_guidance_doubles_the_denoisers_batch_and_nothing_else(model, compared):
    comparison = compared["unguided_vs_guided"]
    steps = model.sampler.steps
    assert drawn(model, comparison.a[1]) == Drawn([3], [3] * steps, [3])
    assert drawn(model, comparison.b[1]) == Drawn([3], [6] * steps, [3])


def test_few_steps_are_of_the_sampler_that_is_given_and_fifty_of_the_models(model, compared):
    comparison = compared["few_steps_vs_50"]
    assert (comparison.a[0], comparison.b[0]) == ("DPMSolver, 3 steps", "DDIM, 50 steps")
    assert drawn(model, comparison.a[1]) == Drawn([3], [3] * 3, [3])
    assert type(model.sampler.scheduler).__name__ == "DPMSolverMultistepScheduler"
    assert drawn(model, comparison.b[1]) == Drawn([3], [3] * 50, [3])
    assert type(model.sampler.scheduler).__name__ == "DDIMScheduler"


def test_the_model_keeps_its_own_sampler_configuration(model, compared):
    assert "DDIM" in model.architecture["sampler"]["scheduler"]["_target_"]
