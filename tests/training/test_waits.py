"""A training step does not wait for the GPU: seen on fake tensors of one, and on a real one with all callbacks."""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from lightning import Callback, Trainer
from support import compose_config
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from completesplat.commands import fit
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.losses.ssim import blur_matrix
from completesplat.rasterizers import Rendering, with_view_colors
from completesplat.settings.checks import remove_start_weights
from completesplat.training.steps import Training, synthetic_batch

aten = torch.ops.aten
READS = {aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default, aten.equal.default}
INDEXING = {aten.index.Tensor, aten.index_put_.default, aten.index_put.default}
NETWORKS = ["autoreconstructor.encoder.channels=[8,8,16]"]
SMALL = ["conditioning.channels=[8,8,16]", "denoiser.channels=[16,32]"]
PACKAGE = Path(fit.__file__).parents[1]
STAGES = {
    "stage 1": ["experiment=toy_views_var", "optimizer=adam"],
    "stage 1 by Muon": ["experiment=toy_views_var", "optimizer=muon"],
    "stage 2 by flow matching": ["experiment=toy_views_diffusion", "optimizer=adam", "objective=flow"],
    "stage 2 by diffusion": ["experiment=toy_views_diffusion", "optimizer=adam", "objective=epsilon"],
    "stage 2 by Muon": ["experiment=toy_views_diffusion", "optimizer=muon"],
}


def networks(stage: str) -> list[str]:
    return NETWORKS + (SMALL if stage.startswith("stage 2") else [])


class WithoutInitialWeights(TorchFunctionMode):
    """Builds modules without initial weights; samplers, which read values, read ones."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if getattr(func, "__module__", None) == "torch.nn.init":
            return args[0] if args else kwargs["tensor"]
        return 1.0 if func is torch.Tensor.item else func(*args, **(kwargs or {}))


@contextmanager
def fake_tensors() -> Iterator[None]:
    """Make fake tensors only, and leave none in the package's caches."""
    blur_matrix.cache_clear()
    with FakeTensorMode():
        yield
    blur_matrix.cache_clear()


class EmptyRasterizer:
    """Images of the right shape that depend on the Gaussians, without drawing."""

    @with_view_colors
    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        scenes, views = cameras.world_to_camera.shape[:2]
        image = gaussians.means.mean() * gaussians.means.new_empty(scenes, views, 5, *cameras.image_size)
        return Rendering(image[:, :, :3], image[:, :, 3:4], image[:, :, 4:])


