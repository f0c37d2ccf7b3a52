"""Ground truth that we make ourselves: motions, bodies, cameras, detectors."""
