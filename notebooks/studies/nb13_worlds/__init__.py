"""Notebook 13: world or stuck root."""
