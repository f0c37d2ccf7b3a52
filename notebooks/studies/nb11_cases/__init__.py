"""Notebook 11: the test cases."""
