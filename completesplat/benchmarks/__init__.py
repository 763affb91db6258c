"""Benchmark of the rasterizers, side by side in one process. Nothing else imports this package."""
