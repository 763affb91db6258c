"""Reading a scene in the layout of gsplat's `assets/test_garden.npz`, and what is refused."""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from completesplat.benchmarks.workloads import (
    DEFAULTS,
    NEEDED,
    read_scene,
)
from completesplat.errors import DataError

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


def refusal(path: Path) -> str:
    with pytest.raises(DataError) as error:
        read_scene(path)
    assert str(path) in str(error.value)
    return str(error.value)


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


@pytest.mark.parametrize("kept", ["quats", "scales", "opacities"])
def test_each_default_stands_alone(path: Path, arrays: Arrays, others: Arrays, kept: str) -> None:
    np.savez(path, **arrays, **{kept: others[kept]})
    assert read_scene(path)[2] == [name for name in others if name != kept]


def test_a_missing_file_is_refused(path: Path) -> None:
    assert refusal(path) == f"{path}: no such file"


@pytest.mark.parametrize("name", NEEDED)
def test_a_missing_array_is_refused_by_name(path: Path, arrays: Arrays, name: str) -> None:
    np.savez(path, **{key: value for key, value in arrays.items() if key != name})
    assert refusal(path).endswith(f"lacks {name}")


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means3d", (COUNT, 2)),
        ("means3d", (3,)),
        ("means3d", ()),
        ("colors", (COUNT + 1, 3)),
        ("colors", (COUNT, 4)),
        ("viewmats", (4, 4)),
        ("viewmats", (VIEWS, 3, 4)),
        ("Ks", (VIEWS + 1, 3, 3)),
        ("width", (2,)),
        ("height", (1,)),
        ("quats", (COUNT, 3)),
        ("scales", (COUNT,)),
        ("opacities", (COUNT, 1)),
    ],
)
def test_a_wrong_shape_is_refused_by_name(path: Path, arrays: Arrays, name: str, shape: tuple[int, ...]) -> None:
    np.savez(path, **(arrays | {name: np.ones(shape, np.float32)}))
    said = refusal(path)
    assert f"{name} should hold numbers in the shape" in said
    assert said.endswith(f"in the shape {list(shape)}")


@pytest.mark.parametrize("names", [("means3d", "colors"), ("viewmats", "Ks")])
def test_a_scene_without_gaussians_or_without_views_is_refused(
    path: Path, arrays: Arrays, names: tuple[str, str]
) -> None:
    np.savez(path, **(arrays | {name: arrays[name][:0] for name in names}))
    assert f"{names[0]} should hold numbers in the shape [0, " in refusal(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means3d", np.full((COUNT, 3), "1.0")),
        ("colors", np.full((COUNT, 3), b"1")),
        ("Ks", np.ones((VIEWS, 3, 3), complex)),
        ("width", np.array("40")),
    ],
)
def test_what_is_no_number_is_refused_by_name(path: Path, arrays: Arrays, name: str, value: np.ndarray) -> None:
    np.savez(path, **(arrays | {name: value}))
    assert f"{name} should hold numbers" in refusal(path)


@pytest.mark.parametrize("width", [0, -3, 2.5, np.nan, np.inf])
def test_an_image_that_cannot_be_is_refused(path: Path, arrays: Arrays, width: float) -> None:
    np.savez(path, **(arrays | {"width": np.array(width)}))
    assert f"an image of {width:g} x {HEIGHT} pixels" in refusal(path)


def test_pickled_objects_are_refused_and_not_loaded(path: Path, arrays: Arrays, tmp_path: Path) -> None:
    canary = tmp_path / "canary"

    class Touch:
        def __reduce__(self):
            return Path.touch, (canary,)

    objects = np.empty(COUNT, object)
    objects[:] = [Touch() for _ in range(COUNT)]
    np.savez(path, **arrays, opacities=objects)
    assert "not an .npz file of plain arrays" in refusal(path)
    assert not canary.exists()


def cut(content: bytes) -> bytes:
    return content[: len(content) * 2 // 3]


def garble(content: bytes) -> bytes:
    """Other bytes in the middle of the first array's data."""
    return content[:60] + bytes(byte ^ 0xFF for byte in content[60:160]) + content[160:]


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("damage", [cut, garble, lambda _: b"", lambda _: b"PK\3\4", lambda _: b"solid\n" * 99])
def test_a_damaged_file_is_refused(
    path: Path, arrays: Arrays, save: Callable[..., None], damage: Callable[[bytes], bytes]
) -> None:
    save(path, **arrays)
    path.write_bytes(damage(path.read_bytes()))
    assert "not an .npz file of plain arrays" in refusal(path)


def test_a_file_of_one_array_is_refused(path: Path, arrays: Arrays) -> None:
    with path.open("wb") as file:
        np.save(file, arrays["means3d"])
    assert "not an .npz file of plain arrays" in refusal(path)


def test_a_folder_is_refused(path: Path) -> None:
    path.mkdir()
    assert "not an .npz file of plain arrays" in refusal(path)


def test_a_zip_of_something_else_is_refused(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as file:
        for name in NEEDED:
            file.writestr(name, b"text")
    assert "should hold numbers" in refusal(path)
