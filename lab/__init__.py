"""The laboratory: it measures what the product does, and makes what the product ships (docs/development/architecture.md).

`lab` imports `iif_core` and `workflow`; neither ever imports `lab` (a contract in `pyproject.toml`).
"""
