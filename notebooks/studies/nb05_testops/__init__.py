"""Notebooks 05a to 05d: what the fit repairs and breaks."""
