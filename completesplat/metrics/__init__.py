"""Metrics of images, of image sets and of samples, and their averages over scenes."""

PSNR_LIMIT = 100.0
"""Largest reported PSNR (dB); identical images have an infinite one, and averages must stay finite."""
