import math
from types import SimpleNamespace

import pytest
import torch
from hydra.utils import instantiate
from pytorch_optimizer.optimizer.utils.matrix import zero_power_via_newton_schulz_5
from support import SMALL, compose_config

from completesplat.training.optimization import constant, cosine, exponential, muon


def factors(schedule, count: int, **settings) -> list[float]:
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=1.0)
    scheduler = schedule(optimizer, **settings)
    values = []
    for _ in range(count):
        values.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return values


def test_exponential_is_a_straight_line_in_the_logarithm_after_the_warm_up():
    values = factors(exponential, 1201, steps=1100, warmup_steps=100, final_ratio=0.01)
    assert values[:100] == pytest.approx([(i + 1) / 100 for i in range(100)])
    assert values[600] == pytest.approx(0.1)
    assert values[350] == pytest.approx(math.exp(math.log(0.01) / 4))
    assert values[1100] == values[1200] == pytest.approx(0.01)


def test_cosine_ends_at_the_final_ratio_and_constant_stays():
    values = factors(cosine, 301, steps=200, warmup_steps=0, final_ratio=0.1)
    assert (values[0], values[100], values[200], values[300]) == pytest.approx((1.0, 0.55, 0.1, 0.1))
    assert set(factors(constant, 5, steps=3)) == {1.0}


def test_a_schedule_goes_on_with_the_end_and_the_rate_of_its_config():
    """A training of 100 steps at rate 1 goes on to step 200 at rate 2: it has the rates that it had from the start."""

    def begun(rate, total):
        optimizer = torch.optim.Adam([torch.zeros(1, requires_grad=True)], lr=rate)
        return optimizer, cosine(optimizer, total, warmup_steps=10, final_ratio=0.1)

    (optimizer, schedule), (longer, other) = begun(1.0, 100), begun(2.0, 200)
    for _ in range(100):
        optimizer.step()
        schedule.step()
    assert optimizer.param_groups[0]["lr"] == pytest.approx(0.1)
    longer.load_state_dict(optimizer.state_dict())
    other.load_state_dict(schedule.state_dict())
    expected = [2 * rate for rate in factors(cosine, 201, steps=200, warmup_steps=10, final_ratio=0.1)]
    for step in range(100, 201):
        assert longer.param_groups[0]["lr"] == other.get_last_lr()[0] == pytest.approx(expected[step])
        longer.step()
        other.step()


def test_muon_steps_equally_far_in_all_directions_of_a_kernel_and_adam_moves_the_rest():
    kernel = torch.zeros(4, 2, 3, 3, requires_grad=True)
    bias = torch.zeros(4, requires_grad=True)
    optimizer = muon([kernel, bias], lr=0.5, adam_lr=0.01)
    left = torch.linalg.qr(torch.randn(4, 4)).Q
    right = torch.linalg.qr(torch.randn(18, 4)).Q
    kernel.grad = ((left * torch.tensor([1, 3, 10, 30])) @ right.T).view(4, 2, 3, 3)  # singular values
    bias.grad = torch.tensor([1.0, -2.0, 30.0, -400.0])
    optimizer.step()
    directions = -(left.T @ kernel.detach().flatten(1) @ right)
    assert directions.diagonal().tolist() == pytest.approx([0.5] * 4, rel=0.4)  # Newton and Schulz, stopped early
    assert (directions - directions.diagonal().diag()).abs().max() < 0.05
    assert bias.detach() == pytest.approx(-0.01 * torch.tensor([1.0, -1.0, 1.0, -1.0]))
    assert [len(group["params"]) for group in muon([bias], lr=0.5, adam_lr=0.01).param_groups] == [1]


def test_muon_on_a_processor_iterates_as_the_library_does_in_float64():
    gradients = [torch.randn(shape) for shape in ((8, 4, 3, 3), (8, 36), (16, 8), (64, 576))]
    gradients += [torch.outer(torch.randn(8), torch.randn(12)) + 1e-4 * torch.randn(8, 12)]  # nearly of rank 1
    parameters = [torch.zeros_like(gradient, requires_grad=True) for gradient in gradients]
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient.clone()
    muon(parameters, lr=1.0, adam_lr=0.01).step()
    for parameter, gradient in zip(parameters, gradients, strict=True):
        matrix = gradient.flatten(1).double()
        expected = -zero_power_via_newton_schulz_5(matrix, dtype=torch.float64)
        expected *= max(1, len(matrix) / len(matrix.T)) ** 0.5  # the library's longer steps for tall matrices
        actual = parameter.detach().flatten(1).double()
        assert (actual - expected).norm() < 2e-3 * expected.norm()  # 0.01 to 0.4 in bfloat16


def test_the_schedule_spans_the_run():
    settings = ["schedule.warmup_steps=0", "optimizer=adam", "optimizer.lr=1.0e-3"]
    module = instantiate(compose_config("fit", "experiment=toy_var", *SMALL, *settings).model, _convert_="all")
    module._trainer = SimpleNamespace(estimated_stepping_batches=6)  # Lightning's, of max_steps or max_epochs
    made = module.configure_optimizers()
    assert made["lr_scheduler"]["interval"] == "step"
    rates = []
    for _ in range(7):
        rates += made["lr_scheduler"]["scheduler"].get_last_lr()
        made["optimizer"].step()
        made["lr_scheduler"]["scheduler"].step()
    assert rates == pytest.approx([1e-3 * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * n / 6))) for n in range(7)])
