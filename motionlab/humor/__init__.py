"""HuMoR: a conditional VAE over frame-to-frame transitions, and the test-time optimisation that fits it. Thesis 3."""
