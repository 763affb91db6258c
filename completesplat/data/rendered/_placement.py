"""Place and scale of an object's faces, for the mesh renderer and for Blender's Python: NumPy alone."""

from typing import Any

import numpy as np

MOST = 0.99
FAR = 4.0  # share of the surface, and its reach times which faces count as stray


def stray_faces(corners: Any, sizes: Any, areas: Any) -> Any:
    """Return a mask of the faces that reach farther than `FAR` times the ball that holds `MOST` of the surface.

    The ball's centre is the median of the faces, weighted by area, which stray faces do not move.

    Args:
        corners: places of all faces' corners [n 3], one face after the other.
        sizes: number of corners of each face.
        areas: area of each face.
    """
    firsts = np.cumsum(sizes) - sizes
    weights = areas + 1e-300  # equal if no face has an area
    middle = [_quantile(places, weights, 0.5) for places in corners[firsts].T]
    reaches = np.maximum.reduceat(np.linalg.norm(corners - middle, axis=1), firsts)
    return reaches > FAR * _quantile(reaches, weights, MOST)


def _quantile(values: Any, weights: Any, share: float) -> Any:
    """Return the smallest value such that values up to it have this share of the weight."""
    order = values.argsort()
    total = weights[order].cumsum()
    return values[order][np.searchsorted(total, share * total[-1])]
