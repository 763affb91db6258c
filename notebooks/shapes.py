"""Scenes of random solids with random pictures on them, anywhere, as captures (experiments.md, "Anything").

python notebooks/shapes.py OUT SCENES SEED [SIZE]

With CuPy, rays are traced on a GPU. Solids are composed as in LRM-Zero (arXiv 2406.09371), pictures are dead leaves
(Lee, Mumford and Huang, IJCV 2001) with noise. Behind the solids there is one colour, a ground below a dome, or a room.
Nothing here is a photograph.
"""

import json
import os
import sys
from contextlib import suppress
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from PIL import Image

xp = np
with suppress(ImportError):
    import cupy as xp

SIZE = int(sys.argv[4]) if len(sys.argv) > 4 else 64
SAMPLES, FRAMES, PICTURES, PICTURE = 4, 16, 300, 2 * SIZE
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
    return pictures[int(index), v.astype(int) % PICTURE, u.astype(int) % PICTURE]


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

    def hit(self, origins, rays):
        """Return distance [n], part [n] (-1: none), local point and world normal [n 3] of the nearest hits."""
        n = len(rays)
        nearest, which = xp.full(n, np.inf, np.float32), xp.full(n, -1)
        local, normal = xp.zeros((n, 3), np.float32), xp.zeros((n, 3), np.float32)
        for number, (kind, half, axes, center, taper, _) in enumerate(self.parts):
            inverse = xp.asarray((axes / half).T)
            o = ((origins - xp.asarray(center)) @ inverse.T).astype(np.float32)
            d = (rays @ inverse.T).astype(np.float32)
            with np.errstate(all="ignore"):
                t, ln = INTERSECT[kind](o, d, taper)
            better = t < nearest
            nearest, which = xp.where(better, t, nearest), xp.where(better, number, which)
            local = xp.where(better[:, None], o + xp.where(better, t, 0)[:, None] * d, local)
            world = (ln @ inverse).astype(np.float32)
            length = xp.maximum(xp.linalg.norm(world, axis=1, keepdims=True), 1e-9)
            normal = xp.where(better[:, None], world / length, normal)
        return nearest, which, local, normal


def _ball(o, d, taper):
    a, b, c = (d * d).sum(1), (o * d).sum(1), (o * o).sum(1) - 1
    square = b * b - a * c
    t = (-b - xp.sqrt(xp.maximum(square, 0))) / a
    t = xp.where((square > 0) & (t > 1e-4), t, np.inf)
    return t, o + xp.where(xp.isfinite(t), t, 0)[:, None] * d


def _cube(o, d, taper):
    middle, half = -o / d, abs(1 / d)
    enter, leave = middle - half, middle + half
    face, t = enter.argmax(1), enter.max(1)
    t = xp.where((t <= leave.min(1)) & (t > 1e-4), t, np.inf)
    return t, -xp.sign(d) * (face[:, None] == xp.arange(3))


