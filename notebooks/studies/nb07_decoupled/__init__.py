"""Notebook 07: the chain of the roll-out cut."""
