"""Geometry of triangles."""

from __future__ import annotations

import numpy as np


def face_geometry(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (F, 3) by the right-hand rule (0 for degenerate faces) and areas (F,) in m^2; float64."""
    p = np.asarray(vertices, np.float64)[faces]
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    length = np.linalg.norm(cross, axis=-1)
    return cross / np.maximum(length, 1e-30)[:, None], 0.5 * length
