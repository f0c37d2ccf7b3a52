"""Ground truth that we make ourselves: motions, bodies, cameras, detectors; it knows no model that is judged by it."""
