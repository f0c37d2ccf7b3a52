"""What two or more notebooks need and nobody else."""
