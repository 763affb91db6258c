"""Drawings of a sequence's cameras, and a cross that must keep its place in the scene in all images."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor

from completesplat.data.loading.training_statistics import world_up
from completesplat.data.sequences import PosedSequence
from completesplat.geometry.cameras import Cameras, project, transform_points, unproject

# In units of half the first image's width, as the first camera sees it.
ARM = 0.3
# Root mean squares. The horizon follows from image axes that turn at least this much (radians). Cameras look at one
# thing if their optical axes spread at least this much and miss their common point by at most this share of its depth.
LEAST_TURN, LEAST_SPREAD, LARGEST_MISS = 0.1, 0.2, 0.2
# Number of places for the cross along an axis; and share of an image at its borders where the cross counts as unseen.
DEPTHS, BORDER = 16, 0.1
# Share of an arm's length; lines nearer to a camera's plane are not drawn.
NEAREST = 0.05


@dataclass(frozen=True)
class Cross:
    """Three arms from one place, and a level square around it; rows of `arms`: right, up and ahead."""

    center: Float[Tensor, "3"]
    arms: Float[Tensor, "3 3"]

    def ends(self) -> Float[Tensor, "3 2 3"]:
        """Return the two ends of each arm in the world; the first is the centre."""
        return torch.stack([self.center.expand(3, 3), self.center + self.arms], dim=1)

    def square(self) -> Float[Tensor, "4 2 3"]:
        """Return the two ends of each side of the square in the world."""
        right, _, ahead = self.arms
        corners = self.center + torch.stack([right + ahead, right - ahead, -right - ahead, -right + ahead])
        return torch.stack([corners, corners.roll(-1, 0)], dim=1)


def place_cross(cameras: Cameras, depth_range: Float[Tensor, "2"]) -> Cross:
    """Place a cross where the optical axes of cameras [view] meet, if they meet in front of all cameras.

    Otherwise place it on the axis of the first, the middle or the last camera, where most cameras see it. Of equally
    good places take the nearest, beyond the middle of the first camera's depth range in terms of 1 / depth.
    """
    met = _common_point(cameras)
    center = _most_seen_point(cameras, depth_range) if met is None else met
    depth = transform_points(cameras.world_to_camera[0], center[None])[0, 2].abs()
    length = ARM * depth * cameras.image_size[1] / 2 / cameras.intrinsics[0, 0, 0]
    return Cross(center, length * level_axes(cameras))


def level_axes(cameras: Cameras) -> Float[Tensor, "3 3"]:
    """Return unit vectors in the world as rows: the first camera's right, up and ahead, levelled to the world's up.

    If the cameras [view] hardly turn, no horizon follows from them, and up is the mean of their up directions.
    """
    right, down, forward = cameras.world_to_camera[:, :3, :3].unbind(dim=1)
    turn = torch.linalg.svdvals(right)[1:2] / len(right) ** 0.5
    up = world_up(cameras) if (turn > LEAST_TURN).any() else torch.nn.functional.normalize(-down.mean(dim=0), dim=0)
    # Ahead is at the upper edge of an image taken straight down, and at the lower edge of one taken straight up.
    ahead = forward[0] if (forward[0] @ up).abs() < 0.99 else down[0] * (forward[0] @ up).sign()
    ahead = torch.nn.functional.normalize(ahead - (ahead @ up) * up, dim=0)
    return torch.stack([torch.linalg.cross(ahead, up), up, ahead])


def visible_segments(
    camera: Cameras, segments: Float[Tensor, "segment 2 3"], nearest: float
) -> list[tuple[int, Float[Tensor, "2 2"]]]:
    """Return number and ends (pixels) of the segments before a camera [], cut off at the depth `nearest`."""
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
    """Return the point nearest to all optical axes, if they pass close to it, from several sides, and face it."""
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
    # Points are ordered by depth, so the first of the best is the nearest.
    points = (origins + depths[:, None, None] * forward).flatten(0, 1)
    pixels, depth = project(cameras, points)
    height, width = cameras.image_size
    shares = pixels / torch.tensor([width, height]).to(pixels)
    seen = ((shares - 0.5).abs() < 0.5 - BORDER).all(dim=-1) & (depth > near)
    return points[seen.sum(dim=0).argmax()]


FINE = 4  # factor by which drawings are made larger before they are reduced
MARGIN = 0.08
FRUSTUM = 0.14
# The depth range is drawn up to this multiple of the extent of everything else; an arrow replaces the rest.
REACH = 2.5
MOST_FRUSTA = 25
CROSS_COLORS = ((220, 30, 30), (20, 150, 20), (40, 80, 255))
FIRST, RANGE, PATH = (0, 0, 0), (170, 170, 170), (200, 200, 200)
EDGES = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (5, 6)]


@dataclass(frozen=True)
class Drawings:
    """Sequence prepared for two drawings with one scale.

    Rows of `axes` are the first camera's right, up and ahead, levelled. `frusta` are apex, corners of the image at some
    depth, and a tick at its upper edge. `depth_range` has the ends of the first camera's range as drawn (`cut`: far is
    beyond). `middle` (along the axes) and `span` (scene units) cover everything that is drawn.
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
        """Draw a square image whose right is the first camera's right and whose top is ahead."""
        return self._draw(side, self.axes[[0, 2]], self.middle[[0, 2]])

    def from_the_side(self, side: int) -> Image.Image:
        """Draw a square image seen from the first camera's right, with ahead to the right."""
        return self._draw(side, self.axes[[2, 1]], self.middle[[2, 1]])

    def scale_bar(self) -> float:
        """Return a round length of about a quarter of the drawings, in scene units."""
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
    """Return a colour from dark blue at the beginning of a sequence (0) over red to orange at its end (1)."""
    from matplotlib import colormaps

    red, green, blue, _ = colormaps["plasma"](0.85 * share, bytes=True)
    return int(red), int(green), int(blue)


def _extent(points: Float[Tensor, "_ 3"]) -> float:
    extent: float = (points.amax(dim=0) - points.amin(dim=0)).max().item()
    return extent


def _frusta(cameras: Cameras, depth: float) -> Float[Tensor, "view 7 3"]:
    """Return apex, corners of the image at this depth, and a tick upwards from the middle of its upper edge."""
    height, width = cameras.image_size
    pixels = [(0, 0), (width, 0), (width, height), (0, height), (width / 2, 0), (width / 2, -height / 5)]
    places, depths = (torch.tensor(values).to(cameras.intrinsics) for values in (pixels, [depth] * 6))
    return torch.cat([cameras.centers[:, None], unproject(cameras, places, depths)], dim=1)


@dataclass(frozen=True)
class _Pen:
    """Pen that draws world points on a plane; widths are in pixels of the reduced image."""

    draw: ImageDraw.ImageDraw
    plane: Float[Tensor, "2 3"]
    middle: Float[Tensor, "2"]
    side: int
    span: float

    def line(self, points: Float[Tensor, "_ 3"], color: tuple[int, int, int], width: int) -> None:
        self.draw.line(self.pixels(points), color, FINE * width)

    def ends(self, interval: Float[Tensor, "2 3"], color: tuple[int, int, int], arrow: bool) -> None:
        """Draw a bar across the near end, and at the far end another, or an arrow if the range continues."""
        (x0, y0), (x1, y1) = self.pixels(interval)
        length = math.hypot(x1 - x0, y1 - y0)
        if length < 1:  # it points at the viewer
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
