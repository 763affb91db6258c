"""The Variational AutoReconstructor: one image to a latent, a latent to a Splatter Image (paper, Section 3.2)."""
