"""Notebook 13: steps and seams."""
