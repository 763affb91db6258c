import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from completesplat.data.toy import write_rooms
from completesplat.errors import DataError

FRAMES = 4
SPLITS = {"train": ["room00001", "room00002"], "test": ["room00000"]}


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("rooms")
    return write_rooms(root, scenes=3, frames=FRAMES, size=18, seed=0, workers=1, progress=False)


def read_text(path: Path) -> tuple[str, list[int], np.ndarray]:
    url, *lines = path.read_text().splitlines()
    columns = [line.split() for line in lines]
    return url, [int(row[0]) for row in columns], np.array([[float(number) for number in row[1:]] for row in columns])


def test_the_folder_says_what_was_made_and_something_else_is_left_alone(rooms, tmp_path):
    description = json.loads((rooms / "toy.json").read_text())
    assert description == {"format": 3, "scenes": 3, "frames": FRAMES, "size": 18, "seed": 0}
    (tmp_path / "toy_rooms").mkdir()
    (tmp_path / "toy_rooms" / "mine.txt").write_text("mine")
    settings = {"scenes": 2, "frames": 2, "size": 8, "seed": 0, "workers": 1, "progress": False}
    with pytest.raises(DataError, match="choose another folder"):
        write_rooms(tmp_path, **settings)
    assert [path.name for path in (tmp_path / "toy_rooms").iterdir()] == ["mine.txt"]
    for name, small in (("scenes", 1), ("frames", 1), ("size", 7)):
        with pytest.raises(DataError, match=name):
            write_rooms(tmp_path / "small", **{**settings, name: small})


@pytest.mark.parametrize("split", SPLITS)
def test_the_clips_are_as_published(rooms, split):
    folder, keys = rooms / "text" / split, SPLITS[split]
    assert sorted(path.name for path in folder.iterdir()) == sorted([*keys, *(f"{key}.txt" for key in keys)])
    for key in keys:
        url, times, cameras = read_text(folder / f"{key}.txt")
        assert url == f"https://example.com/toy/{key}"
        assert np.abs(np.diff(times) - 1e6 / 30).max() <= 1
        assert cameras.shape == (FRAMES, 18)
        assert not cameras[:, 4:6].any()
        rotation = cameras[:, 6:].reshape(-1, 3, 4)[:, :, :3]
        assert np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max() < 1e-6
        assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-6)
        assert sorted(int(path.stem) for path in (folder / key).iterdir()) == times
        for path in (folder / key).iterdir():
            with Image.open(path) as image:
                assert (image.size, image.format) == ((32, 18), "JPEG")
