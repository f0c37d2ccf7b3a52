"""Notebook 00: the first demo."""
