"""Stage 3 by closed-loop Gauss-Newton: the feedback solver, its coordinates, and the derivatives behind them."""
