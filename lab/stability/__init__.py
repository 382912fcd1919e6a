"""How many digits kernels, solvers and stages have, and where they end."""
