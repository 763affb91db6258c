"""The automatic choice of a backend."""

import logging
from collections.abc import Iterator

import pytest
import torch

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rendering, RenderingConstants, selection, tiled
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.tiled import TiledRasterizer


@pytest.fixture(autouse=True)
def _no_memory() -> Iterator[None]:
    selection._tiled_failure.cache_clear()
    yield
    selection._tiled_failure.cache_clear()


def test_the_tiled_backend_is_taken_where_it_works(caplog: pytest.LogCaptureFixture) -> None:
    constants = RenderingConstants(max_alpha=0.99)
    with caplog.at_level(logging.INFO):
        chosen = selection.auto(constants)
    assert isinstance(chosen, TiledRasterizer)
    assert chosen.constants == constants
    assert selection.available() == {"tiled": True, "reference": True}
    assert "tiled" in caplog.text


def test_a_backend_that_raises_is_not_taken(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    def fail(self: TiledRasterizer, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        raise OSError("no such instruction")

    monkeypatch.setattr(tiled.TiledRasterizer, "__call__", fail)
    assert isinstance(selection.auto(), ReferenceRasterizer)
    assert not selection.available()["tiled"]
    assert "OSError: no such instruction" in caplog.text


@pytest.mark.parametrize("wrong", ["image", "gradient"])
def test_a_backend_that_renders_wrongly_is_not_taken(
    wrong: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    right = TiledRasterizer.__call__

    def render(self: TiledRasterizer, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        rendering = right(self, gaussians, cameras)
        color = rendering.color
        color = color * 1.01 if wrong == "image" else color + 0.01 * (color - color.detach())
        return Rendering(color, rendering.depth, rendering.alpha)

    monkeypatch.setattr(tiled.TiledRasterizer, "__call__", render)
    assert isinstance(selection.auto(), ReferenceRasterizer)
    assert "wrong by" in caplog.text


def test_constants_that_the_tiled_backend_refuses_go_to_the_reference(caplog: pytest.LogCaptureFixture) -> None:
    chosen = selection.auto(RenderingConstants(blur=0.0))
    assert isinstance(chosen, ReferenceRasterizer)
    assert chosen.constants.blur == 0
    assert "blur" in caplog.text


def test_the_choice_works_where_gradients_are_off() -> None:
    with torch.no_grad():
        assert isinstance(selection.auto(), TiledRasterizer)
