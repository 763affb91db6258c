"""Benchmarks of speed and their opponents, side by side in one process. Nothing else imports this package."""
