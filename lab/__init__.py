"""Laboratories: programs that make what the product ships, such as the weights of its learned prior.

`lab` imports `iif_core` and `workflow`; neither ever imports `lab` (a contract in `pyproject.toml`).
"""
