"""The adapter onto gsplat.

Most tests here run without a GPU. gsplat's own Python front end (`gsplat.rasterization`) is called, and its four CUDA
operations are replaced by the stand-ins below: gsplat's projection in torch, and a compositor written from the
definition in `RasterizeToPixels3DGSFwd.cu`, both in float64. So they prove the adapter's conventions (units, axes,
order and shapes of arguments, batches, what is culled, what is kept from gsplat), not gsplat's CUDA kernels, their
float32 arithmetic or their gradients. The tests marked `gpu` compare those with the reference.
"""

import math
import re
import runpy
import sys
from dataclasses import replace
from functools import partial
from types import ModuleType
from typing import Any

import degenerate_gaussians
import numpy as np
import pytest
import torch
from degenerate_gaussians import DRAWN, NEVER_DRAWN, SIZE, camera, changed, healthy
from hydra.utils import instantiate
from rasterizer_scenes import scenes
from support import compose_config
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians, merge_gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.installation import install_command
from completesplat.rasterizers import Rasterizer, RenderingConstants, cuda
from completesplat.rasterizers.cuda import FARTHEST, CudaRasterizer
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.tiled import TiledRasterizer
from completesplat.tensors import stack


def standin_projection(means, covars, quats, scales, viewmats, Ks, width, height, **options) -> tuple:
    """`fully_fused_projection`: what CUDA leaves uninitialised for a culled Gaussian is NaN here."""
    from gsplat.cuda import _torch_impl

    assert covars is None
    assert (options["packed"], options["calc_compensations"], options["camera_model"]) == (False, False, "pinhole")
    (batch, count), views = means.shape[:2], viewmats.shape[1]
    covariances, _ = _torch_impl._quat_scale_to_covar_preci(quats.double(), scales.double(), compute_preci=False)
    results: list[list[Tensor]] = [[], [], [], []]
    for b, v in np.ndindex(batch, views):
        depths = means[b].double() @ viewmats[b, v, 2, :3].double() + viewmats[b, v, 2, 3].double()
        seen = (depths >= options["near_plane"]) & (depths <= options["far_plane"])
        seen &= options["opacities"][b] >= 1 / 255
        splats = (means[b, seen].double(), covariances[b, seen])
        limits = (options["eps2d"], -math.inf, math.inf)
        view = viewmats[b, v : v + 1].double(), Ks[b, v : v + 1].double(), width, height
        radii, *projected, _ = _torch_impl._fully_fused_projection(*splats, *view, *limits)
        results[0].append(torch.zeros(count, 2, dtype=torch.int32).index_put((seen,), radii[0]))
        for result, values in zip(results[1:], projected, strict=True):
            unknown = torch.full((count, *values.shape[2:]), math.nan, dtype=torch.float64)
            result.append(unknown.index_put((seen,), values[0]))
    return *(torch.stack(result).unflatten(0, (batch, views)) for result in results), None


def standin_tiles(means2d, radii, depths, tile_size, tile_width, tile_height, **options) -> tuple:
    """`isect_tiles`: the drawn Gaussians of each image once (not once for each tile), from front to back."""
    assert not options["packed"]
    drawn = (radii > 0).all(-1).flatten(0, 1)
    count = radii.shape[-2]
    orders = [torch.argsort(row, stable=True) for row in depths.flatten(0, 1)]
    indices = torch.cat([i * count + order[drawn[i][order]] for i, order in enumerate(orders)])
    return drawn.int(), indices, indices.int()


def standin_offsets(isect_ids, n_images, tile_width, tile_height) -> Tensor:
    return torch.zeros(n_images, tile_height, tile_width, dtype=torch.int32)


