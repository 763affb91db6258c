"""Latent diffusion: conditioning, denoiser, guidance and sampling. Knows latents only, no Gaussians."""
