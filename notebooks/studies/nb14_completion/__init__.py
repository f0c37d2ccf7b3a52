"""Notebook 14: autocompletion."""
