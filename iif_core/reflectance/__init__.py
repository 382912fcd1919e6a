"""Reflectance: the microfacet BRDF, the material of a point and the affine map of an object."""
