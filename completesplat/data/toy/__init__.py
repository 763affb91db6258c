"""Procedural scenes, ray-traced and written to disk in the layouts of the real data sets."""

from completesplat.data.toy.data_sets import write, write_objects, write_rooms

__all__ = ["write", "write_objects", "write_rooms"]
