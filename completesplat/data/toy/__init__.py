"""Procedural scenes, ray-traced and written to disk in the layouts of the real data sets."""

from completesplat.data.toy.objects import write_objects

__all__ = ["write_objects"]
