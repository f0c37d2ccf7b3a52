"""Notebook 05: what the fit repairs and breaks."""
