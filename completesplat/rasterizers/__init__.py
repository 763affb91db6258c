"""Swappable rasterizers: one protocol, one file per backend.

Every backend computes the same function, with gsplat's conventions: 0.3 px^2 of blur on the diagonal of the
projected covariance, alpha = min(max_alpha, opacity * exp(-sigma)) skipped below 1/255, front-to-back compositing
that stops before the transmittance would reach 1e-4. The constants come from one shared config.
"""

from completesplat.rasterizers.protocol import Rasterizer, Rendering, RenderingConstants

__all__ = ["Rasterizer", "Rendering", "RenderingConstants"]
