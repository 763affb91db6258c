"""The cameras of a sequence as drawings: from above and from the side."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor

from completesplat.data.sequences import PosedSequence
from completesplat.geometry.cameras import Cameras, unproject
from completesplat.reports.data_sets.cross import Cross, level_axes

FINE = 4  # drawn this much larger, then reduced
MARGIN = 0.08
FRUSTUM = 0.14
# A far plane is drawn up to so many times the extent of what else there is; an arrow stands for the rest.
REACH = 2.5
MOST_FRUSTA = 25
CROSS_COLORS = ((220, 30, 30), (20, 150, 20), (40, 80, 255))
FIRST, RANGE, PATH = (0, 0, 0), (170, 170, 170), (200, 200, 200)
EDGES = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (5, 6)]


@dataclass(frozen=True)
class Drawings:
    """A sequence prepared for drawing; both drawings have one scale.

    Attributes:
        axes: right, up and ahead of the first camera, level, as rows.
        frusta: [view], apex, four corners of the picture at some depth, and a tick at its upper edge.
        depth_range: the ends of the first camera's, along its axis, as far as they are drawn; `cut` if that is not far.
        middle, span: of all that is drawn, along the axes and in scene units.
    """

    axes: Float[Tensor, "3 3"]
    centers: Float[Tensor, "view 3"]
    frusta: Float[Tensor, "view 7 3"]
    depth_range: Float[Tensor, "2 3"]
    cut: bool
    cross: Cross
    middle: Float[Tensor, "3"]
    span: float

    def from_above(self, side: int) -> Image.Image:
        """A square picture: to the right is the first camera's right, ahead is up."""
        return self._draw(side, self.axes[[0, 2]], self.middle[[0, 2]])

    def from_the_side(self, side: int) -> Image.Image:
        """A square picture, seen from the first camera's right: ahead is to the right."""
        return self._draw(side, self.axes[[2, 1]], self.middle[[2, 1]])

    def scale_bar(self) -> float:
        """A round length of about a quarter of the drawings, in scene units."""
        power = 10 ** math.floor(math.log10(self.span / 3))
        return max(step * power for step in (1, 2, 5) if step * power <= self.span / 3)

    def _draw(self, side: int, plane: Float[Tensor, "2 3"], middle: Float[Tensor, "2"]) -> Image.Image:
        picture = Image.new("RGB", (FINE * side, FINE * side), "white")
        pen = _Pen(ImageDraw.Draw(picture), plane, middle, FINE * side, self.span)
        pen.line(self.centers, PATH, 1)
        count = len(self.centers)
        every = max(1, math.ceil(count / MOST_FRUSTA))
        for index in [*range(count - 1, 0, -1), 0]:
            color, width = (time_color(index / (count - 1)), 1) if index else (FIRST, 2)
            if index % every == 0 or index == count - 1:
                for start, end in EDGES:
                    pen.line(self.frusta[index, [start, end]], color, width)
            pen.dot(self.centers[index], color, 2 if index else 4)
        pen.line(self.depth_range, RANGE, 3)
        pen.ends(self.depth_range, RANGE, self.cut)
        for arm, color in zip(self.cross.ends(), CROSS_COLORS, strict=True):
            pen.line(arm, color, 2)
        pen.scale_bar(self.scale_bar())
        return picture.reduce(FINE)


def drawings(sequence: PosedSequence, cross: Cross) -> Drawings:
    """Lay out the cameras of a sequence, its first camera's depth range and a cross."""
    cameras = sequence.cameras
    axes, centers = level_axes(cameras), cameras.centers
    near, far = sequence.depth_ranges[0].tolist()
    reach = REACH * max(near, _extent(centers @ axes.mT), (cross.center - centers[0]).norm().item())
    depths = torch.tensor([near, min(far, reach)]).to(centers)
    depth_range = centers[0] + depths[:, None] * cameras.world_to_camera[0, 2, :3]
    content = torch.cat([centers, depth_range, cross.ends().flatten(0, 1)])
    frusta = _frusta(cameras, FRUSTUM * _extent(content @ axes.mT))
    along = torch.cat([content, frusta.flatten(0, 1)]) @ axes.mT
    middle = (along.amin(dim=0) + along.amax(dim=0)) / 2
    return Drawings(axes, centers, frusta, depth_range, far > reach, cross, middle, _extent(along))


