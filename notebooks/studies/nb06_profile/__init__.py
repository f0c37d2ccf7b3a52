"""Notebook 06: where the time goes."""
