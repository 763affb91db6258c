"""Draws one toy room: its size, the looks of its faces, windows, doors and pictures, furniture and a light."""

from dataclasses import dataclass

import numpy as np

from completesplat.data.toy.ingredients import Array
from completesplat.data.toy.room_camera import CameraMove, draw_move
from completesplat.data.toy.room_furniture import Solid, furnish
from completesplat.data.toy.room_ingredients import CEILING, FLOOR, PLAIN, RIPPLES, STRIPES, TILES, WALLS, Room
from completesplat.data.toy.room_raytracing import trace_room
from completesplat.data.toy.shapes import color

SAMPLES = 3

Decal = tuple[Array, Array, Array]


@dataclass(frozen=True)
class RoomScene:
    """A room and the camera that moves through it."""

    room: Room
    furniture: tuple[Solid, ...]
    move: CameraMove


def draw_room_scene(rng: np.random.Generator, frames: int) -> RoomScene:
    """A random room seen from `frames` places along a path."""
    size = np.array([rng.uniform(3.5, 4.6), rng.uniform(2.4, 2.9), rng.uniform(4.3, 5.6)])
    furniture = tuple(solid for piece in furnish(rng, size) for solid in piece)
    return RoomScene(_room(rng, size, furniture), furniture, draw_move(rng, frames, size, furniture))


def render_room_frame(scene: RoomScene, frame: int, height: int, width: int) -> tuple[Array, Array]:
    """Picture [height width 3] and depth [height width], along the optical axis in room lengths, of one frame."""
    intrinsics = scene.move.intrinsics(height, width) * np.array([width, height, width, height])
    return trace_room(scene.room, scene.move.camera_to_room[frame], intrinsics, height, width, SAMPLES)


def _room(rng: np.random.Generator, size: Array, furniture: tuple[Solid, ...]) -> Room:
    colors, textures = _faces(rng)
    decals = [_decal(rng, wall, kind, size) for wall, kind in zip(WALLS, _decal_kinds(rng), strict=True)]
    places, decal_colors, decal_textures = (np.stack(parts) for parts in zip(*decals, strict=True))
    return Room(
        size=size,
        colors=colors,
        textures=textures,
        decals=places,
        decal_colors=decal_colors,
        decal_textures=decal_textures,
        solid_kinds=np.array([solid.kind for solid in furniture]),
        to_local=np.stack([solid.to_local() for solid in furniture]),
        bounding_balls=np.stack([solid.bounding_ball() for solid in furniture]),
        solid_half_sizes=np.stack([solid.half_sizes for solid in furniture]),
        solid_colors=np.stack([solid.colors for solid in furniture]),
        solid_textures=np.stack([solid.texture for solid in furniture]),
        light=size * np.array([rng.uniform(-0.3, 0.3), 0.93, rng.uniform(-0.3, 0.3)]),
        ambient=float(rng.uniform(0.55, 0.7)),
    )


def _faces(rng: np.random.Generator) -> tuple[Array, Array]:
    """Colours [face 2 3] and textures [face 3]: related walls, a darker floor, a bright ceiling."""
    hue = rng.uniform()
    colors, textures = np.zeros((6, 2, 3)), np.zeros((6, 3))
    for face in range(6):
        own = hue + rng.uniform(-0.15, 0.15)
        value = {FLOOR: 0.7, CEILING: 1.0}.get(face, 0.92)
        saturation = {FLOOR: 0.5, CEILING: 0.06}.get(face, 0.25) * rng.uniform(0.6, 1.4)
        darker = 0.93 if face == CEILING else rng.uniform(0.6, 0.8)
        colors[face] = color(own, saturation, value), color(own + 0.05, 1.3 * saturation, darker * value)
        pattern = rng.choice([STRIPES, TILES] if face in (FLOOR, CEILING) else [STRIPES, TILES, RIPPLES])
        textures[face] = pattern, rng.uniform(6, 13), rng.uniform(0, 2 * np.pi)
    return colors, textures


def _decal_kinds(rng: np.random.Generator) -> list[str]:
    """One thing on each wall: always a window, a door and a picture, and one more picture or window."""
    return list(rng.permutation(["window", "door", "picture", str(rng.choice(["window", "picture"]))]))


def _decal(rng: np.random.Generator, wall: int, kind: str, size: Array) -> Decal:
    """Place [6], colours [3 3] and texture [3] of a rectangle on a wall."""
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
    pattern = {"window": RIPPLES, "door": PLAIN, "picture": rng.choice([STRIPES, TILES, RIPPLES])}[kind]
    place = np.array([wall, middle - half_width, middle + half_width, low, high, 0.05])
    return place, np.stack([rim, first, second]), np.array([pattern, rng.uniform(4, 14), rng.uniform(0, 2 * np.pi)])
