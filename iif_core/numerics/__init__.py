"""Numerical tools: array namespaces, Adam, Laplace distributions, connected components, image filters, colour conversion."""
