"""Notebook 04: what the transition prior knows."""
