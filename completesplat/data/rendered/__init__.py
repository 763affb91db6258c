"""Meshes that Blender renders to data in CO3D's layout."""
