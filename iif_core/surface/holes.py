"""Small holes of a scan, closed: Open3D fills the loops of open edges, and what continues the surface around stays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iif_core.numerics.graph import component_labels
from iif_core.surface.simplify import MIN_AREA

SMOOTH = 0.5
"""Least cosine between the filling and the surface beside it for an edge of a hole to count as continued."""
CONTINUED = 0.8
"""Least share, by length, of the edges around a hole that the filling continues."""


class Closing(NamedTuple):
    """What closes the holes of a mesh.

    Attributes:
        faces: (k, 3) int64, corners among the vertices of the mesh, oriented as the faces around them.
        beside: (k,) int64 a face of the mesh beside the same hole, from which properties are taken over; it is of the part that
            most of the border of the hole is of.
        holes: how many were closed; area: of all of them, in square units of the vertices.
    """

    faces: NDArray
    beside: NDArray
    holes: int
    area: float


def close_holes(vertices: ArrayLike, faces: ArrayLike, widest: float, part: ArrayLike | None = None) -> Closing:
    """Find the faces that close the holes of a mesh up to a width.

    A hole is closed if its filling continues the surface around it. The rim of a lamp shade, of a box without a lid and of a
    curtain are loops of open edges too: their filling is square to the surface beside it, or folded back onto it.

    Args:
        vertices, faces: (n, 3) and (m, 3); vertices at the same place count as one.
        widest: largest extent of a hole along any axis, in the unit of the vertices; 0 = no hole is closed.
        part: (m,) number of the part that each face belongs to; None = all are of one.

    Returns:
        The faces, none where no hole is that small.
    """
    vertices, faces = np.asarray(vertices, np.float64).reshape(-1, 3), np.asarray(faces, np.int64).reshape(-1, 3)
    part = np.zeros(len(faces), np.int64) if part is None else np.asarray(part)
    nothing = Closing(np.zeros((0, 3), np.int64), np.zeros(0, np.int64), 0, 0.0)
    if widest <= 0 or not len(faces):
        return nothing

    # -------- edges of one face only, once vertices at the same place are one --------
    places, first, place = np.unique(vertices.astype(np.float32), axis=0, return_index=True, return_inverse=True)
    whole = place.ravel()[faces]
    solid = np.flatnonzero((whole != np.roll(whole, 1, 1)).all(1))
    start, end, of_face = _edges(whole[solid])
    border = _count(start, end, len(places)) == 1
    if not border.any():
        return nothing

    # -------- fillings of all loops, by Open3D, and the border that each of their edges shares --------
    filling = _filled(places, whole[solid], widest)
    if not len(filling):
        return nothing
    n, size = len(places), places[filling]
    normal = np.cross(size[:, 1] - size[:, 0], size[:, 2] - size[:, 0]).astype(np.float64)
    doubled = np.linalg.norm(normal, axis=1)
    a, b, triangle = _edges(filling)
    key = np.minimum(a, b) * n + np.maximum(a, b)
    known = np.minimum(start, end)[border] * n + np.maximum(start, end)[border]
    order = np.argsort(known)
    at = order[np.minimum(np.searchsorted(known[order], key), len(known) - 1)]
    shared = known[at] == key
    beside = solid[of_face[border][at]]
    # An edge that filling and face run through in opposite directions orients both alike.
    agrees = np.where(a == start[border][at], -1.0, 1.0)

    # -------- one patch for each hole: triangles that share an edge --------
    inner, edge = np.unique(key, return_inverse=True)
    patch = component_labels(len(filling) + len(inner), triangle, len(filling) + edge.ravel())[: len(filling)]
    patch = np.unique(patch, return_inverse=True)[1].ravel()
    count = int(patch.max()) + 1

    # -------- which of them continue the surface, and do so in the allowed width --------
    around = np.cross(*(vertices[faces[beside]][:, k] - vertices[faces[beside]][:, 0] for k in (1, 2)))
    scale = np.maximum(np.linalg.norm(around, axis=1) * doubled[triangle], 1e-300)
    cosine = agrees * (around * normal[triangle]).sum(1) / scale
    length = np.where(shared, np.linalg.norm(places[a] - places[b], axis=1), 0.0)
    total = np.bincount(patch[triangle], length, count)
    continued = np.bincount(patch[triangle], length * (cosine > SMOOTH), count)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, patch, size.min(1))
    np.maximum.at(high, patch, size.max(1))
    area = 0.5 * np.bincount(patch, doubled, count)
    good = (continued >= CONTINUED * total) & (area > MIN_AREA) & ((high - low).max(1) <= widest)

    # -------- their faces, turned as the surface is; each takes after the part with the longest border --------
    turned = np.bincount(patch[triangle], length * agrees, count) < 0
    kept = np.flatnonzero(good[patch] & (0.5 * doubled > MIN_AREA))
    new = np.where(turned[patch[kept], None], filling[kept][:, ::-1], filling[kept])
    owner = _longest(patch[triangle][shared], part[beside[shared]], length[shared], beside[shared], count)
    return Closing(first[new], owner[patch[kept]], int(good.sum()), float(area[good].sum()))


def _edges(faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Start, end and face of each directed edge, (3 m,)."""
    return faces.ravel(), np.roll(faces, -1, 1).ravel(), np.repeat(np.arange(len(faces)), 3)


def _count(start: NDArray, end: NDArray, n: int) -> NDArray:
    """How many faces have the edge, whichever way they run through it."""
    _, edge, count = np.unique(np.minimum(start, end) * n + np.maximum(start, end), return_inverse=True, return_counts=True)
    return count[edge.ravel()]


def _filled(places: NDArray, faces: NDArray, widest: float) -> NDArray:
    """Triangles (k, 3) that fill the loops of open edges; Open3D asks for the radius of a sphere around the hole."""
    import open3d as o3d

    mesh = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(places), o3d.core.Tensor(np.ascontiguousarray(faces)))
    found = mesh.fill_holes(hole_size=widest).triangle.indices.numpy()
    return found[len(faces) :].astype(np.int64)


def _longest(patch: NDArray, part: NDArray, length: NDArray, face: NDArray, count: int) -> NDArray:
    """For each patch a face of the part that has the longest border with it, (count,)."""
    kinds, kind = np.unique(part, return_inverse=True)
    pairs, pair = np.unique(patch * len(kinds) + kind.ravel(), return_inverse=True)
    border = np.bincount(pair.ravel(), length, len(pairs))
    one = np.zeros(len(pairs), np.int64)
    one[pair.ravel()] = face
    out = np.zeros(count, np.int64)
    order = np.argsort(border, kind="stable")  # the longest is written last
    out[pairs[order] // len(kinds)] = one[order]
    return out
