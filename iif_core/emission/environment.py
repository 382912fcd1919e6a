"""Light from outside: where rays go that leave the mesh (METHOD 2.6)."""

from __future__ import annotations

import numpy as np


def cosine_directions(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One unit vector (n, 3) a normal (n, 3), with density cos / pi around it."""
    sphere = rng.normal(size=normals.shape)
    sphere /= np.maximum(np.linalg.norm(sphere, axis=1, keepdims=True), 1e-12)
    # A uniform point on the sphere that touches the surface from above is cosine-distributed.
    way = normals + sphere
    return way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
