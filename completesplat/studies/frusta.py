"""The cameras of a sequence as drawings, and a cross that must stick to its place in all pictures."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor

from completesplat.data.loading.training_statistics import world_up
from completesplat.data.sequences import PosedSequence
from completesplat.geometry.cameras import Cameras, project, transform_points, unproject

# In units of half the first picture's width, seen from the first camera.
ARM = 0.3
# Root mean squares: image axes must turn by so much (radians) for the horizon to be known from them; optical axes must
# spread by so much, and pass by their common point within so much of its depth, to look at one thing.
LEAST_TURN, LEAST_SPREAD, LARGEST_MISS = 0.1, 0.2, 0.2
# Candidates for the place of the cross along an axis; in a picture, it counts as seen so far from the borders (shares).
DEPTHS, BORDER = 16, 0.1
# Of the length of an arm: what is nearer to a camera's plane is not drawn.
NEAREST = 0.05


@dataclass(frozen=True)
class Cross:
    """Three arms from one place and a level square around it; rows of `arms`: right, up and ahead."""

    center: Float[Tensor, "3"]
    arms: Float[Tensor, "3 3"]

    def ends(self) -> Float[Tensor, "3 2 3"]:
        """The two ends of each arm in the world; it begins at the centre."""
        return torch.stack([self.center.expand(3, 3), self.center + self.arms], dim=1)

    def square(self) -> Float[Tensor, "4 2 3"]:
        """The two ends of each side in the world."""
        right, _, ahead = self.arms
        corners = self.center + torch.stack([right + ahead, right - ahead, -right - ahead, -right + ahead])
        return torch.stack([corners, corners.roll(-1, 0)], dim=1)


def place_cross(cameras: Cameras, depth_range: Float[Tensor, "2"]) -> Cross:
    """A cross for cameras [view] where their optical axes meet, if they do in front of all of them.

    Otherwise on the axis of the first, the middle or the last camera, where most cameras see it; of the best places
    the nearest, but none nearer than the middle of the first camera's depth range in terms of 1 / depth.
    """
    met = _common_point(cameras)
    center = _most_seen_point(cameras, depth_range) if met is None else met
    depth = transform_points(cameras.world_to_camera[0], center[None])[0, 2].abs()
    length = ARM * depth * cameras.image_size[1] / 2 / cameras.intrinsics[0, 0, 0]
    return Cross(center, length * level_axes(cameras))


def level_axes(cameras: Cameras) -> Float[Tensor, "3 3"]:
    """Unit vectors in the world as rows: the first camera's right, up and forward, turned so that up is the world's.

    Where the cameras [view] hardly turn, no horizon follows from them, and the mean of their own up directions is
    taken.
    """
    right, down, forward = cameras.world_to_camera[:, :3, :3].unbind(dim=1)
    turn = torch.linalg.svdvals(right)[1:2] / len(right) ** 0.5
    up = world_up(cameras) if (turn > LEAST_TURN).any() else torch.nn.functional.normalize(-down.mean(dim=0), dim=0)
    # In a picture taken straight down, ahead is at its upper edge; in one taken straight up, at its lower.
    ahead = forward[0] if (forward[0] @ up).abs() < 0.99 else down[0] * (forward[0] @ up).sign()
    ahead = torch.nn.functional.normalize(ahead - (ahead @ up) * up, dim=0)
    return torch.stack([torch.linalg.cross(ahead, up), up, ahead])


def visible_segments(
    camera: Cameras, segments: Float[Tensor, "segment 2 3"], nearest: float
) -> list[tuple[int, Float[Tensor, "2 2"]]]:
    """Number and ends in pixels of the segments, cut off where they are less deep than `nearest` before a camera []."""
    _, depths = project(camera, segments.flatten(0, 1))
    result = []
    for index, (ends, depth) in enumerate(zip(segments, depths.reshape(-1, 2), strict=True)):
        if depth.max() <= nearest:
            continue
        shares = ((nearest - depth) / (depth.flip(0) - depth)).where(depth < nearest, 0)
        pixels, _ = project(camera, ends + shares[:, None] * (ends.flip(0) - ends))
        result.append((index, pixels))
    return result


def _common_point(cameras: Cameras) -> Float[Tensor, "3"] | None:
    """The point nearest to all optical axes, if they pass it closely, from several sides, and it lies before them."""
    forward, centers = cameras.world_to_camera[:, 2, :3], cameras.centers
    across = torch.eye(3).to(forward) - forward[:, :, None] * forward[:, None, :]
    mean = across.mean(dim=0)
    if torch.linalg.eigvalsh(mean)[0] < LEAST_SPREAD**2:
        return None
    point = torch.linalg.solve(mean, (across @ centers[:, :, None]).mean(dim=0)[:, 0])
    offsets = point - centers
    depths = (offsets * forward).sum(dim=-1)
    misses = (across @ offsets[:, :, None]).square().sum(dim=(1, 2))
    met = (depths > 0).all() and misses.mean().sqrt() < LARGEST_MISS * depths.mean()
    return point if met else None


def _most_seen_point(cameras: Cameras, depth_range: Float[Tensor, "2"]) -> Float[Tensor, "3"]:
    near, far = depth_range.double().tolist()
    depths = torch.logspace(math.log10(2 / (1 / near + 1 / far)), math.log10(far), DEPTHS).to(cameras.intrinsics)
    count = len(cameras.centers)
    chosen = [0, count // 2, count - 1]
    origins, forward = cameras.centers[chosen], cameras.world_to_camera[chosen, 2, :3]
    # All three candidates at one depth stand before those at the next: the first of the best is the nearest.
    points = (origins + depths[:, None, None] * forward).flatten(0, 1)
    pixels, depth = project(cameras, points)
    height, width = cameras.image_size
    shares = pixels / torch.tensor([width, height]).to(pixels)
    seen = ((shares - 0.5).abs() < 0.5 - BORDER).all(dim=-1) & (depth > near)
    return points[seen.sum(dim=0).argmax()]


FINE = 4  # drawn this much larger, then reduced
MARGIN = 0.08
FRUSTUM = 0.14
# A far plane is drawn up to this multiple of the extent of everything else; an arrow stands for the rest.
REACH = 2.5
MOST_FRUSTA = 25
CROSS_COLORS = ((220, 30, 30), (20, 150, 20), (40, 80, 255))
FIRST, RANGE, PATH = (0, 0, 0), (170, 170, 170), (200, 200, 200)
EDGES = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (5, 6)]


@dataclass(frozen=True)
class Drawings:
    """A sequence prepared for drawing; both drawings have one scale.

    `axes` are the first camera's right, up and ahead, level, as rows; `frusta` apex, corners of the picture at some
    depth, and a tick at its upper edge; `depth_range` the ends of the first camera's as far as they are drawn (`cut`:
    not up to far); `middle` along the axes and `span` in scene units are of all that is drawn.
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
        power: float = 10 ** math.floor(math.log10(self.span / 3))
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
            pen.draw.circle(pen.pixels(self.centers[[index]])[0], FINE * (2 if index else 4), color)
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
    """Colours run from dark blue at the beginning of a sequence (0) over red to orange at its end (1)."""
    from matplotlib import colormaps

    red, green, blue, _ = colormaps["plasma"](0.85 * share, bytes=True)
    return int(red), int(green), int(blue)


