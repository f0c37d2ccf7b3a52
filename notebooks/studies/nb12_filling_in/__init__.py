"""Notebook 12: who fills in what is hidden of a motion best, and is it diffusion that does it?"""
