"""Stage 3 with its chain cut, as the thesis's experiments have it (3.3): energy, searches, trials, tuning."""
