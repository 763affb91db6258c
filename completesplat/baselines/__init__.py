"""Baselines of the paper's model."""