def _extent(points: Float[Tensor, "_ 3"]) -> float:
    extent: float = (points.amax(dim=0) - points.amin(dim=0)).max().item()
    return extent


def _frusta(cameras: Cameras, depth: float) -> Float[Tensor, "view 7 3"]:
    """Apex, corners of the picture at this depth, and from the middle of its upper edge a tick to above."""
    height, width = cameras.image_size
    pixels = [(0, 0), (width, 0), (width, height), (0, height), (width / 2, 0), (width / 2, -height / 5)]
    places, depths = (torch.tensor(values).to(cameras.intrinsics) for values in (pixels, [depth] * 6))
    return torch.cat([cameras.centers[:, None], unproject(cameras, places, depths)], dim=1)


@dataclass(frozen=True)
class _Pen:
    """Draws things of the world on a plane; widths in pixels of the reduced picture."""

    draw: ImageDraw.ImageDraw
    plane: Float[Tensor, "2 3"]
    middle: Float[Tensor, "2"]
    side: int
    span: float

    def line(self, points: Float[Tensor, "_ 3"], color: tuple[int, int, int], width: int) -> None:
        self.draw.line(self.pixels(points), color, FINE * width)

    def ends(self, interval: Float[Tensor, "2 3"], color: tuple[int, int, int], arrow: bool) -> None:
        """A bar across the near end; another or, for a range that goes on, an arrow at the far end."""
        (x0, y0), (x1, y1) = self.pixels(interval)
        length = math.hypot(x1 - x0, y1 - y0)
        if length < 1:  # it points at the spectator
            return
        x, y = 7 * FINE * (x1 - x0) / length, 7 * FINE * (y1 - y0) / length
        first, last = ([(a - y, b + x), (a + y, b - x)] for a, b in ((x0, y0), (x1, y1)))
        self.draw.line(first, color, 3 * FINE)
        if arrow:
            self.draw.polygon([*last, (x1 + 1.5 * x, y1 + 1.5 * y)], color)
        else:
            self.draw.line(last, color, 3 * FINE)

    def scale_bar(self, length: float) -> None:
        """Draw a bar of this length (scene units) in the lower left corner."""
        left, bottom = 4 * FINE, self.side - 4 * FINE
        right = left + length / self.span * self.side * (1 - 2 * MARGIN)
        self.draw.line([(left, bottom), (right, bottom)], FIRST, FINE)
        for x in (left, right):
            self.draw.line([(x, bottom - 3 * FINE), (x, bottom + 3 * FINE)], FIRST, FINE)

    def pixels(self, points: Float[Tensor, "n 3"]) -> list[tuple[float, float]]:
        unit = self.side * (1 - 2 * MARGIN) / self.span
        right, up = (unit * (points @ self.plane.mT - self.middle)).unbind(dim=-1)
        return [(self.side / 2 + x, self.side / 2 - y) for x, y in zip(right.tolist(), up.tolist(), strict=True)]
