"""Notebook 02: rotations that jump."""
