"""Motion diffusion: the model of the thesis's chapter 4, and what can be asked of it."""
