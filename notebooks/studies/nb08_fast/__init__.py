"""Notebook 08: how fast a fit can be."""
