"""Random toy rooms: size, colours, furniture, and the path of the camera."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from completesplat.data.toy.raytracing import trace
from completesplat.data.toy.shapes import (
    BOX,
    CHECKS,
    ELLIPSOID,
    PLAIN,
    RIPPLES,
    STRIPES,
    Array,
    Look,
    Part,
    Shapes,
    as_arrays,
    camera_rays,
    color,
    make_part,
    rotation_about,
)
from completesplat.data.toy.surroundings import CEILING, FLOOR, WALLS, Light, Room
from completesplat.geometry.cameras import invert_rigid, look_at

UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
GAP = 0.05
ATTEMPTS = 100


Piece = list[Part]


def _look(rng: np.random.Generator) -> Look:
    hue = rng.uniform()
    saturation = rng.uniform(0.2, 0.8)
    first = color(hue, saturation, rng.uniform(0.6, 0.95))
    second = color(hue + rng.uniform(-0.08, 0.08), saturation, rng.uniform(0.3, 0.55))
    pattern = rng.choice([PLAIN, STRIPES, CHECKS, RIPPLES])
    return np.stack([first, second]), np.array([pattern, rng.uniform(10, 22), rng.uniform(0, 2 * np.pi)])


def cabinet(rng: np.random.Generator) -> Piece:
    """Draw one box, from a chest to a wardrobe."""
    half = (rng.uniform(0.3, 0.6), rng.uniform(0.3, 1.0), rng.uniform(0.18, 0.3))
    return [make_part(BOX, (0, half[1], 0), half, _look(rng))]


def table(rng: np.random.Generator) -> Piece:
    """Draw a slab on four legs."""
    wide = rng.uniform(0.4, 0.7)
    deep = rng.uniform(0.3, 0.45)
    top = rng.uniform(0.45, 0.75)
    look = _look(rng)
    leg = _look(rng)
    legs = [
        make_part(BOX, (x * (wide - 0.06), top / 2, z * (deep - 0.06)), (0.035, top / 2, 0.035), leg)
        for x in (-1, 1)
        for z in (-1, 1)
    ]
    return [make_part(BOX, (0, top, 0), (wide, 0.03, deep), look), *legs]


def sofa(rng: np.random.Generator) -> Piece:
    """Draw a seat, a back and two arms."""
    wide = rng.uniform(0.5, 0.9)
    deep = rng.uniform(0.35, 0.45)
    seat = rng.uniform(0.18, 0.23)
    look = _look(rng)
    back = rng.uniform(0.35, 0.45)
    arms = [make_part(BOX, (x * (wide - 0.08), seat + 0.1, 0), (0.08, seat + 0.1, deep), look) for x in (-1, 1)]
    rest = make_part(BOX, (0, back, 0.09 - deep), (wide - 0.16, back, 0.09), look)
    return [make_part(BOX, (0, seat, 0), (wide - 0.16, seat, deep), look), rest, *arms]


def pouf(rng: np.random.Generator) -> Piece:
    """Draw one ellipsoid."""
    half = (rng.uniform(0.2, 0.4), rng.uniform(0.18, 0.3), rng.uniform(0.2, 0.4))
    return [make_part(ELLIPSOID, (0, half[1], 0), half, _look(rng))]


def lamp(rng: np.random.Generator) -> Piece:
    """Draw a foot, a pole and an ellipsoid on top."""
    top = rng.uniform(1.0, 1.4)
    shade = (rng.uniform(0.15, 0.25), rng.uniform(0.12, 0.2), rng.uniform(0.15, 0.25))
    look = _look(rng)
    foot = make_part(BOX, (0, 0.03, 0), (0.15, 0.03, 0.15), look)
    pole = make_part(BOX, (0, top / 2, 0), (0.02, top / 2, 0.02), look)
    return [foot, pole, make_part(ELLIPSOID, (0, top + shade[1], 0), shade, _look(rng))]


PIECES = (cabinet, table, sofa, pouf, lamp)


def furnish(rng: np.random.Generator, size: Array) -> list[Piece]:
    """Draw 3 to 6 pieces (fewer if there is no space) that do not overlap, most of them along the walls."""
    count = int(rng.integers(3, 7))
    pieces: list[Piece] = []
    for _ in range(ATTEMPTS):
        piece = _placed(rng, PIECES[rng.integers(len(PIECES))](rng), size)
        low, high = _ground_extent(piece)
        inside = (np.abs(np.stack([low, high])) <= size[[0, 2]] / 2 - GAP + 1e-9).all()
        placed = map(_ground_extent, pieces)
        if inside and not any((low < end + GAP).all() and (start < high + GAP).all() for start, end in placed):
            pieces.append(piece)
        if len(pieces) == count:
            break
    return pieces


def _ground_extent(piece: Piece) -> tuple[Array, Array]:
    """Return lower and upper corner (x, z) of the bounding rectangle of the projection on the ground."""
    centers = np.array([part.center for part in piece])
    reaches = np.array([np.abs(part.axes) @ part.half_sizes for part in piece])
    return (centers - reaches).min(axis=0)[[0, 2]], (centers + reaches).max(axis=0)[[0, 2]]


def _placed(rng: np.random.Generator, piece: Piece, size: Array) -> Piece:
    """Place a piece with its back to a wall (in four of five cases) or anywhere, without regard to other pieces."""
    along_wall = rng.uniform() < 0.8
    yaw = float(rng.integers(4) * np.pi / 2) if along_wall else float(rng.uniform(0, 2 * np.pi))
    rotation = rotation_about("y", yaw)
    turned = [solid.moved(rotation, np.zeros(3)) for solid in piece]
    low, high = _ground_extent(turned)
    free = size[[0, 2]] / 2 - GAP
    shift = rng.uniform(-free - low, free - high)
    if along_wall:
        back = rotation[[0, 2], 2] * -1
        axis = int(np.abs(back).argmax())
        shift[axis] = free[axis] - high[axis] if back[axis] > 0 else -free[axis] - low[axis]
    return [solid.moved(np.eye(3), np.array([shift[0], 0.0, shift[1]])) for solid in turned]


MARGIN = 0.3
LOWEST = 1.0
HIGHEST = 1.7
# Range of the camera's step from frame to frame, as in a video with 30 frames a second, taken at a slow walk.
STEPS = (0.012, 0.032)
LARGEST_TURN = np.radians(3.0)
WAYPOINTS = 4
FIELD_OF_VIEW = (55, 75)


class CameraMove(NamedTuple):
    """Poses in the room ([frame 4 4], OpenCV axes), the lens, and the transform to the world of the files.

    `focal` is in image widths, `principal_point` (x, y) in image widths and heights. A point of the room has the world
    coordinates `unit` * `rotation` @ point + `origin`; as in RealEstate10K, the world's +y points down.
    """

    camera_to_room: Array
    focal: float
    principal_point: Array
    unit: float
    rotation: Array
    origin: Array

    def intrinsics(self, height: int, width: int) -> Array:
        """Return fx, fy, cx, cy as fractions of width, height, width, height, for square pixels."""
        return np.array([self.focal, self.focal * width / height, *self.principal_point])

    def world_to_camera(self) -> Array:
        """Return poses [frame 3 4] in the world and its unit."""
        rotation = np.swapaxes(self.camera_to_room[:, :3, :3], 1, 2) @ self.rotation.T
        centers = self.unit * self.camera_to_room[:, :3, 3] @ self.rotation.T + self.origin
        return np.concatenate([rotation, -rotation @ centers[:, :, None]], axis=2)


def image_width(height: int) -> int:
    """Return the even number nearest to 16 / 9 of the height."""
    return 2 * round(height * (16 / 9) / 2)


def draw_move(rng: np.random.Generator, frames: int, size: Array, furniture: Sequence[Part]) -> CameraMove:
    """Draw a walk through the free space of a room, MARGIN away from everything."""
    centers, tangents = _path(rng, frames, size, furniture)
    yaw = np.unwrap(np.arctan2(tangents[:, 0], tangents[:, 2])) + rng.normal(0, 0.2)
    swing = 2 * np.pi * (np.linspace(0, rng.uniform(0.2, 1.0), frames) + rng.uniform())
    pitch = np.radians(rng.uniform(-16, -2) + 2 * np.sin(swing))
    forward = np.stack([np.cos(pitch) * np.sin(yaw), np.sin(pitch), np.cos(pitch) * np.cos(yaw)], axis=1)
    room_to_camera = look_at(torch.from_numpy(centers), torch.from_numpy(centers + forward), UP)
    return CameraMove(
        camera_to_room=invert_rigid(room_to_camera).numpy(),
        focal=float(0.5 / np.tan(np.radians(rng.uniform(*FIELD_OF_VIEW)) / 2)),
        principal_point=0.5 + (rng.uniform(-0.03, 0.03, 2) if rng.uniform() < 0.25 else np.zeros(2)),
        unit=float(rng.uniform(0.5, 2.0)),
        rotation=rotation_about("y", rng.uniform(0, 2 * np.pi)) @ rotation_about("x", np.pi),
        origin=rng.normal(size=3),
    )


def _path(rng: np.random.Generator, frames: int, size: Array, furniture: Sequence[Part]) -> tuple[Array, Array]:
    """Draw positions [frame 3] at equal steps along a cubic through random waypoints, and their tangents [frame 3].

    A path that comes too near to something or turns too fast is drawn again and shorter, until one is free.
    """
    stride = 1.2
    step = rng.uniform(*STEPS)
    while True:
        waypoints = _waypoints(rng, size, stride)
        parameters = np.linspace(0, 1, WAYPOINTS)
        cubic = np.polynomial.polynomial.polyfit(parameters, waypoints, WAYPOINTS - 1)
        dense = np.linspace(0, 1, 400)
        points = np.polynomial.polynomial.polyval(dense, cubic).T
        lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        reached = np.linspace(0, min(step * (frames - 1), lengths[-1]), frames)
        times = np.interp(reached, lengths, dense)
        centers = np.polynomial.polynomial.polyval(times, cubic).T
        slopes = np.polynomial.polynomial.polyval(times, np.polynomial.polynomial.polyder(cubic)).T
        yaw = np.unwrap(np.arctan2(slopes[:, 0], slopes[:, 2]))
        if _is_free(centers, size, furniture) and np.abs(np.diff(yaw)).max() < LARGEST_TURN:
            return np.ascontiguousarray(centers), slopes
        stride *= 0.99


def _waypoints(rng: np.random.Generator, size: Array, stride: float) -> Array:
    """Draw waypoints [waypoint 3] about `stride` apart, first towards the middle, then with turns up to 60 degrees."""
    start = rng.uniform(-0.5, 0.5, 2) * (size[[0, 2]] - 2 * MARGIN)
    first = np.arctan2(-start[0], -start[1]) + rng.uniform(-np.pi / 4, np.pi / 4)
    heading = np.cumsum(np.append(first, rng.uniform(-np.pi / 3, np.pi / 3, WAYPOINTS - 2)))
    steps = stride * rng.uniform(0.7, 1.3, WAYPOINTS - 1)
    moves = steps[:, None] * np.stack([np.sin(heading), np.cos(heading)], axis=1)
    x, z = np.cumsum(np.stack([start, *moves]), axis=0).T
    heights = rng.uniform(1.1, 1.6) + rng.normal(0, 0.05, WAYPOINTS)
    return np.stack([x, heights, z], axis=1)


def _is_free(centers: Array, size: Array, furniture: Sequence[Part]) -> bool:
    inside = np.abs(centers[:, [0, 2]]) <= size[[0, 2]] / 2 - MARGIN
    high = (centers[:, 1] >= LOWEST) & (centers[:, 1] <= HIGHEST)
    return bool(inside.all() and high.all() and all((s.distances(centers) >= MARGIN).all() for s in furniture))


class RoomScene(NamedTuple):
    """Room and the camera that moves through it."""

    room: Room
    furniture: tuple[Part, ...]
    shapes: Shapes
    light: Light
    move: CameraMove


def draw_room_scene(rng: np.random.Generator, frames: int) -> RoomScene:
    """Draw a random room and a path with `frames` camera positions."""
    size = np.array([rng.uniform(3.5, 4.6), rng.uniform(2.4, 2.9), rng.uniform(4.3, 5.6)])
    furniture = tuple(part for piece in furnish(rng, size) for part in piece)
    colors, textures = _faces(rng)
    # Each wall has one decal: there is a window, a door, a picture, and one more picture or window.
    kinds = rng.permutation(["window", "door", "picture", str(rng.choice(["window", "picture"]))])
    decals = [_decal(rng, wall, kind, size) for wall, kind in zip(WALLS, kinds, strict=True)]
    room = Room(size, colors, textures, *(np.stack(parts) for parts in zip(*decals, strict=True)))
    lamp = size * np.array([rng.uniform(-0.3, 0.3), 0.93, rng.uniform(-0.3, 0.3)])
    light = Light(lamp, is_point=True, ambient=float(rng.uniform(0.55, 0.7)), sky=0.15, shadow=0.45)
    return RoomScene(room, furniture, as_arrays(furniture), light, draw_move(rng, frames, size, furniture))


def render_room_frame(scene: RoomScene, frame: int, height: int, width: int) -> tuple[Array, Array]:
    """Render the image [height width 3] and the depth [height width], along the optical axis in the room's units."""
    rays = camera_rays(*scene.move.intrinsics(height, width) * np.array([width, height, width, height]), height, width)
    colors, _, depth = trace(scene.shapes, scene.light, scene.room, scene.move.camera_to_room[frame], rays)
    return colors.reshape(height, width, 3), depth.reshape(height, width)


