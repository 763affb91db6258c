"""Which rasterizers are compared: those that draw a small scene here, in the order in which they were named."""

import pytest
from support import compose_config

from completesplat.benchmarks import rasterizers
from completesplat.benchmarks.rasterizers import CLASSES, Backend, working_backends
from completesplat.errors import CompleteSplatError
from completesplat.rasterizers import Rasterizer, RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer

TILED = "completesplat.rasterizers.tiled.TiledRasterizer"


class Broken:
    def __init__(self, constants: RenderingConstants) -> None: ...

    def __call__(self, gaussians, cameras):
        raise RuntimeError("no kernel\n  for this [processor]")


class NoBackward(ReferenceRasterizer):
    def __call__(self, gaussians, cameras):
        return super().__call__(gaussians.detach(), cameras)


def test_an_unknown_name_is_refused_before_anything_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TILED, lambda constants: pytest.fail("made"))
    with pytest.raises(CompleteSplatError, match=r"'nonsense'.* reference, .* tiled, cuda") as refusal:
        working_backends(["tiled", "nonsense"], RenderingConstants())
    assert "\n" not in str(refusal.value)


def test_one_that_fails_is_absent_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TILED, Broken)
    found, absent = working_backends(["tiled", "reference"], RenderingConstants())
    assert [backend.name for backend in found] == ["reference"]
    assert absent == {"tiled": "no kernel for this [processor]"}


def test_one_without_gradients_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TILED, NoBackward)
    found, absent = working_backends(["tiled"], RenderingConstants())
    assert found == []
    assert "grad" in absent["tiled"]


def test_an_error_without_a_message_is_told_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(constants: RenderingConstants) -> Rasterizer:
        raise NotImplementedError

    monkeypatch.setattr(TILED, refuse)
    assert working_backends(["tiled"], RenderingConstants()) == ([], {"tiled": "NotImplementedError"})


def test_a_module_that_cannot_be_imported_is_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CLASSES, "cuda", "completesplat.nowhere.Rasterizer")
    _, absent = working_backends(["cuda"], RenderingConstants())
    assert "completesplat.nowhere" in absent["cuda"]


@pytest.mark.parametrize("names", [["tiled", "reference"], ["reference", "tiled"]])
def test_the_order_is_kept_and_the_constants_arrive(names: list[str]) -> None:
    constants = RenderingConstants(max_alpha=0.9)
    found, absent = working_backends(names, constants)
    assert absent == {}
    assert [backend.name for backend in found] == names
    assert all(backend.rasterizer.constants == constants for backend in found)  # type: ignore[attr-defined]


def test_only_the_reference_is_spared_large_workloads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rasterizers, "MOST_REFERENCE_PAIRS", 1000)
    reference, tiled = (Backend(name, ReferenceRasterizer()) for name in ("reference", "tiled"))
    assert reference.takes(10, 100)
    assert not reference.takes(10, 101)
    assert tiled.takes(10**6, 10**6)


def test_every_backend_of_the_configuration_is_known() -> None:
    config = compose_config("bench")
    assert set(config.backends) == set(CLASSES)
    assert set(config.growth.backends) <= set(CLASSES)
    assert set(config.training_step.backends) <= set(CLASSES)
