"""Furniture for toy rooms: pieces made of boxes and ellipsoids that stand on the floor, their backs towards -z."""

from dataclasses import dataclass, replace

import numpy as np

from completesplat.data.toy.ingredients import Array
from completesplat.data.toy.room_ingredients import BALL, BOX, PLAIN, RIPPLES, STRIPES, TILES
from completesplat.data.toy.shapes import color, rotation_about

GAP = 0.05
ATTEMPTS = 100


@dataclass(frozen=True)
class Solid:
    """One box or ellipsoid: its centre, half sizes, turn about the vertical, its look."""

    kind: int
    center: Array
    half_sizes: Array
    yaw: float
    colors: Array
    texture: Array

    def to_local(self) -> Array:
        """[3 4] map from the room's frame to the unit shape's."""
        linear = rotation_about("y", self.yaw).T / self.half_sizes[:, None]
        return np.concatenate([linear, -linear @ self.center[:, None]], axis=1)

    def bounding_ball(self) -> Array:
        """Centre and squared radius [4]."""
        return np.append(self.center, (self.half_sizes**2).sum())

    def distances(self, points: Array) -> Array:
        """How far the points [n 3] are from the (bounding) box; 0 inside."""
        outside = np.abs((points - self.center) @ rotation_about("y", self.yaw)) - self.half_sizes
        return np.linalg.norm(outside.clip(0), axis=-1)

    def ground_extent(self) -> tuple[Array, Array]:
        """Lower and upper corner (x, z) of the rectangle that its shadow at noon lies in."""
        reach = np.abs(rotation_about("y", self.yaw)) @ self.half_sizes
        return (self.center - reach)[[0, 2]], (self.center + reach)[[0, 2]]

    def moved(self, yaw: float, shift: Array) -> "Solid":
        """After a turn about the vertical axis through the origin, then a shift."""
        return replace(self, center=rotation_about("y", yaw) @ self.center + shift, yaw=self.yaw + yaw)


Piece = list[Solid]
Look = tuple[Array, Array]


def _look(rng: np.random.Generator) -> Look:
    hue, saturation = rng.uniform(), rng.uniform(0.2, 0.8)
    first = color(hue, saturation, rng.uniform(0.6, 0.95))
    second = color(hue + rng.uniform(-0.08, 0.08), saturation, rng.uniform(0.3, 0.55))
    pattern = rng.choice([PLAIN, STRIPES, TILES, RIPPLES])
    return np.stack([first, second]), np.array([pattern, rng.uniform(10, 22), rng.uniform(0, 2 * np.pi)])


def _solid(kind: int, center: tuple[float, float, float], half: tuple[float, float, float], look: Look) -> Solid:
    return Solid(kind, np.array(center, dtype=np.float64), np.array(half, dtype=np.float64), 0.0, *look)


def cabinet(rng: np.random.Generator) -> Piece:
    """One box, from a chest to a wardrobe."""
    half = (rng.uniform(0.3, 0.6), rng.uniform(0.3, 1.0), rng.uniform(0.18, 0.3))
    return [_solid(BOX, (0, half[1], 0), half, _look(rng))]


def table(rng: np.random.Generator) -> Piece:
    """A slab on four legs."""
    wide, deep, top = rng.uniform(0.4, 0.7), rng.uniform(0.3, 0.45), rng.uniform(0.45, 0.75)
    look, leg = _look(rng), _look(rng)
    legs = [
        _solid(BOX, (x * (wide - 0.06), top / 2, z * (deep - 0.06)), (0.035, top / 2, 0.035), leg)
        for x in (-1, 1)
        for z in (-1, 1)
    ]
    return [_solid(BOX, (0, top, 0), (wide, 0.03, deep), look), *legs]


def sofa(rng: np.random.Generator) -> Piece:
    """A seat, a back and two arms."""
    wide, deep, seat = rng.uniform(0.5, 0.9), rng.uniform(0.35, 0.45), rng.uniform(0.18, 0.23)
    look, back = _look(rng), rng.uniform(0.35, 0.45)
    arms = [_solid(BOX, (x * (wide - 0.08), seat + 0.1, 0), (0.08, seat + 0.1, deep), look) for x in (-1, 1)]
    rest = _solid(BOX, (0, back, 0.09 - deep), (wide - 0.16, back, 0.09), look)
    return [_solid(BOX, (0, seat, 0), (wide - 0.16, seat, deep), look), rest, *arms]


def pouf(rng: np.random.Generator) -> Piece:
    """An ellipsoid."""
    half = (rng.uniform(0.2, 0.4), rng.uniform(0.18, 0.3), rng.uniform(0.2, 0.4))
    return [_solid(BALL, (0, half[1], 0), half, _look(rng))]


def lamp(rng: np.random.Generator) -> Piece:
    """A foot, a pole and an ellipsoid on top."""
    top, shade = rng.uniform(1.0, 1.4), (rng.uniform(0.15, 0.25), rng.uniform(0.12, 0.2), rng.uniform(0.15, 0.25))
    look = _look(rng)
    foot = [
        _solid(BOX, (0, 0.03, 0), (0.15, 0.03, 0.15), look),
        _solid(BOX, (0, top / 2, 0), (0.02, top / 2, 0.02), look),
    ]
    return [*foot, _solid(BALL, (0, top + shade[1], 0), shade, _look(rng))]


PIECES = (cabinet, table, sofa, pouf, lamp)


def furnish(rng: np.random.Generator, size: Array) -> list[Piece]:
    """3 to 6 pieces that do not overlap, most of them along the walls."""
    count = int(rng.integers(3, 7))
    taken: list[tuple[Array, Array]] = []
    pieces: list[Piece] = []
    for _ in range(ATTEMPTS):
        piece = _placed(rng, PIECES[rng.integers(len(PIECES))](rng), size)
        low, high = _ground_extent(piece)
        inside = (np.abs(np.stack([low, high])) <= size[[0, 2]] / 2 - GAP + 1e-9).all()
        if inside and not any((low < other[1] + GAP).all() and (other[0] < high + GAP).all() for other in taken):
            taken.append((low, high))
            pieces.append(piece)
        if len(pieces) == count:
            break
    return pieces


def _ground_extent(piece: Piece) -> tuple[Array, Array]:
    lows, highs = zip(*(solid.ground_extent() for solid in piece), strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _placed(rng: np.random.Generator, piece: Piece, size: Array) -> Piece:
    """With the back to a wall in four cases of five, anywhere and turned freely otherwise; it may overlap others."""
    along_wall = rng.uniform() < 0.8
    yaw = float(rng.integers(4) * np.pi / 2) if along_wall else float(rng.uniform(0, 2 * np.pi))
    turned = [solid.moved(yaw, np.zeros(3)) for solid in piece]
    low, high = _ground_extent(turned)
    free = size[[0, 2]] / 2 - GAP
    shift = rng.uniform(-free - low, free - high)
    if along_wall:
        back = rotation_about("y", yaw)[[0, 2], 2] * -1
        axis = int(np.abs(back).argmax())
        shift[axis] = free[axis] - high[axis] if back[axis] > 0 else -free[axis] - low[axis]
    return [solid.moved(0.0, np.array([shift[0], 0.0, shift[1]])) for solid in turned]
