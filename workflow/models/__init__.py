"""Learned models: checkpoints, weights of LPIPS, and the denoiser."""
