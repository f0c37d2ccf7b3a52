"""Motion diffusion, the thesis's chapter 4: training, sampling, inpainting, pose completion and denoising."""
