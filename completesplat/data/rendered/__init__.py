"""Meshes that Blender renders to data in CO3D's layout."""

from completesplat.data.rendered.rendering import render

__all__ = ["render"]
