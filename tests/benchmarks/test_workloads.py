"""The scenes that are timed, and the time and memory of one rendering."""

import threading
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from rasterizer_scenes import render_with_gradients
from support import waited_for

from completesplat.benchmarks import workloads
from completesplat.benchmarks.workloads import (
    DEFAULTS,
    DISTANCE,
    FOV_DEGREES,
    NEEDED,
    OPACITIES,
    milliseconds,
    orbit,
    peak_megabytes,
    read_scene,
    splatter_scene,
)
from completesplat.errors import DataError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole, project
from completesplat.rasterizers import Rendering
from completesplat.rasterizers.kernels import drawing
from completesplat.rasterizers.reference import ReferenceRasterizer


@pytest.mark.parametrize("opacity", OPACITIES)
def test_the_workload_looks_like_a_splatter_image(opacity: str) -> None:
    size, seen = 32, 24
    gaussians, _ = splatter_scene(size, 1, opacity, seen)
    source = Cameras(torch.eye(4)[None, None], pinhole(FOV_DEGREES, seen)[None, None], (seen, seen))
    alpha = ReferenceRasterizer()(gaussians, source).alpha
    assert gaussians.count == 2 * size * size
    assert alpha.min() > 0.5  # every pixel has its Gaussians
    if opacity == "initial":
        assert 0.1 <= gaussians.opacities.min() <= gaussians.opacities.max() < 0.31
    else:
        assert gaussians.opacities.max() > 0.9
        assert (alpha > 0.99).float().mean() > 0.5


def test_what_the_cameras_see_may_be_larger_than_the_splatter_image() -> None:
    gaussians, cameras = splatter_scene(8, 3, "trained")
    others, larger = splatter_scene(8, 3, "trained", 24)
    assert all(torch.equal(tensor, getattr(others, name)) for name, tensor in vars(gaussians).items())
    assert (cameras.image_size, larger.image_size) == ((8, 8), (24, 24))
    pixels, enlarged = (project(views, gaussians.means[:, None])[0] for views in (cameras, larger))
    torch.testing.assert_close(enlarged, 3 * pixels)


def test_the_cameras_stand_around_the_object_and_see_its_centre() -> None:
    cameras = orbit(20, 5)
    pixels, depth = project(cameras, torch.tensor([0.0, 0.0, DISTANCE]).expand(1, 5, 1, 3))
    torch.testing.assert_close(pixels, torch.full((1, 5, 1, 2), 10.0))
    torch.testing.assert_close(depth, depth[:, :1].expand(1, 5, 1))
    assert torch.pdist(cameras.centers[0]).min() > 1


COUNT, VIEWS, WIDTH, HEIGHT = 7, 2, 40, 30
Arrays = dict[str, Any]  # of numpy


@pytest.fixture
def arrays() -> Arrays:
    """With the types of gsplat's file."""
    random = np.random.default_rng(0)
    return {
        "means3d": random.normal(size=(COUNT, 3)).astype(np.float32),
        "colors": random.integers(0, 256, (COUNT, 3), dtype=np.uint8),
        "viewmats": random.normal(size=(VIEWS, 4, 4)).astype(np.float32),
        "Ks": random.normal(size=(VIEWS, 3, 3)).astype(np.float32),
        "width": np.array(WIDTH),
        "height": np.array(HEIGHT),
    }


@pytest.fixture
def others() -> Arrays:
    """What gsplat's file lacks; in float64, as numpy makes it."""
    random = np.random.default_rng(1)
    return {
        "quats": random.normal(size=(COUNT, 4)),
        "scales": random.uniform(0.01, 0.1, (COUNT, 3)),
        "opacities": random.uniform(size=COUNT),
    }


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scene.npz"


def assert_refused(path: Path, said: str) -> None:
    with pytest.raises(DataError) as error:
        read_scene(path)
    assert str(path) in str(error.value)
    assert said in str(error.value)


def test_values_arrive_and_what_is_missing_is_named(path: Path, arrays: Arrays) -> None:
    np.savez(path, **arrays)
    gaussians, cameras, missing = read_scene(path)
    assert missing == ["quats", "scales", "opacities"]
    assert torch.equal(gaussians.means[0], torch.from_numpy(arrays["means3d"]))
    torch.testing.assert_close(gaussians.colors[0] * 255, torch.from_numpy(arrays["colors"]).float())
    assert torch.equal(cameras.world_to_camera[0], torch.from_numpy(arrays["viewmats"]))
    assert torch.equal(cameras.intrinsics[0], torch.from_numpy(arrays["Ks"]))
    assert cameras.image_size == (HEIGHT, WIDTH)
    assert torch.equal(gaussians.quaternions, torch.tensor(DEFAULTS["quats"]).expand(1, COUNT, 4))
    assert torch.equal(gaussians.scales, torch.tensor(DEFAULTS["scales"]).expand(1, COUNT, 3))
    assert torch.equal(gaussians.opacities, torch.full((1, COUNT), DEFAULTS["opacities"]))


def test_defaults_stand_in_for_nothing_that_is_given(path: Path, arrays: Arrays, others: Arrays) -> None:
    colors = np.random.default_rng(2).uniform(size=(COUNT, 3)).astype(np.float32)
    np.savez_compressed(path, **(arrays | others | {"colors": colors, "something": np.zeros(2)}))
    gaussians, _, missing = read_scene(path)
    assert missing == []
    assert torch.equal(gaussians.colors[0], torch.from_numpy(colors))  # floats are taken as they are
    for name, field in (("quats", "quaternions"), ("scales", "scales"), ("opacities", "opacities")):
        assert torch.equal(getattr(gaussians, field)[0], torch.from_numpy(others[name]).float()), name
        np.savez(path, **arrays, **{name: others[name]})
        assert read_scene(path)[2] == [other for other in others if other != name]


