"""Notebook 99: what became of every claim."""
