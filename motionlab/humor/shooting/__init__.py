"""Stage 3 by closed-loop Gauss-Newton: the feedback solver, its coordinates, its matrix and the derivatives."""
