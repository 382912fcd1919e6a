"""The paper's optimiser (lab/docs/published.md#sgd): `solve.solve_sgd`."""
