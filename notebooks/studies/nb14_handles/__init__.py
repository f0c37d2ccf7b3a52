"""Notebook 14: poses from handles."""