def _cylinder(o, d, taper):
    best, n = xp.full(len(o), np.inf, np.float32), xp.zeros_like(o)
    a = d[:, 0] ** 2 + d[:, 2] ** 2 - (taper * d[:, 1]) ** 2
    side = 1 + taper * o[:, 1]
    b = o[:, 0] * d[:, 0] + o[:, 2] * d[:, 2] - taper * d[:, 1] * side
    c = o[:, 0] ** 2 + o[:, 2] ** 2 - side**2
    square = b * b - a * c
    root = xp.sqrt(xp.maximum(square, 0))
    for sign in (-1, 1):
        t = (-b + sign * root) / a
        p = o + t[:, None] * d
        good = (square > 0) & (t > 1e-4) & (t < best) & (abs(p[:, 1]) <= 1)
        best = xp.where(good, t, best)
        n = xp.where(good[:, None], xp.stack([p[:, 0], -taper * (1 + taper * p[:, 1]), p[:, 2]], 1), n)
    for cap in (-1.0, 1.0):
        t = (cap - o[:, 1]) / d[:, 1]
        p = o + t[:, None] * d
        good = (t > 1e-4) & (t < best) & (xp.hypot(p[:, 0], p[:, 2]) <= 1 + taper * cap)
        best = xp.where(good, t, best)
        n = xp.where(good[:, None], xp.asarray([0, cap, 0]), n)
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
        direct = xp.maximum(0, normals @ xp.asarray(self.light))
        t = self.towards_light(points + 2e-3 * normals)
        direct = xp.where(xp.isfinite(t), self.shadow * 0.5, 1) * direct
        return (self.ambient * (0.85 + 0.15 * normals[:, 1]) + (1 - self.ambient) * 1.4 * direct)[:, None]

    def towards_light(self, points):
        """Return how far the solids are from points on the way to the light; points far from the object see it."""
        near = xp.linalg.norm(points, axis=1) < 2.5
        distances = xp.full(len(points), np.inf, np.float32)
        points, t = points[near], distances[near]
        for kind, half, axes, center, taper, _ in self.solids.parts:
            inverse = (axes / half).T
            o = ((points - xp.asarray(center)) @ xp.asarray(inverse).T).astype(np.float32)
            d = xp.broadcast_to(xp.asarray((inverse @ self.light).astype(np.float32)), o.shape)
            with np.errstate(all="ignore"):
                t = xp.minimum(t, INTERSECT[kind](o, d, taper)[0])
        distances[near] = t
        return distances

    def colors(self, origins, rays):
        """Return colours [n 3] along rays of unit length, and whether they meet a solid."""
        t, part, local, normal = self.solids.hit(origins, rays)
        colors = xp.zeros((len(rays), 3), np.float32)
        for number, (kind, half, *_, (picture, scale, offset)) in enumerate(self.solids.parts):
            chosen = part == number
            here = local[chosen]
            p = here * xp.asarray(half / 0.57)
            if kind == CUBE:
                face = xp.abs(here).argmax(1)[:, None]
                uv = xp.where(face == 0, p[:, [2, 1]], xp.where(face == 1, p[:, [0, 2]], p[:, :2]))
            else:
                flat = (kind == CYLINDER) & (xp.abs(here[:, 1:2]) > 0.999)
                around = xp.arctan2(here[:, 0], here[:, 2]) * (max(half[0], half[2]) / 0.57)
                uv = xp.where(flat, p[:, [0, 2]], xp.stack([around, p[:, 1]], 1))
            u, v = (uv * scale + xp.asarray(offset)).T
            colors[chosen] = look_up(self.pictures, picture, u, v)
        hit = part >= 0
        points = (origins + xp.where(hit, t, 0)[:, None] * rays)[hit]
        colors[hit] *= self.brightness(points, normal[hit])
        colors[~hit] = self.behind(origins[~hit], rays[~hit])
        return xp.clip(colors * (1 if self.kind in ("white", "plain") else xp.asarray(self.tone)), 0, 1), hit

    def behind(self, origins, rays):
        """Return the colours of rays that meet no solid."""
        if self.kind in ("white", "plain"):
            return xp.broadcast_to(xp.asarray(self.plain), rays.shape)
        turn = xp.asarray(self.turn)
        o, d = origins @ turn.T, rays @ turn.T
        best, face = xp.full(len(d), np.inf), xp.zeros(len(d), int)
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
                t = (place - o[:, axis]) / d[:, axis]
                # Walls between the camera and the object are left out, so that cameras may stand outside.
                good = (t > 1e-3) & (t < best) & ((d[:, axis] > 0) == bool(place > 0))
                best, face = xp.where(good, t, best), xp.where(good, number, face)
        far = xp.linalg.norm(o, axis=1)
        b, c = (d * o).sum(1), far**2 - (self.dome_radius + xp.maximum(0, far - self.dome_radius + 0.3)) ** 2
        dome = -b + xp.sqrt(xp.maximum(b * b - c, 0))
        sky = (best > dome) & (self.kind == "ground")
        best = xp.where(sky, dome, best)
        p = o + best[:, None] * d
        colors, normals = xp.zeros(d.shape, np.float32), xp.zeros(d.shape)
        for number in range(6):
            chosen = (face == number) & ~sky
            picture, scale, offset = self.wall_looks[number]
            axes = [0, 2] if number < 2 else ([2, 1] if number < 4 else [0, 1])
            u, v = (p[chosen][:, axes] * scale + xp.asarray(offset)).T
            colors[chosen] = look_up(self.pictures, picture, u, v)
            normals[chosen, [1, 1, 0, 0, 2, 2][number]] = [1, -1, 1, -1, 1, -1][number]
        colors[~sky] *= self.brightness((p @ turn)[~sky], (normals @ turn)[~sky])
        q = p[sky] / xp.linalg.norm(p[sky], axis=1, keepdims=True)
        picture, scale, (across, up) = self.wall_looks[6]
        u, v = xp.arctan2(q[:, 0], q[:, 2]), xp.arcsin(xp.clip(q[:, 1], -1, 1))
        colors[sky] = look_up(self.pictures, picture, u * scale + across, v * scale + up)
        return colors


def _on_host(array):
    return array if xp is np else xp.asnumpy(array)


def write_scene(job):
    """Write one capture: images, masks, `transforms.json` and points of the surface."""
    out, seed, index = job
    rng = np.random.default_rng([seed, index])
    if isinstance(PICTURES_OF[0], np.ndarray):
        PICTURES_OF[0] = xp.asarray(PICTURES_OF[0])
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
    frames, poses = [], []
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
        poses.append(np.eye(4))
        poses[-1][:3] = np.stack([right, np.cross(back, right), back, eye], 1)
        names = {"file_path": f"images/{frame:02d}.jpg", "mask_path": f"masks/{frame:02d}.png"}
        frames.append(names | {"transform_matrix": poses[-1].tolist()})
    together = 1 if xp is np else FRAMES  # on a processor, a few rays stay in its cache
    for first in range(0, FRAMES, together):
        pose = xp.asarray(np.stack(poses[first : first + together]))
        rays = (pose[:, None, :3, :3] @ xp.asarray(axes_rays)[..., None])[..., 0].reshape(-1, 3)
        rays /= xp.linalg.norm(rays, axis=1, keepdims=True)
        colors, hit = scene.colors(xp.repeat(pose[:, :3, 3], len(axes_rays), 0), rays)
        shape = together, SIZE, SAMPLES, SIZE, SAMPLES
        images = (255 * colors.reshape(*shape, 3).mean((2, 4)) + 0.5).astype(np.uint8)
        masks = (255 * hit.reshape(shape).mean((2, 4)) + 0.5).astype(np.uint8)
        for frame, image, mask in zip(frames[first:], _on_host(images), _on_host(masks), strict=False):
            Image.fromarray(image).save(folder / frame["file_path"], quality=95)
            Image.fromarray(mask).save(folder / frame["mask_path"])
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
    with Pool(os.cpu_count()) as pool:
        for done, _ in enumerate(pool.imap_unordered(write_scene, [(out, seed, i) for i in range(scenes)], 4)):
            if done % 100 == 0:
                print(done, flush=True)
