"""Reflectance: the microfacet BRDF."""
