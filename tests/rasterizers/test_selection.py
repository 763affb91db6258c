"""The automatic choice of a backend, on a machine without a GPU unless a test pretends that there is one."""

import logging
import math
import sys
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from support import compose_config

from completesplat.commands import refusal
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.installation import install_command
from completesplat.rasterizers import Rendering, RenderingConstants, cuda, selection
from completesplat.rasterizers.kernels import compilation
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.tiled import TiledRasterizer
from completesplat.weights.runs import config_of_run


@pytest.fixture(autouse=True)
def _no_gpu_and_no_memory(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    failure = selection.failure
    failure.cache_clear()
    yield
    failure.cache_clear()


class Works(ReferenceRasterizer):
    """A working backend."""


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)


def warnings_in(caplog: pytest.LogCaptureFixture) -> str:
    return "\n".join(record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING)


def test_the_tiled_backend_is_taken_where_there_is_no_gpu(caplog: pytest.LogCaptureFixture) -> None:
    """Which is what everybody without one expects, so that it is logged for debugging alone."""
    constants = RenderingConstants(max_alpha=0.99)
    with caplog.at_level(logging.DEBUG):
        chosen = selection.auto(constants)
    assert isinstance(chosen, TiledRasterizer)
    assert chosen.constants == constants
    assert "not cuda: the cuda rasterizer needs a CUDA device" in caplog.text
    assert "rasterizer: tiled" in caplog.text
    assert not [record for record in caplog.records if record.levelno > logging.DEBUG]


def test_the_cuda_backend_is_taken_where_it_works(gpu: None, monkeypatch, caplog) -> None:
    monkeypatch.setitem(selection.FASTER, "cuda", Works)
    constants = RenderingConstants(blur=0.1)
    with torch.no_grad():  # the test rendering needs gradients all the same
        chosen = selection.auto(constants)
    assert isinstance(chosen, Works)
    assert chosen.constants == constants
    assert warnings_in(caplog) == ""


def test_a_gpu_without_gsplat_or_with_refused_constants_gives_a_warning(gpu: None, monkeypatch, caplog):
    pytest.importorskip("gsplat")
    constants = RenderingConstants(max_alpha=0.9)
    chosen = selection.auto(constants)
    assert isinstance(chosen, TiledRasterizer)
    assert chosen.constants == constants
    assert "set rasterizer.constants.max_alpha" in warnings_in(caplog)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    assert isinstance(selection.auto(), TiledRasterizer)
    assert install_command("cuda") in warnings_in(caplog)


def test_gsplat_is_tried_and_not_only_imported(gpu: None, monkeypatch, caplog) -> None:
    """Without compiled kernels gsplat can be imported, and its first call fails like this."""
    gsplat = pytest.importorskip("gsplat")
    monkeypatch.setattr(cuda, "DEVICE", "cpu")

    def fail(**arguments: object) -> None:
        raise AttributeError("'NoneType' object has no attribute 'CameraModelType'")

    monkeypatch.setattr(gsplat, "rasterization", fail)
    assert isinstance(selection.auto(), TiledRasterizer)
    assert "not cuda: AttributeError: 'NoneType'" in warnings_in(caplog)


@pytest.mark.parametrize("wrong", ["call", "image", "gradient", "nan"])
def test_a_backend_that_raises_or_renders_wrongly_is_not_taken(wrong: str, monkeypatch, caplog) -> None:
    class Wrong(ReferenceRasterizer):
        def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
            if wrong == "call":
                raise OSError("no such instruction")
            rendering = super().__call__(gaussians, cameras)
            color = rendering.color * (1.01 if wrong == "image" else 1)
            color.register_hook(lambda gradient: gradient * {"image": 1, "gradient": 1.01, "nan": math.nan}[wrong])
            return replace(rendering, color=color)

    monkeypatch.setattr(selection, "FASTER", {"first": Wrong, "second": Works})
    assert isinstance(selection.auto(), Works)
    reason = "OSError: no such instruction" if wrong == "call" else "its test rendering is wrong by"
    assert f"not first: {reason}" in warnings_in(caplog)


