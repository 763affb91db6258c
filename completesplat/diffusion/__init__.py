"""Latent diffusion: conditioning, denoiser, guidance and sampling. It knows latents only, no Gaussians."""
