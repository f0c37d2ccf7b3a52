"""Notebook 15: what more data, steps, stopping, noise and a latent space do."""
