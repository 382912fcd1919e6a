"""Emission: which surface shines by itself, in which groups, and how brightly (METHOD 2.0, 2.4-2.6, 7a).

candidates -> groups -> (radiance cache of the rest) -> rows of the transport matrix -> gains, solver, pruning.
"""
