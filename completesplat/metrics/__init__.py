"""Metrics of images, of image sets and of samples, and their averages over scenes."""
