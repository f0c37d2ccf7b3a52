"""Pictures: ``scene.Scene``, ``movie.film`` and ``strip``, ``interactive.slider``, ``overlay.overlay``, ``plots``.

Colours come from ``palette.ROLE``; ``render`` chooses the window; the rest is what these are made of.
"""
