"""Notebook 09: what occlusion leaves open."""
