"""Notebook 01: the corpus against recordings."""
