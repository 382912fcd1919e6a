"""The paper's optimiser (METHOD 2.3): `solve_base_sgd`; see solve.py."""

from .options import SgdOptions, sgd_options
from .solve import SgdFit, converged, solve_base_sgd

__all__ = ["SgdFit", "SgdOptions", "converged", "sgd_options", "solve_base_sgd"]
