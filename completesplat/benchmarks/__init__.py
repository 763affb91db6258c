"""Benchmarks of speed, with baselines that run side by side in one process. Nothing else imports this package."""
