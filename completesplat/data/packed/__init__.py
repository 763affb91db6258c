"""Sequences cropped, resized and encoded once: a folder of Arrow files that is read memory-mapped."""
