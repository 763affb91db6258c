"""Variational AutoReconstructor: from an image to a latent, from a latent to a Splatter Image (paper, Section 3.2)."""
