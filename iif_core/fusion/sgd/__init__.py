"""The paper's optimiser (docs/method/fusion.md#sgd): `solve.solve_sgd`, with a compiled and a torch engine."""