def time_color(share: float) -> tuple[int, int, int]:
    """From dark blue at the beginning of a sequence (0) over red to orange at its end (1)."""
    from matplotlib import colormaps

    red, green, blue, _ = colormaps["plasma"](0.85 * share, bytes=True)
    return int(red), int(green), int(blue)


def _extent(points: Float[Tensor, "_ 3"]) -> float:
    return float((points.amax(dim=0) - points.amin(dim=0)).max())


def _frusta(cameras: Cameras, depth: float) -> Float[Tensor, "view 7 3"]:
    """Apex, corners of the picture at this depth, and from the middle of its upper edge a tick to above."""
    height, width = cameras.image_size
    pixels = [(0, 0), (width, 0), (width, height), (0, height), (width / 2, 0), (width / 2, -height / 5)]
    corners = unproject(
        cameras, torch.tensor(pixels).to(cameras.intrinsics), torch.full((6,), depth).to(cameras.intrinsics)
    )
    return torch.cat([cameras.centers[:, None], corners], dim=1)


@dataclass(frozen=True)
class _Pen:
    """Draws things of the world on a plane; widths in pixels of the reduced picture."""

    draw: ImageDraw.ImageDraw
    plane: Float[Tensor, "2 3"]
    middle: Float[Tensor, "2"]
    side: int
    span: float

    def line(self, points: Float[Tensor, "_ 3"], color: tuple[int, int, int], width: int) -> None:
        self.draw.line(self._pixels(points), color, FINE * width)

    def dot(self, point: Float[Tensor, "3"], color: tuple[int, int, int], radius: float) -> None:
        self.draw.circle(self._pixels(point[None])[0], FINE * radius, color)

    def ends(self, interval: Float[Tensor, "2 3"], color: tuple[int, int, int], arrow: bool) -> None:
        """A bar across the near end; another or, for a range that goes on, an arrow at the far end."""
        (x0, y0), (x1, y1) = self._pixels(interval)
        length = math.hypot(x1 - x0, y1 - y0)
        if length < 1:  # it points at the spectator
            return
        x, y = 7 * FINE * (x1 - x0) / length, 7 * FINE * (y1 - y0) / length
        self.draw.line([(x0 - y, y0 + x), (x0 + y, y0 - x)], color, 3 * FINE)
        if arrow:
            self.draw.polygon([(x1 - y, y1 + x), (x1 + y, y1 - x), (x1 + 1.5 * x, y1 + 1.5 * y)], color)
        else:
            self.draw.line([(x1 - y, y1 + x), (x1 + y, y1 - x)], color, 3 * FINE)

    def scale_bar(self, length: float) -> None:
        """At the lower left corner."""
        left, bottom = 4 * FINE, self.side - 4 * FINE
        right = left + length / self.span * self.side * (1 - 2 * MARGIN)
        self.draw.line([(left, bottom), (right, bottom)], FIRST, FINE)
        for x in (left, right):
            self.draw.line([(x, bottom - 3 * FINE), (x, bottom + 3 * FINE)], FIRST, FINE)

    def _pixels(self, points: Float[Tensor, "n 3"]) -> list[tuple[float, float]]:
        unit = self.side * (1 - 2 * MARGIN) / self.span
        right, up = (unit * (points @ self.plane.mT - self.middle)).unbind(dim=-1)
        return [(self.side / 2 + x, self.side / 2 - y) for x, y in zip(right.tolist(), up.tolist(), strict=True)]
