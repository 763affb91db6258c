"""Packed store: a folder of memory-mapped Arrow files with sequences that were cropped, resized and encoded once."""
