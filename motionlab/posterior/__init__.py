"""What observations leave open: posteriors over the few numbers that matter, by emcee."""
