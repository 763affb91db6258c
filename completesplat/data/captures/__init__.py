"""Captures: a user's photos with known cameras, as a `transforms.json` or a COLMAP model."""
