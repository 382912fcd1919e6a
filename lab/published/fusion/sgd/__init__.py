"""The paper's optimiser (docs/method/fusion.md#sgd): `solve.solve_sgd`."""