@pytest.fixture
def tests_run(monkeypatch, tmp_path) -> list[str]:
    """Names of the backends that were tested, where no test has been passed before."""
    ran = list[str]()
    test = selection.failure.__wrapped__
    monkeypatch.setattr(selection, "failure", lambda name, constants: ran.append(name) or test(name, constants))
    monkeypatch.setattr(selection, "FASTER", {"tiled": Works})
    monkeypatch.setattr(compilation, "cache_directory", lambda: tmp_path)
    (tmp_path / "kernels_machine").mkdir()
    (tmp_path / "kernels_machine/kernel.nbc").write_bytes(b"code")
    return ran


def test_a_passed_test_is_not_repeated_under_the_same_conditions(tests_run, tmp_path, monkeypatch) -> None:
    constants = RenderingConstants(max_alpha=0.98)
    for _ in range(2):
        assert isinstance(selection.auto(constants), Works)
    assert tests_run == ["tiled"]

    def tested_again() -> bool:
        before = len(tests_run)
        selection.auto(constants)
        selection.auto(constants)
        return len(tests_run) == before + 1

    for change in (
        lambda: (tmp_path / "kernels_machine/kernel.nbc").write_bytes(b"cope"),
        lambda: (tmp_path / "kernels_machine/other.nbi").write_bytes(b"index"),
        lambda: monkeypatch.setattr(torch, "__version__", "3.0"),
        lambda: monkeypatch.setenv("NUMBA_OPT", "0"),
        lambda: [path.unlink() for path in tmp_path.glob("passed-*")],
    ):
        change()
        assert tested_again()
    constants = RenderingConstants(max_alpha=0.97)
    assert tested_again()


def test_a_failed_test_is_repeated(tests_run, monkeypatch) -> None:
    monkeypatch.setattr(selection, "TOLERANCE", -1.0)
    for _ in range(2):
        assert not isinstance(selection.auto(), Works)
    assert tests_run == ["tiled", "tiled"]


@pytest.mark.parametrize("folder", [None, "missing"])
def test_without_a_writable_folder_every_process_tests(folder: str | None, tests_run, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(compilation, "cache_directory", lambda: folder and tmp_path / folder)
    for _ in range(2):
        assert isinstance(selection.auto(), Works)
    assert tests_run == ["tiled", "tiled"]


def test_constants_that_the_tiled_backend_refuses_go_to_the_reference(caplog: pytest.LogCaptureFixture) -> None:
    chosen = selection.auto(RenderingConstants(blur=0.0))
    assert isinstance(chosen, ReferenceRasterizer)
    assert chosen.constants.blur == 0
    assert "not tiled: " in warnings_in(caplog)
    assert "reference, which takes minutes for an image" in warnings_in(caplog)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_with_gsplat_is_used(gpu: None) -> None:
    pytest.importorskip("gsplat")
    assert isinstance(selection.auto(), cuda.CudaRasterizer)


def test_a_cuda_rasterizer_that_does_not_work_names_the_alternative():
    with pytest.raises(InstantiationException) as caught:
        instantiate(compose_config("fit", "rasterizer=cuda").rasterizer, _convert_="all")
    line = refusal(caught.value) or ""
    assert "needs a CUDA device" in line
    assert line.endswith("; rasterizer=auto takes the fastest one that works here")


def test_a_run_that_asked_for_cuda_is_tested_with_a_rasterizer_that_works(tmp_path):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints/last.ckpt").touch()
    OmegaConf.save(compose_config("fit", "rasterizer=cuda"), tmp_path / "config.yaml", resolve=True)
    rasterizer = config_of_run(tmp_path / "checkpoints/last.ckpt", []).model.rasterizer
    assert isinstance(instantiate(rasterizer, _convert_="all"), TiledRasterizer)
