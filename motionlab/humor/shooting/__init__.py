"""Stage 3 by closed-loop Gauss-Newton: the feedback solver, its coordinates, the matrix and its derivatives."""
