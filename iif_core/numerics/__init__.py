"""Numerical ground: array namespaces, Laplace distributions, separable filters, colour transfer functions."""
