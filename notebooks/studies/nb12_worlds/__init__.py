"""Notebook 12: world or stuck root."""
