"""Notebook 03: skinning weights."""