ONES = partial(np.ones, dtype=np.float32)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        *(({name: None}, f"lacks {name}") for name in NEEDED),
        ({"means3d": ONES((COUNT, 2))}, f"means3d should hold numbers in the shape [{COUNT}, 3], not"),
        ({"colors": ONES((COUNT + 1, 3))}, "colors should hold numbers"),
        ({"viewmats": ONES((4, 4))}, "viewmats should hold numbers"),
        ({"height": ONES((1,))}, "height should hold numbers"),
        ({"opacities": ONES((COUNT, 1))}, "opacities should hold numbers"),
        ({"means3d": ONES((0, 3)), "colors": ONES((0, 3))}, "means3d should hold numbers in the shape [0, "),
        ({"viewmats": ONES((0, 4, 4)), "Ks": ONES((0, 3, 3))}, "viewmats should hold numbers in the shape [0, "),
        ({"Ks": np.ones((VIEWS, 3, 3), complex)}, "Ks should hold numbers"),
        *(({"width": np.array(width)}, f"an image of {width:g} x {HEIGHT} pixels") for width in (0, 2.5, np.nan)),
    ],
)
def test_what_a_scene_cannot_be_made_of_is_refused_by_name(path, arrays: Arrays, changes: Arrays, said: str) -> None:
    np.savez(path, **{name: value for name, value in (arrays | changes).items() if value is not None})
    assert_refused(path, said)


def test_what_is_no_file_of_plain_arrays_is_refused_and_no_pickle_loaded(path, arrays: Arrays, tmp_path: Path) -> None:
    canary = tmp_path / "canary"

    class Touch:
        def __reduce__(self):
            return Path.touch, (canary,)

    assert_refused(path, "no such file")
    objects = np.empty(COUNT, object)
    objects[:] = [Touch() for _ in range(COUNT)]
    np.savez(path, **arrays, opacities=objects)
    assert_refused(path, "not an .npz file of plain arrays")
    assert not canary.exists()
    np.savez_compressed(path, **arrays)
    content = path.read_bytes()
    for damaged in (content[: len(content) * 2 // 3], b"", b"solid\n" * 99):
        path.write_bytes(damaged)
        assert_refused(path, "not an .npz file of plain arrays")


needs_proc = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the system has no /proc")
FLOATS = 60 * 2**20 // 4  # 60 MB


def test_gradients_of_all_images_are_taken_for_all_parameters() -> None:
    given: list[Gaussians] = []

    def rasterizer(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        given.append(gaussians)
        return ReferenceRasterizer()(gaussians, cameras)

    gaussians, cameras = splatter_scene(6, 2, "trained")
    milliseconds(rasterizer, gaussians, cameras)
    ones = [torch.ones_like(image) for image in vars(ReferenceRasterizer()(gaussians, cameras)).values()]
    _, gradients = render_with_gradients(ReferenceRasterizer(), gaussians, cameras, ones)
    for name, tensor in vars(given[0]).items():
        assert tensor.grad.any(), name
        torch.testing.assert_close(tensor.grad, gradients[name])
    assert not any(tensor.requires_grad for tensor in vars(gaussians).values())


def test_the_first_figure_is_the_forward_pass_and_the_second_both(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(workloads, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    def passes(seconds: float) -> None:
        now[0] += seconds

    def rasterizer(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        passes(2.0)
        color = gaussians.opacities.mean().expand(1, 1, 3, *cameras.image_size)
        color.register_hook(lambda _: passes(3.0))
        return Rendering(color, color[:, :, :1], color[:, :, :1])

    assert milliseconds(rasterizer, *splatter_scene(4, 1, "initial")) == (2000.0, 5000.0)


@needs_proc
def test_the_peak_is_what_work_adds_whether_it_keeps_it_or_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory that the kernels would use again counts each time."""
    kept = [np.ones(FLOATS, np.float32)]  # what was there before does not count
    assert peak_megabytes(lambda: None, "cpu") < 5

    readings, read = [], Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda self: readings.append(self) or read(self))

    def give_back() -> None:
        array = np.ones(FLOATS, np.float32)
        before = len(readings)
        assert waited_for(lambda: len(readings) > before + 1)  # the first of them has ended
        del array

    def take_from_the_kernels() -> None:
        drawing.Buffers().empty((FLOATS,)).fill(1)

    assert 50 < peak_megabytes(give_back, "cpu") < 70
    assert all(peak_megabytes(take_from_the_kernels, "cpu") > 50 for _ in range(2))
    monkeypatch.setattr(workloads, "SAMPLING_SECONDS", 1e3)
    assert 50 < peak_megabytes(lambda: kept.append(np.ones(FLOATS, np.float32)), "cpu") < 70


def test_without_proc_the_work_is_done_and_memory_unknown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An error in the work comes through and leaves no thread."""
    before = threading.active_count()
    with pytest.raises(ZeroDivisionError):
        peak_megabytes(lambda: 1 / 0, "cpu")
    assert threading.active_count() == before
    monkeypatch.setattr(workloads, "Path", lambda _: tmp_path / "statm")
    done = []
    assert peak_megabytes(lambda: done.append(1), "cpu") is None
    assert done == [1]
