"""Scenes of random solids with random pictures on them, anywhere, as captures (experiments.md, "Anything").

python notebooks/shapes.py OUT SCENES SEED

Solids are composed as in LRM-Zero (arXiv 2406.09371), pictures are dead leaves (Lee, Mumford and Huang, IJCV 2001) with
noise. Behind the solids there is one colour, a ground below a dome, or a room. Nothing here is a photograph.
"""

import json
import sys
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from PIL import Image

SIZE, SAMPLES, FRAMES, PICTURES, PICTURE = 64, 2, 16, 300, 128
BALL, CYLINDER, CUBE = 0, 1, 2


def _about(axis, angle):
    """Return the rotation about an axis."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def draw_picture(rng):
    """Return a picture [PICTURE PICTURE 3] of dead leaves, smoothly shaded, with colours near a few of a palette."""
    y, x = np.mgrid[:PICTURE, :PICTURE] / PICTURE
    palette = rng.uniform(0.03, 1, (rng.integers(1, 6), 1)) ** 0.7 * (
        1 - rng.uniform(0, 0.85) * rng.uniform(0, 1, (1, 3))
    )
    palette = np.clip(palette + rng.normal(0, 0.12, (len(palette), 3)), 0.01, 1)
    picture = np.zeros((PICTURE, PICTURE, 3)) + palette[0]
    sizes = np.sort(0.5 * rng.uniform(0.02, 1, rng.integers(0, 60) * (rng.random() < 0.55)) ** 2)[::-1] + 0.015
    for size in sizes:
        cx, cy, angle, stretch = rng.uniform(0, 1), rng.uniform(0, 1), rng.uniform(0, np.pi), rng.uniform(0.3, 1)
        dx, dy = (x - cx + 0.5) % 1 - 0.5, (y - cy + 0.5) % 1 - 0.5
        u, v = np.cos(angle) * dx + np.sin(angle) * dy, (np.cos(angle) * dy - np.sin(angle) * dx) / stretch
        inside = (np.hypot(u, v) if rng.random() < 0.6 else np.maximum(abs(u), abs(v))) < size
        shade = np.clip(palette[rng.integers(len(palette))] + rng.normal(0, 0.06, 3), 0, 1)
        picture[inside] = shade * (1 + rng.uniform(-1, 1) * u[inside, None] / size * 0.3)
    spectrum = np.fft.fft2(rng.normal(size=(PICTURE, PICTURE)))
    waves = np.hypot(*np.meshgrid(np.fft.fftfreq(PICTURE), np.fft.fftfreq(PICTURE)))
    noise = np.fft.ifft2(spectrum / (waves + 1 / PICTURE) ** rng.uniform(0.8, 1.6)).real
    return np.clip(picture * (1 + rng.uniform(0, 0.4) ** 2 * (noise / noise.std())[..., None]), 0, 1).astype(np.float32)


def look_up(pictures, index, u, v):
    u, v = (u % 1) * PICTURE, (v % 1) * PICTURE
    return pictures[index, v.astype(int) % PICTURE, u.astype(int) % PICTURE]


class Solids:
    """Balls, (tapered) cylinders and cubes: maps to local frames [n 3 4], taper, picture, scale and offset of it."""

    def __init__(self, rng):
        self.parts = []
        count = 1 + int(rng.integers(0, 8)) if rng.random() < 0.9 else 1
        wild = rng.random() < 0.4
        same, mirrored = rng.random() < 0.3, rng.random() < 0.4
        base = rng.integers(PICTURES)
        for number in range(count):
            half = rng.uniform(0.25, 1, 3) if number == 0 else rng.uniform(0.08, 0.6, 3)
            axes = (
                _about(rng.normal(size=3), rng.uniform(0, np.pi))
                if wild
                else _about(np.array([0, 1.0, 0]), rng.choice([0, rng.uniform(0, np.pi)]))
                @ _about(np.eye(3)[rng.integers(3)], rng.choice([0, np.pi / 2]))
            )
            center = np.zeros(3)
            if number:
                _, old, oldaxes, oldcenter = self.parts[rng.integers(len(self.parts))][:4]
                direction = rng.normal(size=3)
                direction /= np.abs(direction).max() if rng.random() < 0.5 else np.linalg.norm(direction)
                center = oldcenter + oldaxes @ (direction * old * rng.uniform(0.7, 1.2))
            look = (base if same else rng.integers(PICTURES), rng.uniform(0.15, 1.2), rng.uniform(0, 1, 2))
            part = (int(rng.integers(3)), half, axes, center, rng.uniform(-0.6, 0.3) * (rng.random() < 0.5), look)
            self.parts.append(part)
            if mirrored and number and abs(center[0]) > 0.1:
                flip = np.diag([-1.0, 1, 1])
                self.parts.append((part[0], half, flip @ axes @ flip, flip @ center, *part[4:]))
        points = self.surface(rng)
        center = points.mean(0)
        center[1] = (points[:, 1].min() + points[:, 1].max()) / 2
        scale = 0.57 / np.abs(points - center).max()
        self.parts = [
            (kind, half * scale, axes, (middle - center) * scale, *rest)
            for kind, half, axes, middle, *rest in self.parts
        ]
        self.points = (points - center) * scale

    def surface(self, rng):
        """Return points on all solids, hidden ones included."""
        points = []
        for kind, half, axes, center, taper, _ in self.parts:
            p = rng.normal(size=(400, 3))
            if kind == BALL:
                p /= np.linalg.norm(p, axis=1, keepdims=True)
            elif kind == CUBE:
                p /= np.abs(p).max(1, keepdims=True)
            else:
                p = rng.uniform(-1, 1, (400, 3))
                level = np.hypot(p[:, 0], p[:, 2])
                p[:, [0, 2]] *= ((1 + taper * p[:, 1]) / level)[:, None]
            points.append(center + (p * half) @ axes.T)
        return np.concatenate(points)

    def hit(self, origin, rays):
        """Return distance [n], part [n] (-1: none), local point and world normal [n 3] of the nearest hits."""
        n = len(rays)
        nearest, which = np.full(n, np.inf, np.float32), np.full(n, -1)
        local, normal = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
        for number, (kind, half, axes, center, taper, _) in enumerate(self.parts):
            inverse = (axes / half).T
            o = ((origin - center) @ inverse.T).astype(np.float32)
            d = (rays @ inverse.T).astype(np.float32)
            o = np.broadcast_to(o, d.shape)
            with np.errstate(all="ignore"):
                t, ln = INTERSECT[kind](o, d, taper)
            better = t < nearest
            nearest[better], which[better] = t[better], number
            local[better] = (o + t[:, None] * d)[better]
            world = ln[better] @ inverse
            normal[better] = world / np.linalg.norm(world, axis=1, keepdims=True)
        return nearest, which, local, normal


def _ball(o, d, taper):
    a, b, c = (d * d).sum(1), (o * d).sum(1), (o * o).sum(1) - 1
    square = b * b - a * c
    t = (-b - np.sqrt(np.maximum(square, 0))) / a
    t = np.where((square > 0) & (t > 1e-4), t, np.inf)
    return t, o + np.where(np.isfinite(t), t, 0)[:, None] * d


def _cube(o, d, taper):
    middle, half = -o / d, abs(1 / d)
    enter, leave = middle - half, middle + half
    face, t = enter.argmax(1), enter.max(1)
    t = np.where((t <= leave.min(1)) & (t > 1e-4), t, np.inf)
    n = np.zeros_like(o)
    n[np.arange(len(o)), face] = -np.sign(d[np.arange(len(o)), face])
    return t, n


def _cylinder(o, d, taper):
    best, n = np.full(len(o), np.inf, np.float32), np.zeros_like(o)
    a = d[:, 0] ** 2 + d[:, 2] ** 2 - (taper * d[:, 1]) ** 2
    side = 1 + taper * o[:, 1]
    b = o[:, 0] * d[:, 0] + o[:, 2] * d[:, 2] - taper * d[:, 1] * side
    c = o[:, 0] ** 2 + o[:, 2] ** 2 - side**2
    square = b * b - a * c
    root = np.sqrt(np.maximum(square, 0))
    for sign in (-1, 1):
        t = (-b + sign * root) / a
        p = o + t[:, None] * d
        good = (square > 0) & (t > 1e-4) & (t < best) & (abs(p[:, 1]) <= 1)
        best = np.where(good, t, best)
        n[good] = np.stack([p[:, 0], -taper * (1 + taper * p[:, 1]), p[:, 2]], 1)[good]
    for cap in (-1.0, 1.0):
        t = (cap - o[:, 1]) / d[:, 1]
        p = o + t[:, None] * d
        good = (t > 1e-4) & (t < best) & (np.hypot(p[:, 0], p[:, 2]) <= 1 + taper * cap)
        best = np.where(good, t, best)
        n[good] = np.array([0, cap, 0])
    return best, n


INTERSECT = {BALL: _ball, CYLINDER: _cylinder, CUBE: _cube}


class Scene:
    """Solids, light, and what is behind them, seen from any camera."""

    def __init__(self, rng, pictures):
        self.pictures, self.solids = pictures, Solids(rng)
        self.kind = rng.choice(["plain", "white", "ground", "room"], p=[0.25, 0.1, 0.3, 0.35])
        self.plain = (
            np.ones(3) if self.kind == "white" else rng.uniform(0, 1) * (1 - rng.uniform(0, 0.6) * rng.uniform(0, 1, 3))
        )
        self.floor = self.solids.points[:, 1].min()
        self.room = rng.uniform(1.3, 3.0, 2), rng.uniform(1.3, 3.0, 2)  # from the object to each pair of walls
        self.ceiling = self.floor + rng.uniform(2.2, 4)
        self.turn = _about(np.array([0, 1.0, 0]), rng.uniform(0, 2 * np.pi))
        self.wall_looks = [(rng.integers(len(pictures)), rng.uniform(0.1, 0.6), rng.uniform(0, 1, 2)) for _ in range(7)]
        self.dome_radius = rng.uniform(2.2, 3.5)
        height, azimuth = rng.uniform(0.3, 1), rng.uniform(0, 2 * np.pi)
        level = np.sqrt(1 - height**2)
        self.light = np.array([level * np.sin(azimuth), height, level * np.cos(azimuth)])
        self.ambient, self.shadow = rng.uniform(0.45, 0.9), rng.uniform(0.2, 0.9)
        self.tone = rng.uniform(0.8, 1.15, 3) * rng.uniform(0.75, 1.2)

    def brightness(self, points, normals):
        direct = np.maximum(0, normals @ self.light)
        t = self.towards_light(points + 2e-3 * normals)
        direct = np.where(np.isfinite(t), self.shadow * 0.5, 1) * direct
        return (self.ambient * (0.85 + 0.15 * normals[:, 1]) + (1 - self.ambient) * 1.4 * direct)[:, None]

    def towards_light(self, points):
        """Return how far the solids are from points on the way to the light; points far from the object see it."""
        near = np.linalg.norm(points, axis=1) < 2.5
        distances = np.full(len(points), np.inf, np.float32)
        points, t = points[near], distances[near]
        for kind, half, axes, center, taper, _ in self.solids.parts:
            inverse = (axes / half).T
            o = ((points - center) @ inverse.T).astype(np.float32)
            d = np.broadcast_to((inverse @ self.light).astype(np.float32), o.shape)
            with np.errstate(all="ignore"):
                t = np.minimum(t, INTERSECT[kind](o, d, taper)[0])
        distances[near] = t
        return distances

    def colors(self, origin, rays):
        """Return colours [n 3] along rays of unit length, and whether they meet a solid."""
        t, part, local, normal = self.solids.hit(origin, rays)
        colors = np.zeros((len(rays), 3), np.float32)
        for number, (kind, half, *_, (picture, scale, offset)) in enumerate(self.solids.parts):
            chosen = part == number
            p = local[chosen] * half / 0.57
            if kind == CUBE:
                face = np.abs(local[chosen]).argmax(1)
                uv = np.where(
                    (face == 0)[:, None], p[:, [2, 1]], np.where((face == 1)[:, None], p[:, [0, 2]], p[:, :2])
                )
            else:
                flat = (kind == CYLINDER) & (np.abs(local[chosen][:, 1]) > 0.999)
                around = np.arctan2(local[chosen][:, 0], local[chosen][:, 2]) * max(half[0], half[2]) / 0.57
                uv = np.where(flat[:, None], p[:, [0, 2]], np.stack([around, p[:, 1]], 1))
            u, v = (uv * scale + offset).T
            colors[chosen] = look_up(self.pictures, picture, u, v)
        hit = part >= 0
        points = origin + np.where(hit, t, 0)[:, None] * rays
        colors[hit] *= self.brightness(points[hit], normal[hit])
        colors[~hit] = self.behind(origin, rays[~hit])
        return np.clip(colors * (1 if self.kind in ("white", "plain") else self.tone), 0, 1), hit

    def behind(self, origin, rays):
        """Return the colours of rays that meet no solid."""
        if self.kind in ("white", "plain"):
            return np.broadcast_to(self.plain, rays.shape)
        o, d = self.turn @ origin, rays @ self.turn.T
        best, face = np.full(len(d), np.inf), np.zeros(len(d), int)
        with np.errstate(all="ignore"):
            planes = [(1, self.floor, 0)]
            if self.kind == "room":
                planes += [
                    (1, self.ceiling, 1),
                    (0, -self.room[0][0], 2),
                    (0, self.room[0][1], 3),
                    (2, -self.room[1][0], 4),
                    (2, self.room[1][1], 5),
                ]
            for axis, place, number in planes:
                t = (place - o[axis]) / d[:, axis]
                # Walls between the camera and the object are left out, so that cameras may stand outside.
                good = (t > 1e-3) & (t < best) & ((d[:, axis] > 0) == (place > 0))
                best[good], face[good] = t[good], number
        b, c = d @ o, o @ o - (self.dome_radius + max(0, np.linalg.norm(o) - self.dome_radius + 0.3)) ** 2
        dome = -b + np.sqrt(np.maximum(b * b - c, 0)) if self.kind == "ground" else np.inf
        sky = best > dome
        best = np.where(sky, dome, best)
        p = o + best[:, None] * d
        colors, normals = np.zeros(d.shape, np.float32), np.zeros(d.shape)
        for number in range(6):
            chosen = (face == number) & ~sky
            picture, scale, offset = self.wall_looks[number]
            axes = [0, 2] if number < 2 else ([2, 1] if number < 4 else [0, 1])
            u, v = (p[chosen][:, axes] * scale + offset).T
            colors[chosen] = look_up(self.pictures, picture, u, v)
            normals[chosen, [1, 1, 0, 0, 2, 2][number]] = [1, -1, 1, -1, 1, -1][number]
        world = p @ self.turn
        colors[~sky] *= self.brightness(world[~sky], (normals @ self.turn)[~sky])
        q = p[sky] / np.linalg.norm(p[sky], axis=1, keepdims=True)
        picture, scale, offset = self.wall_looks[6]
        colors[sky] = look_up(
            self.pictures,
            picture,
            np.arctan2(q[:, 0], q[:, 2]) * scale + offset[0],
            np.arcsin(np.clip(q[:, 1], -1, 1)) * scale + offset[1],
        )
        return colors


def write_scene(job):
    """Write one capture: images, masks, `transforms.json` and points of the surface."""
    out, seed, index = job
    rng = np.random.default_rng([seed, index])
    scene = Scene(rng, PICTURES_OF[0])
    folder = Path(out) / f"{index:05d}"
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    fov = np.exp(rng.uniform(np.log(9), np.log(58)))
    distance = 0.57 / rng.uniform(0.48, 0.9) / np.tan(np.radians(fov) / 2)
    distance = max(distance, 1.35)
    level, start = rng.uniform(-3, 45), rng.uniform(0, 360)
    focal = SIZE / 2 / np.tan(np.radians(fov) / 2)
    grid = (np.arange(SIZE * SAMPLES) + 0.5) / SAMPLES - SIZE / 2
    x, y = np.meshgrid(grid / focal, grid / focal)
    axes_rays = np.stack([x, -y, -np.ones_like(x)], -1).reshape(-1, 3)  # OpenGL's axes
    frames = []
    for frame in range(FRAMES):
        azimuth = start + (
            rng.uniform(-40, 40) if frame % 8 in (1, 3, 5) else 360 * (frame + rng.uniform(-0.3, 0.3)) / FRAMES
        )
        elevation = np.clip(level + rng.normal(0, 12) * (frame > 0), -5, 62)
        a, e = np.radians(azimuth), np.radians(elevation)
        r = distance * np.exp(rng.normal(0, 0.05))
        back = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
        eye, target = r * back, rng.normal(0, 0.04, 3)
        eye[1] = max(eye[1], scene.floor + 0.08)
        back = (eye - target) / np.linalg.norm(eye - target)
        right = np.cross([0, 1, 0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, eye], 1)
        rays = axes_rays @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        colors, hit = scene.colors(eye, rays)
        shape = SIZE, SAMPLES, SIZE, SAMPLES
        image = colors.reshape(*shape, 3).mean((1, 3))
        mask = hit.reshape(shape).mean((1, 3))
        Image.fromarray((255 * image + 0.5).astype(np.uint8)).save(folder / f"images/{frame:02d}.jpg", quality=95)
        Image.fromarray((255 * mask + 0.5).astype(np.uint8)).save(folder / f"masks/{frame:02d}.png")
        frames.append(
            {
                "file_path": f"images/{frame:02d}.jpg",
                "mask_path": f"masks/{frame:02d}.png",
                "transform_matrix": pose.tolist(),
            }
        )
    header = (
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    points = scene.solids.points
    (folder / "points.ply").write_text(
        header.format(len(points)) + "\n".join(" ".join(f"{v:.4f}" for v in p) for p in points) + "\n"
    )
    lens = {"camera_model": "PINHOLE", "fl_x": focal, "fl_y": focal, "w": SIZE, "h": SIZE}
    (folder / "transforms.json").write_text(json.dumps(lens | {"ply_file_path": "points.ply", "frames": frames}) + "\n")


PICTURES_OF = []
if __name__ == "__main__":
    out, scenes, seed = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    rng = np.random.default_rng(seed)
    PICTURES_OF.append(np.stack([draw_picture(rng) for _ in range(PICTURES)]))
    with Pool(2) as pool:
        for done, _ in enumerate(pool.imap_unordered(write_scene, [(out, seed, i) for i in range(scenes)], 4)):
            if done % 100 == 0:
                print(done, flush=True)