def standin_pixels(means2d, conics, colors, opacities, width, height, tile_size, offsets, indices, **options) -> tuple:
    """`rasterize_to_pixels` for every pixel and all Gaussians of an image."""
    assert options["backgrounds"] is None
    images = means2d.shape[:2]
    count = means2d.shape[2]
    x, y = torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy")
    pixels = torch.stack([x, y], dim=-1).double()
    results = []
    for i in range(images.numel()):
        chosen = indices[indices // count == i].long()
        tensors = [t.flatten(0, 2)[chosen] for t in (means2d, conics, colors, opacities.double())]
        results.append(composite(pixels, *tensors))
    return tuple(torch.stack(result).unflatten(0, images).float() for result in zip(*results, strict=True))


def composite(pixels: Tensor, means: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor) -> tuple:
    left = torch.ones_like(pixels[..., :1])
    done = torch.zeros_like(pixels[..., :1], dtype=torch.bool)
    # An image of nothing is connected with what could have been in it, as gsplat's is.
    nothing = sum(tensor[:0].sum() for tensor in (means, conics, colors, opacities))
    image = nothing + torch.zeros(*pixels.shape[:-1], colors.shape[-1], dtype=pixels.dtype)
    for mean, conic, color, opacity in zip(means, conics, colors, opacities, strict=True):
        dx, dy = (mean - pixels).split(1, dim=-1)
        sigma = 0.5 * (conic[0] * dx * dx + conic[2] * dy * dy) + conic[1] * dx * dy
        alpha = (opacity * torch.exp(-sigma)).clamp(max=0.999)
        drawn = (sigma >= 0) & (alpha >= 1 / 255)
        done = done | (drawn & (left * (1 - alpha) <= 1e-4))
        alpha = torch.where(drawn & ~done, alpha, 0.0)
        image = image + left * alpha * color
        left = left * (1 - alpha)
    return image, 1 - left


@pytest.fixture
def front_end(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """gsplat with stand-ins for its CUDA operations, on the CPU; a list of the arguments of all calls."""
    gsplat = pytest.importorskip("gsplat")
    if gsplat.__version__ != "1.5.3":
        pytest.skip("from gsplat 1.6 on its front end is one CUDA operation")
    standins = (standin_projection, standin_tiles, standin_offsets, standin_pixels)
    operations = ("fully_fused_projection", "isect_tiles", "isect_offset_encode", "rasterize_to_pixels")
    for name, standin in zip(operations, standins, strict=True):
        monkeypatch.setattr(gsplat.rendering, name, standin)
    calls: list[dict[str, Any]] = []

    def rasterization(**arguments):
        calls.append(arguments)
        return gsplat.rendering.rasterization(**arguments)

    monkeypatch.setattr(gsplat, "rasterization", rasterization)
    pretend_a_device(monkeypatch)
    return calls


def pretend_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")


def pretend_gsplat(monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty gsplat."""
    package = ModuleType("gsplat")
    package.__dict__.update(__version__="9", rasterization=None)
    monkeypatch.setitem(sys.modules, "gsplat", package)


draw = partial(degenerate_gaussians.draw, followed=("world_to_camera",))
assert_changes_nothing = partial(degenerate_gaussians.assert_changes_nothing, followed=("world_to_camera",))


def assert_agrees(gaussians, cameras, constants, of_images: float, of_gradients: float, exceptions: float = 0.0):
    """Exceptions are the share of values where another rounding may have decided otherwise at a threshold of alpha."""
    images, gradients = draw(CudaRasterizer(constants), gaussians, cameras)
    gaussians, cameras = (x.to("cpu", torch.float64) for x in (gaussians, cameras))
    exact, expected = draw(ReferenceRasterizer(constants), gaussians, cameras)
    assert images.dtype == torch.float32
    assert exact.any()
    assert ((images.cpu() - exact).abs() > of_images).double().mean() <= exceptions
    for name, gradient in expected.items():
        assert (gradients[name].cpu() - gradient).norm() <= of_gradients * gradient.norm(), name


@pytest.mark.parametrize("seed", range(3))
def test_images_and_gradients_agree_with_the_float64_reference(seed: int, front_end: list) -> None:
    size = [(13, 17), (16, 16), (9, 33)][seed % 3]
    constants = RenderingConstants() if seed % 2 else RenderingConstants(blur=0.1, near_plane=1.6)
    gaussians, cameras = scenes(seed, 2, 3, size, constants, count=[40, 64][seed % 4 == 0])
    assert_agrees(gaussians, cameras, constants, 2e-6, 1e-5)
    assert len(front_end) == 1  # for all scenes and views


@pytest.mark.parametrize(("count", "given"), [(0, 32), (32, 32), (33, 64)])
def test_gaussians_are_padded_to_whole_warps(count: int, given: int, front_end: list) -> None:
    """No warp reaches from one scene into the next, and the padding is not drawn."""
    gaussians = healthy(40).map(lambda tensor: tensor[:, :count])
    images, gradients = draw(CudaRasterizer(), gaussians)
    (call,) = front_end
    assert {call[name].shape[1] for name in ("means", "quats", "scales", "opacities", "colors")} == {given}
    assert not call["opacities"][:, count:].any()
    assert torch.allclose(call["quats"].norm(dim=-1), torch.ones(1, given))
    assert images.any() == (count > 0)
    assert all(gradients[name].shape == tensor.shape for name, tensor in vars(gaussians).items())


# With a gradient to the depth image, gsplat multiplies squares of depths: far away, the result is NaN.
LEFT_OUT = NEVER_DRAWN | {"negative": {"scales": (-3e7, -3e7, 0.2)}, "too far": {"means": (0.0, 0.0, 1.01 * FARTHEST)}}


@pytest.mark.parametrize("kind", LEFT_OUT)
def test_a_gaussian_that_cannot_be_drawn_changes_nothing(kind: str, front_end: list) -> None:
    assert_changes_nothing(CudaRasterizer(), changed(LEFT_OUT[kind]))


@pytest.mark.parametrize("kind", sorted(DRAWN.keys() - {"very far"}))
def test_an_extreme_gaussian_is_drawn_as_by_the_float64_reference(kind: str, front_end: list) -> None:
    degenerate_gaussians.assert_drawn_as_by_the_reference(CudaRasterizer(), kind, followed=("world_to_camera",))


def test_a_gaussian_that_overflows_in_one_view_is_left_out_of_all_views_of_its_scene(front_end: list) -> None:
    """If it lies behind that view's camera, the others draw it, as the reference does."""
    rest, near, far, behind = healthy(12), *(camera().world_to_camera.clone() for _ in range(3))
    far[..., 2, 3], behind[..., 2, 3] = 1e8, -4
    scenes = [merge_gaussians([one, rest]) for one in (changed({"scales": (1e8, 1e8, 1e8)}), changed({}))]
    both = stack(scenes).map(lambda tensor: tensor.squeeze(1))

    def alphas(rasterizer: Rasterizer, gaussians: Gaussians, *views: Tensor) -> Tensor:
        batch = len(gaussians.means)
        intrinsics = camera().intrinsics.expand(batch, len(views), 3, 3)
        return rasterizer(gaussians, Cameras(torch.cat(views, 1).expand(batch, -1, 4, 4), intrinsics, SIZE)).alpha

    actual, expected = (alphas(r, both, near, far) for r in (CudaRasterizer(), ReferenceRasterizer()))
    assert torch.equal(actual[0], alphas(CudaRasterizer(), rest, near, far)[0])
    assert expected[0, 1].min() > 0.5
    assert torch.allclose(actual[1], expected[1], atol=1e-5)
    actual, expected = (alphas(r, both, behind, far) for r in (CudaRasterizer(), ReferenceRasterizer()))
    assert torch.allclose(actual, expected, atol=1e-5)


def test_the_near_plane_is_the_references_and_the_far_one_gsplats(front_end: list) -> None:
    """A Gaussian exactly on the near plane is culled; one at the next float32 is not."""
    on = np.float32(0.01)
    beyond = np.nextafter(on, np.float32(1))
    for depth, seen in ((on, (0, 0)), (beyond, (1, 1)), (0.99 * FARTHEST, (1, 1)), (1.01 * FARTHEST, (0, 1))):
        one = changed({"means": (0.0, 0.0, float(depth)), "scales": (1e-4, 1e-4, 1e-4)})
        assert tuple(draw(r, one)[0].any() for r in (CudaRasterizer(), ReferenceRasterizer())) == seen


def test_refused_calls(front_end: list) -> None:
    gaussians = healthy(3)
    cameras = camera()
    with pytest.raises(CompleteSplatError, match="means is float64 on cpu"):
        CudaRasterizer()(gaussians.to(torch.float64), cameras)
    following = replace(cameras, intrinsics=cameras.intrinsics.clone().requires_grad_())
    with pytest.raises(CompleteSplatError, match="no gradient to the intrinsics"):
        CudaRasterizer()(gaussians, following)
    with torch.no_grad():
        assert CudaRasterizer()(gaussians, following).alpha.any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"max_alpha": 0.99}, r"max_alpha = 0\.999, not 0\.99: set rasterizer\.constants\.max_alpha=0\.999$"),
        ({"frustum_margin": 0.15}, "frustum_margin"),
        ({"blur": 0.0}, "blur of at least"),
        ({"near_plane": 0.0}, "near_plane of at least"),
    ],
)
def test_refused_constants(changes: dict, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend_a_device(monkeypatch)
    pretend_gsplat(monkeypatch)
    CudaRasterizer(RenderingConstants(blur=0.1, near_plane=1.0))
    with pytest.raises(CompleteSplatError, match=message):
        CudaRasterizer(RenderingConstants(**changes))


def test_all_backends_take_the_constants_of_gsplats_kernels(monkeypatch):
    """A run that was trained with others keeps them: `cuda` refuses (see above), the others draw with them."""
    max_alpha = 0.999
    other = 0.99
    pretend_a_device(monkeypatch)
    pretend_gsplat(monkeypatch)
    configured = instantiate(compose_config("fit", "rasterizer=cuda").rasterizer.constants)
    assert configured == RenderingConstants() == CudaRasterizer().constants
    assert configured.max_alpha == max_alpha
    opaque = changed({"scales": (50.0, 50.0, 50.0)})
    opaque = replace(opaque, opacities=torch.ones_like(opaque.opacities))
    for make in (TiledRasterizer, ReferenceRasterizer):
        for constants, expected in ((None, max_alpha), (RenderingConstants(max_alpha=other), other)):
            assert make(constants)(opaque, camera()).alpha.max().item() == pytest.approx(expected)


def test_missing_requirements_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The module itself can be imported without gsplat."""
    monkeypatch.setitem(sys.modules, "gsplat", None)  # type: ignore[arg-type]
    runpy.run_path(str(cuda.__file__))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(CompleteSplatError, match="CUDA device"):
        CudaRasterizer()
    pretend_a_device(monkeypatch)
    with pytest.raises(CompleteSplatError, match=re.escape(install_command("cuda"))):
        CudaRasterizer()


@pytest.fixture(params=[pytest.param(None, marks=pytest.mark.gpu)], ids=["gpu"])
def kernels() -> RenderingConstants:
    """The constants of gsplat's own kernels."""
    pytest.importorskip("gsplat")
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    return RenderingConstants()


@pytest.mark.parametrize(("batch", "views", "count"), [(2, 3, 60), (1, 1, 200), (3, 1, 12), (3, 1, 45), (2, 2, 64)])
def test_gsplats_kernels_agree_with_the_reference(batch, views, count, kernels: RenderingConstants) -> None:
    """With some of these counts warps would reach into a second scene, without padding."""
    gaussians, cameras = scenes(0, batch, views, (33, 50), kernels, count=count)
    assert_agrees(gaussians.to("cuda"), cameras.to("cuda"), kernels, 1e-4, 1e-3, exceptions=1e-3)


def test_cpu_tensors_are_drawn_on_the_gpu(kernels: RenderingConstants) -> None:
    gaussians, cameras = scenes(5, 2, 2, (20, 30), kernels)
    images, gradients = draw(CudaRasterizer(kernels), gaussians, cameras)
    moved, _ = draw(CudaRasterizer(kernels), gaussians.to("cuda"), cameras.to("cuda"))
    assert torch.equal(images, moved.cpu())
    assert all(gradient.device.type == "cpu" and gradient.any() for gradient in gradients.values())


@pytest.mark.parametrize("kind", NEVER_DRAWN)
def test_gsplat_never_gets_gaussians_that_cannot_be_drawn(kind: str, kernels: RenderingConstants) -> None:
    """The image is the same to the bit; gradients are sums in no fixed order."""
    assert_changes_nothing(CudaRasterizer(kernels), changed(NEVER_DRAWN[kind]), 1e-4)


@pytest.mark.parametrize(
    "gaussians", [healthy(0), *(merge_gaussians([healthy(12), changed(one)]) for one in DRAWN.values())]
)
def test_gsplats_kernels_keep_extreme_gaussians_finite(gaussians: Gaussians, kernels: RenderingConstants) -> None:
    images, gradients = draw(CudaRasterizer(kernels), gaussians)
    assert images.any() == (gaussians.count > 0)
    assert all(tensor.isfinite().all() for tensor in (images, *gradients.values()))