def _faces(rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw colours [face 2 3] and textures [face 3]: walls of related hues, a darker floor, a bright ceiling."""
    hue = rng.uniform()
    colors = np.zeros((6, 2, 3))
    textures = np.zeros((6, 3))
    for face in range(6):
        face_hue = hue + rng.uniform(-0.15, 0.15)
        value = {FLOOR: 0.7, CEILING: 1.0}.get(face, 0.92)
        saturation = {FLOOR: 0.5, CEILING: 0.06}.get(face, 0.25) * rng.uniform(0.6, 1.4)
        darker = 0.93 if face == CEILING else rng.uniform(0.6, 0.8)
        colors[face] = color(face_hue, saturation, value), color(face_hue + 0.05, 1.3 * saturation, darker * value)
        pattern = rng.choice([STRIPES, CHECKS] if face in (FLOOR, CEILING) else [STRIPES, CHECKS, RIPPLES])
        textures[face] = pattern, rng.uniform(6, 13), rng.uniform(0, 2 * np.pi)
    return colors, textures


def _decal(rng: np.random.Generator, wall: int, kind: str, size: Array) -> tuple[Array, Array, Array]:
    """Draw place [6], colours [3 3] and texture [3] of a rectangle on a wall."""
    half_width, low, high = {
        "window": (rng.uniform(0.4, 0.8), rng.uniform(0.8, 1.0), rng.uniform(1.8, 2.2)),
        "door": (rng.uniform(0.4, 0.5), 0.0, rng.uniform(1.9, 2.1)),
        "picture": (rng.uniform(0.2, 0.5), rng.uniform(1.0, 1.3), rng.uniform(1.6, 2.0)),
    }[kind]
    room_for_it = size[2 if wall < 2 else 0] / 2 - half_width - 0.1
    middle = rng.uniform(-room_for_it, room_for_it)
    hue = rng.uniform()
    rim, first, second = {
        "window": (np.full(3, 0.97), color(0.57, 0.35, 1.0), color(0.55, 0.1, 1.0)),
        "door": (np.full(3, 0.3), color(0.08, 0.6, rng.uniform(0.4, 0.8)), color(0.08, 0.6, 0.4)),
        "picture": (color(hue + 0.5, 0.5, 0.25), color(hue, 0.8, 0.95), color(hue + rng.uniform(0.2, 0.8), 0.8, 0.8)),
    }[kind]
    pattern = {"window": RIPPLES, "door": PLAIN, "picture": rng.choice([STRIPES, CHECKS, RIPPLES])}[kind]
    place = np.array([wall, middle - half_width, middle + half_width, low, high, 0.05])
    return place, np.stack([rim, first, second]), np.array([pattern, rng.uniform(4, 14), rng.uniform(0, 2 * np.pi)])
