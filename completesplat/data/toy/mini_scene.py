"""Minis: an ellipsoid with a nose on plain grey, the smallest scenes with known alternatives for their back.

The patch lies opposite the nose, so an image of the nose shows where the patch is, but not which of four colours it
has. On marked minis the nose is light or dark, which determines the probability of each colour. They expose a model
that learns only the overall frequency of the colours.
"""

import numpy as np

from completesplat.data.toy.object_scene import (
    PATCH_COLORS,
    Blueprint,
    ToyScene,
    ball,
    color,
    orbit,
    placed,
    plain,
)
from completesplat.data.toy.raytracing import Patch, Surroundings

EVEN = np.full(len(PATCH_COLORS), 0.25)
LIGHT, DARK = np.full(3, 0.97), np.full(3, 0.05)
CHANCES = {"light": np.array([0.4, 0.3, 0.2, 0.1]), "dark": np.array([0.1, 0.2, 0.3, 0.4])}
"""Probabilities of the colours in `PATCH_COLORS`, by the nose of a marked mini."""

FROM_THE_FRONT = 0.35
"""Largest azimuth (radians) between the first camera and the nose, so that this camera never sees the patch."""

PATCH_EDGE, PATCH_TILT = 0.5, 0.2
"""The patch covers normals within 60 degrees of the direction opposite to the nose, tilted down by 0.2 radians."""


def draw_mini(rng: np.random.Generator, frames: int, marked: bool = False) -> ToyScene:
    """Draw a random mini and `frames` cameras on a full turn that starts in front of the nose."""
    mark = str(rng.choice(list(CHANCES))) if marked else "light"
    chances = CHANCES[mark] if marked else EVEN
    half_sizes = rng.uniform(0.36, 0.55, size=3)
    body = plain(color(rng.uniform(), rng.uniform(0.1, 0.5), rng.uniform(0.4, 0.9)))
    nose = ball((0, 0, half_sizes[2]), 0.13, plain(LIGHT if mark == "light" else DARK))
    blueprint = Blueprint("mini", (ball((0, 0, 0), half_sizes, body), nose), patched_part=0, patch_heights=(-1, 1))
    yaw = rng.uniform(0, 2 * np.pi)
    cameras = orbit(rng, frames, start=yaw + rng.uniform(-FROM_THE_FRONT, FROM_THE_FRONT))
    name = str(rng.choice(list(PATCH_COLORS), p=chances))
    level, down = np.cos(PATCH_TILT), np.sin(PATCH_TILT)
    facing = -np.array([level * np.sin(yaw), down, level * np.cos(yaw)])
    patch = Patch(0, facing, np.array(PATCH_COLORS[name]), np.array(blueprint.patch_heights), PATCH_EDGE, PATCH_EDGE)
    return placed(rng, blueprint, yaw, cameras, _grey(rng), patch, name, chances)


def _grey(rng: np.random.Generator) -> Surroundings:
    """Draw surroundings with a plain dome and a light from above, without ground."""
    azimuth, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.6, 0.9)
    level = np.sqrt(1 - height**2)
    light = np.array([level * np.sin(azimuth), height, level * np.cos(azimuth)])
    return Surroundings(-np.inf, np.zeros((2, 3)), np.zeros(3), 3.5, 0.0, 0.0, True, light, rng.uniform(0.6, 0.7))