class Waits(TorchDispatchMode):
    """Notes the lines of the package whose operations wait for a GPU."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if self.waits(func, args, kwargs):
            frames = [x for x in traceback.extract_stack() if Path(x.filename).is_relative_to(PACKAGE)]
            self.lines.append(f"{Path(frames[-1].filename).name}: {frames[-1].line}" if frames else str(func))
        return func(*args, **kwargs)

    def waits(self, func, args, kwargs) -> bool:
        devices = {x.device.type for x in tree_leaves(args) if isinstance(x, torch.Tensor)}
        if func in READS:
            return "cuda" in devices
        if func in INDEXING and args[0].is_cuda:
            indices = [x for x in args[1] if x is not None]
            return any(not x.is_cuda or x.dtype in (torch.bool, torch.uint8) for x in indices)
        if func is aten._to_copy.default:
            target = torch.device(kwargs.get("device") or args[0].device).type
            return devices | {target} > {"cuda"} and not kwargs.get("non_blocking")
        return func is aten.copy_.default and devices > {"cuda"} and not (args[2:] or [kwargs.get("non_blocking")])[0]


def test_waits_are_seen(pretended_gpu: None) -> None:
    with fake_tensors(), Waits() as waits:
        values = torch.ones(3, device="cuda")
        values.new_tensor([1.0, 2.0])
        torch.ones(3).to(values)
        values.cpu()
        values[torch.tensor([0, 1])]
        values.copy_(torch.zeros(3))
        assert len(waits.lines) == 5
        torch.ones(3).to(values, non_blocking=True)
        torch.full((3,), 2.0, device="cuda")[1:] = 1
        torch.where(values > 0, values, 0.0).double()
        assert len(waits.lines) == 5


SLOW = [stage for stage in STAGES if stage.endswith("Muon")]


@pytest.mark.parametrize("precision", ["bf16-mixed", pytest.param("32-true", marks=pytest.mark.slow)])
@pytest.mark.parametrize("stage", [pytest.param(x, marks=pytest.mark.slow if x in SLOW else ()) for x in STAGES])
def test_nothing_in_a_step_waits(stage: str, precision: str, pretended_gpu: None) -> None:
    """Its forward pass and its optimizer; the backward pass would need a real GPU."""
    config = compose_config("fit", *STAGES[stage], "data.image_size=32", *networks(stage))
    remove_start_weights(config.model)
    config.rasterizer = {"_target_": f"{__name__}.EmptyRasterizer"}
    with sdpa_kernel(SDPBackend.MATH), fake_tensors():
        with WithoutInitialWeights(), torch.device("cuda"):
            training = Training(instantiate(config.model, _convert_="all"), precision)
        training.module.draw_others = lambda targets: targets - 1
        if stage == "stage 2 by diffusion":  # diffusers' schedulers are no modules, so they stay on the CPU
            scheduler = training.module.completesplat.sampler.scheduler
            scheduler.alphas_cumprod = scheduler.alphas_cumprod.cpu()
        scenes = synthetic_batch(32, 2, 3).to("cuda")
        for _ in range(2):  # what is kept from the first step on is made in it
            with Waits() as waits:
                training.loss(scenes)
                for parameter in training.module.parameters():
                    parameter.grad = torch.empty_like(parameter) if parameter.requires_grad else None
                training.update()
    assert waits.lines == []


class Watched(Callback):
    """Makes torch raise an error where it waits, from the end of the third step to the end of the sixth."""

    def on_train_batch_end(self, trainer, *_) -> None:
        torch.cuda.set_sync_debug_mode("error" if 3 <= trainer.global_step < 6 else "default")


@pytest.fixture
def one_wait_in_gsplat(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let gsplat read the number of pairs of Gaussian and tile, which it has to allocate, once in each render."""
    rendering = pytest.importorskip("gsplat.rendering")
    count = rendering.isect_tiles

    @wraps(count)
    def counted(*arguments, **options):
        mode = torch.cuda.get_sync_debug_mode()
        torch.cuda.set_sync_debug_mode("default")
        try:
            return count(*arguments, **options)
        finally:
            torch.cuda.set_sync_debug_mode(mode)

    monkeypatch.setattr(rendering, "isect_tiles", counted)
    yield
    torch.cuda.set_sync_debug_mode("default")


def train(stage: str, folder: Path, precision: str, *settings: str) -> Trainer:
    """Train seven steps with all callbacks but those that draw."""
    sizes = ["data.image_size=32", "data.batch_size=2", "data.references_per_sequence=16", "data.targets=3"]
    sizes += ["callbacks.progress=null", "callbacks.images=null", "test=false", "callbacks.ema.decay=0.99"]
    config = compose_config(
        "fit", *STAGES[stage], "callbacks=ema", *networks(stage), *sizes, *settings, f"out={folder}"
    )
    folder.mkdir()
    data, module = fit.instantiate(config)
    quiet = {"logger": False, "enable_progress_bar": False, "limit_val_batches": 0, "log_every_n_steps": 1000}
    callbacks = [*fit.built_parts(config.callbacks), *([Watched()] if torch.cuda.is_available() else [])]
    trainer = instantiate(
        config.trainer, callbacks=callbacks, precision=precision, max_steps=7, **quiet, _convert_="all"
    )
    trainer.fit(module, datamodule=data)
    return trainer


def test_lightning_reads_no_figure_in_a_step(toy_root, tmp_path) -> None:
    """It would read what is logged for its own progress bar, also without a bar."""
    trainer = train("stage 1", tmp_path / "var", "32-true", f"data.root={toy_root}", "rasterizer=tiled")
    assert trainer.progress_bar_metrics == {}


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("precision", ["bf16-mixed", "32-true"])
def test_steps_with_all_callbacks_do_not_wait(toy_root, tmp_path, precision, one_wait_in_gsplat) -> None:
    given = [f"data.root={toy_root}", "rasterizer=cuda"]
    train("stage 1", tmp_path / "var", precision, *given)
    given.append(f"model.autoreconstructor_checkpoint={tmp_path / 'var/checkpoints/last.ckpt'}")
    for stage in ("stage 2 by flow matching", "stage 2 by diffusion"):
        train(stage, tmp_path / stage.replace(" ", "_"), precision, *given)
