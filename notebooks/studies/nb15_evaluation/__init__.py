"""Notebook 15: evaluation."""
