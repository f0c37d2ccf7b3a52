"""Measures how good a motion is: poses, smoothness, contact with the floor. Units in name or docstring."""
