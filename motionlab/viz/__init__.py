"""Pictures: ``scene.Scene``, ``movie.film`` and ``strip``, ``interactive.slider``.

Colours come from ``palette.ROLE``; ``mannequin`` is what a scene is made of, ``viewpoint`` from where it is seen.
"""

draft = False  # drawn quickly, to see that it draws: films of a few pictures, edges not smoothed; of smoke runs
