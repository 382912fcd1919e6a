"""The paper's optimiser (METHOD 2.3): `solve_base_sgd`; see solve.py."""
