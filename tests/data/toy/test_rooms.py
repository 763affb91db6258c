import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import map_coordinates

from completesplat.data.toy import room_scene as rooms
from completesplat.data.toy import write_rooms
from completesplat.data.toy.shapes import ELLIPSOID
from completesplat.errors import DataError

FRAMES, HEIGHT = 24, 72
WIDTH = rooms.image_width(HEIGHT)


def scene(index: int, frames: int = 60):
    return rooms.draw_room_scene(np.random.default_rng([7, index]), frames)


def pinhole(row: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World points to (column, row) and depth by the 18 numbers of a line of RealEstate10K's texts."""
    matrix = row[6:].reshape(3, 4)
    x, y, z = matrix[:, :3] @ points.T + matrix[:, 3:]
    return np.stack([(row[0] * x / z + row[2]) * WIDTH, (row[1] * y / z + row[3]) * HEIGHT], axis=1), z


def at(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Bilinear samples; pixel centres lie at halves."""
    channels = image.transpose(2, 0, 1)
    return np.stack([map_coordinates(channel, (places - 0.5).T[::-1], order=1) for channel in channels], axis=-1)


def face_points(size: np.ndarray, count: int = 1500) -> np.ndarray:
    """Points on the walls, floor and ceiling, room axes."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.5, 0, -0.5], [0.5, 1, 0.5], (count, 3))
    axis, side = rng.integers(3, size=count), rng.integers(2, size=count)
    points[np.arange(count), axis] = side - np.where(axis == 1, 0.0, 0.5)
    return points * size


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    """Rooms of the seed that `scene` draws from."""
    root = tmp_path_factory.mktemp("rooms")
    return write_rooms(root, scenes=2, frames=FRAMES, size=HEIGHT, seed=7, workers=1, progress=False)


def read_text(path: Path) -> tuple[str, list[int], np.ndarray]:
    url, *lines = path.read_text().splitlines()
    columns = [line.split() for line in lines]
    return url, [int(row[0]) for row in columns], np.array([[float(number) for number in row[1:]] for row in columns])


@pytest.mark.parametrize("index", range(2))
def test_a_wall_point_has_the_same_color_in_two_frames_by_the_numbers_in_the_text(written, index):
    text, last = next(written.glob(f"text/*/room{index:05d}.txt")), FRAMES - 1
    _, times, rows = read_text(text)
    room = scene(index, FRAMES)
    points = face_points(room.room.size)
    world = room.move.unit * points @ room.move.rotation.T + room.move.origin
    seen = np.ones(len(points), dtype=bool)
    for frame in (0, last):
        places, depth = pinhole(rows[frame], world)
        seen &= (depth > 0) & (places > 1).all(axis=1) & (places < [WIDTH - 1, HEIGHT - 1]).all(axis=1)
        y, x = np.clip(places[:, ::-1].T.astype(int), 0, [[HEIGHT - 1], [WIDTH - 1]])
        nearest = rooms.render_room_frame(room, frame, HEIGHT, WIDTH)[1][y, x]
        seen &= depth / room.move.unit < 1.02 * nearest  # not behind furniture
    assert seen.sum() > 60

    def colors(frame: int, pose: int) -> np.ndarray:
        rendered = np.asarray(Image.open(text.with_suffix("") / f"{times[frame]}.jpg")) / 255
        places, _ = pinhole(rows[pose], world[seen])
        return at(rendered, np.clip(places, 1, [WIDTH - 1, HEIGHT - 1]))

    right, wrong = (np.abs(colors(0, 0) - colors(last, pose)).mean(axis=1) for pose in (last, 0))
    assert np.median(right) < 0.02
    assert np.mean(right) < 0.4 * np.mean(wrong)


def seen_points(room_scene, frame: int, height: int, width: int) -> np.ndarray:
    """Where the depth says that each pixel's centre ray ends, room axes."""
    _, depth = rooms.render_room_frame(room_scene, frame, height, width)
    fx, fy, cx, cy = room_scene.move.intrinsics(height, width)
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1) * depth[..., None]
    pose = room_scene.move.camera_to_room[frame]
    return (rays @ pose[:3, :3].T + pose[:3, 3]).reshape(-1, 3)


def moved_away(shapes):
    return shapes._replace(bounding_balls=np.tile([0.0, -9, 0, 0], (len(shapes.kinds), 1)))


def radius(solid, points: np.ndarray) -> np.ndarray:
    """1 on the surface of a solid, less inside."""
    local = points @ solid.to_local()[:, :3].T + solid.to_local()[:, 3]
    return np.linalg.norm(local, axis=-1) if solid.kind == ELLIPSOID else np.abs(local).max(axis=-1)


@pytest.mark.parametrize("index", range(2))
def test_rays_end_at_the_first_thing_they_meet(index):
    room, frame = scene(index), 20
    points, size = seen_points(room, frame, 32, 58), room.room.size
    outside = (np.abs(points - [0, size[1] / 2, 0]) - size / 2).max(axis=1)
    assert outside.max() < 1e-9
    on_face, on_solid = outside > -1e-9, np.zeros(len(points), dtype=bool)
    eye = room.move.camera_to_room[frame, :3, 3]
    way = eye + np.linspace(0, 1, 100)[:, None, None] * (points - eye)
    for solid in room.furniture:
        assert radius(solid, way).min() > 1 - 1e-9
        on_solid |= radius(solid, points) < 1 + 1e-9
    assert (on_face | on_solid).all()
    assert on_face.any()


def test_bare_white_walls_follow_lamberts_law():
    full, frame = scene(2), 59
    room, height, width = full.room, 32, 58
    white, none = np.ones_like(room.colors), np.full_like(room.decals, -1)
    bare = room._replace(textures=np.zeros_like(room.textures), colors=white, decals=none)
    empty = full._replace(room=bare, shapes=moved_away(full.shapes))
    points = seen_points(empty, frame, height, width)
    middle = points - [0, room.size[1] / 2, 0]
    face = np.abs(np.abs(middle) - room.size / 2).argmin(axis=1)
    normals = -np.sign(middle) * np.eye(3)[face]
    lamp = full.light.place - points
    cosine = (normals * lamp).sum(axis=1) / np.linalg.norm(lamp, axis=1)
    expected = full.light.ambient * (0.85 + 0.15 * normals[:, 1]) + (1 - full.light.ambient) * cosine
    rendered, _ = rooms.render_room_frame(empty, frame, height, width)
    gap = np.abs(rendered.reshape(-1, 3) - expected[:, None]).max(axis=1)
    assert np.mean(gap < 2e-3) > 0.9  # the others are pixels on the room's edges
    assert np.ptp(expected) > 0.1


def test_furniture_stands_in_the_room_and_pieces_do_not_overlap_and_most_are_seen():
    size = np.array([3.5, 2.4, 4.3])
    for index in range(5):
        rng = np.random.default_rng(index)
        pieces = rooms.furnish(rng, size)
        assert 3 <= len(pieces) <= 6
        for number, piece in enumerate(pieces):
            others = [other for rest in pieces[:number] for other in rest]
            for solid in piece:
                local = rng.uniform(-1, 1, (3, 100))
                points = np.linalg.inv(solid.to_local()[:, :3]) @ local + solid.center[:, None]
                assert (np.abs(points[[0, 2]].T) <= size[[0, 2]] / 2).all()
                assert -1e-9 <= points[1].min() < points[1].max() <= size[1]
                assert all(other.distances(points.T).min() > 0.02 for other in others)
    shares = []
    for full in map(scene, range(5)):
        empty = full._replace(shapes=moved_away(full.shapes))
        depth, behind = (rooms.render_room_frame(each, 0, 32, 58)[1] for each in (full, empty))
        assert (depth <= behind).all()
        shares.append((depth < behind).mean())
    assert sum(share > 0.02 for share in shares) >= 3


def test_rooms_differ_but_pixels_are_square_and_images_about_sixteen_by_nine():
    scenes = [scene(index, frames=2) for index in range(8)]
    assert len({tuple(room.room.size) for room in scenes}) == len({room.room.colors.tobytes() for room in scenes}) == 8
    for height in (8, 18, 65, 360):
        width = rooms.image_width(height)
        assert width % 2 == 0
        assert abs(width - height * 16 / 9) <= 1
        fx, fy, _, _ = scenes[0].move.intrinsics(height, width)
        assert fx * width == pytest.approx(fy * height)


@pytest.mark.parametrize("index", range(5))
def test_the_camera_walks_smoothly_through_free_space(index):
    room = scene(index)
    poses, half = room.move.camera_to_room, room.room.size / 2
    centers, forward = poses[:, :3, 3], poses[:, :3, 2]
    assert (np.abs(centers[:, [0, 2]]) <= half[[0, 2]] - rooms.MARGIN).all()
    assert rooms.LOWEST <= centers[:, 1].min() <= centers[:, 1].max() <= rooms.HIGHEST
    for solid in room.furniture:
        corner = np.abs(np.concatenate([centers, np.ones((60, 1))], axis=1) @ solid.to_local().T).clip(1) - 1
        assert np.linalg.norm(corner * solid.half_sizes, axis=1).min() >= rooms.MARGIN - 1e-9
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 0.04
    assert steps.max() < 1.2 * steps.min()
    turns = np.degrees(np.arccos((forward[1:] * forward[:-1]).sum(axis=1).clip(-1, 1)))
    assert turns.max() < 3.5
    assert (poses[:, 1, 1] < -0.9).all()  # the images' down is the room's down
    assert np.abs(poses[:, 1, 0]).max() < 1e-9  # and their rows are level
    along = np.diff(centers, axis=0) / steps[:, None]
    assert ((along * forward[1:]).sum(axis=1) > 0.6).all()


def test_the_folder_says_what_was_made_and_something_else_is_left_alone(written, tmp_path):
    description = json.loads((written / "toy.json").read_text())
    assert description == {"format": 3, "scenes": 2, "frames": FRAMES, "size": HEIGHT, "seed": 7}
    (tmp_path / "toy_rooms").mkdir()
    (tmp_path / "toy_rooms" / "mine.txt").write_text("mine")
    settings = {"scenes": 2, "frames": 2, "size": 8, "seed": 0, "workers": 1, "progress": False}
    with pytest.raises(DataError, match="choose another folder"):
        write_rooms(tmp_path, **settings)
    assert [path.name for path in (tmp_path / "toy_rooms").iterdir()] == ["mine.txt"]
    for name, small in (("scenes", 1), ("frames", 1), ("size", 7)):
        with pytest.raises(DataError, match=name):
            write_rooms(tmp_path / "small", **{**settings, name: small})


def test_the_clips_are_as_published(written):
    for split, key in {"test": "room00000", "train": "room00001"}.items():
        folder = written / "text" / split
        assert sorted(path.name for path in folder.iterdir()) == [key, f"{key}.txt"]
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
                assert (image.size, image.format) == ((rooms.image_width(HEIGHT), HEIGHT), "JPEG")
