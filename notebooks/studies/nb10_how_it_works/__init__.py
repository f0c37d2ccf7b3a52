"""Notebook 10: what the diffusion model learns."""
