"""The denoiser compiled and as it is: the same work, and an end of compiling."""

import time

import pytest
import torch
from support import tiny_generator
from torch import nn

from completesplat.benchmarks.diffusion import NotMeasured, compiled_vs_eager


class Wrapped(nn.Module):
    """What torch.compile gives, but for the compiling."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.calls = 0

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return self.network(*inputs)


def test_both_ways_pass_the_same_through_the_denoiser_forward_and_backward(monkeypatch):
    model, wrapped, seen, gradients = tiny_generator(), [], [], []
    monkeypatch.setattr(torch, "compile", lambda network: wrapped.append(Wrapped(network)) or wrapped[0])
    comparison = compiled_vs_eager(model, 3, "32-true", 60)
    assert wrapped[0].calls == 1  # which compiles
    model.denoiser.register_forward_pre_hook(lambda _, inputs: seen.append(inputs))
    next(model.denoiser.parameters()).register_hook(lambda gradient: gradients.append(gradient.clone()))
    comparison.a[1]()
    assert wrapped[0].calls == 2
    comparison.b[1]()
    assert wrapped[0].calls == 2
    assert len(seen) == len(gradients) == 2
    for one, other in zip(*seen, strict=True):
        assert len(one) == 3
        assert torch.equal(one, other)
    torch.testing.assert_close(*gradients)
    assert gradients[0].any()


def test_compiling_that_takes_too_long_is_given_up(monkeypatch):
    def compile(network: nn.Module) -> nn.Module:
        network.register_forward_pre_hook(lambda *_: time.sleep(60))
        return network

    monkeypatch.setattr(torch, "compile", compile)
    start = time.monotonic()
    with pytest.raises(NotMeasured, match=r"took longer than compile_limit=0\.2 s"):
        compiled_vs_eager(tiny_generator(), 1, "32-true", 0.2)
    assert time.monotonic() - start < 30


def test_what_handles_errors_does_not_hold_up_the_end(monkeypatch):
    def compile(network: nn.Module) -> nn.Module:
        def stubborn(*_: object) -> None:
            try:
                time.sleep(60)
            except Exception:
                time.sleep(60)

        network.register_forward_pre_hook(stubborn)
        return network

    monkeypatch.setattr(torch, "compile", compile)
    with pytest.raises(NotMeasured, match="took longer"):
        compiled_vs_eager(tiny_generator(), 1, "32-true", 0.2)


def test_an_error_gives_the_reason_in_one_line(monkeypatch):
    def compile(network: nn.Module) -> nn.Module:
        raise RuntimeError("no compiler\nat all")

    monkeypatch.setattr(torch, "compile", compile)
    with pytest.raises(NotMeasured, match=r"^torch\.compile failed: RuntimeError: no compiler$"):
        compiled_vs_eager(tiny_generator(), 1, "32-true", 60)


def test_without_a_limit_nothing_is_compiled(monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda network: pytest.fail("compiled"))
    with pytest.raises(NotMeasured, match="compile_limit=0"):
        compiled_vs_eager(tiny_generator(), 1, "32-true", 0)
