"""Lamps of two descriptions of one room, matched by the surface that they share and by where they are
(lab/docs/evaluation.md#relighting)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from iif_core.surface.triangles import face_geometry

Array = np.ndarray

NEAR = 0.3
"""Metres within which emitting surface that is not a lamp's own counts as that lamp's: a shade around a bulb, a blind before a
pane."""
POINTS = 256
"""Points of each lamp to which distances are measured."""


@dataclass(frozen=True)
class Lamp:
    """An emitting object.

    Attributes:
        lamp: its object id; name: of the object.
        faces: (k,) int64 ids.
        centre: (3,) mean of its surface, metres; area: m^2.
        power: area times mean radiance of the three channels, for a ranking.
    """

    lamp: int
    name: str
    faces: Array
    centre: Array
    area: float
    power: float


def lamps_of(
    vertices: ArrayLike, faces: ArrayLike, object_id: ArrayLike, radiance: ArrayLike, names: list[str] | None = None
) -> list[Lamp]:
    """Return the lamps of a mesh, the strongest first: one for each object with emitting faces.

    Args:
        vertices: (n, 3) metres; faces: (m, 3).
        object_id: (m,) int.
        radiance: (m, 3) linear, 0 = dark.
        names: of the objects by id.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    object_id, radiance = np.asarray(object_id), np.asarray(radiance, np.float64)
    emits = (radiance > 0).any(1)
    _, areas = face_geometry(vertices, faces)
    out = []
    for lamp in np.unique(object_id[emits]).tolist():
        own = np.flatnonzero(emits & (object_id == lamp))
        weight = np.maximum(areas[own], 1e-12)
        centre = (vertices[faces[own]].mean(1) * weight[:, None]).sum(0) / weight.sum()
        power = float((areas[own] * radiance[own].mean(1)).sum())
        name = names[lamp] if names is not None and 0 <= lamp < len(names) else f"object{lamp}"
        out.append(Lamp(int(lamp), name, own, centre, float(areas[own].sum()), power))
    return sorted(out, key=lambda one: (-one.power, one.lamp))


def match_faces(lamps: list[Lamp], vertices: ArrayLike, faces: ArrayLike, emits: ArrayLike, near: float = NEAR) -> Array:
    """Assign emitting faces of another description of the same mesh to lamps.

    A face that belongs to a lamp is that lamp's. Any other goes to the lamp whose surface is nearest to its centre, if that is
    within `near` metres.

    Args:
        lamps: of the first description.
        vertices: (n, 3) metres; faces: (m, 3), the same mesh.
        emits: (m,) bool, faces that emit in the second description.

    Returns:
        (m,) int64 position in `lamps`; -1 for faces that are dark, or that belong to no lamp.
    """
    from scipy.spatial import cKDTree

    vertices, faces, emits = np.asarray(vertices, np.float64), np.asarray(faces), np.asarray(emits, bool)
    out = np.full(len(faces), -1, np.int64)
    if not lamps:
        return out
    for number, lamp in enumerate(lamps):
        out[lamp.faces] = number
    out[~emits] = -1
    rest = np.flatnonzero(emits & (out < 0))
    if len(rest):
        points = [_points(vertices, faces[lamp.faces]) for lamp in lamps]
        owner = np.repeat(np.arange(len(lamps)), [len(p) for p in points])
        distance, nearest = cKDTree(np.concatenate(points)).query(vertices[faces[rest]].mean(1))
        out[rest] = np.where(distance <= near, owner[nearest], -1)
    return out


def _points(vertices: Array, faces: Array) -> Array:
    """(POINTS + k, 3) points spread over triangles by area, and their corners' means; the same each time."""
    rng = np.random.default_rng(0)
    _, areas = face_geometry(vertices, faces)
    share = areas / areas.sum() if areas.sum() > 0 else np.full(len(faces), 1 / len(faces))
    chosen = rng.choice(len(faces), POINTS, p=share)
    root, second = np.sqrt(rng.random(POINTS)), rng.random(POINTS)
    # Barycentric coordinates with a square root are uniform over a triangle.
    weights = np.stack([1 - root, root * (1 - second), root * second], 1)
    return np.concatenate([np.einsum("ij,ijk->ik", weights, vertices[faces[chosen]]), vertices[faces].mean(1)])
