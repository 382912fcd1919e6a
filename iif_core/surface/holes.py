"""Small holes of a scanned mesh, and the triangles that close them (docs/method/numerics.md#holes-of-the-mesh)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iif_core.surface.triangles import face_geometry

FLUSH = 0.5
"""Least cosine between the plane of a hole and the surface around it. The rim of a cup or a niche stands across its opening; the
outline of a sheet faces the other way."""
ROUNDING = 1e-9
"""Corners of a rim are in line if the area between them is less than this share of the square around the rim."""


@dataclass(frozen=True)
class Closed:
    """The triangles that close holes.

    Attributes:
        faces: (t, 3) int32 vertices, oriented as the surface around.
        beside: (t,) int64, a face at the rim of the hole.
        width: (h,) greatest distance between two vertices of the rim of each hole, metres.
        area: m^2 of all triangles.
    """

    faces: NDArray
    beside: NDArray
    width: NDArray
    area: float


def close_holes(vertices: NDArray, faces: NDArray, widest: float) -> Closed:
    """Close the holes of a mesh that are at most `widest` metres across and flush with the surface around them.

    A hole is a loop of edges that one face alone has. Run through against the direction of its faces, it has the area vector
    A = 1/2 sum p_i x p_(i+1). With N the sum of the area vectors of the faces at the rim, it is closed if A . N > FLUSH |A| |N|,
    by cutting off ears in the plane across A. A loop that crosses itself in this plane, or has more surface inside, stays
    open.

    Args:
        vertices: (n, 3) metres; vertices at the same place count as one.
        faces: (m, 3).
        widest: metres; 0 closes nothing.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    found, beside, width = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)], []
    if widest > 0 and len(faces):
        normal, area = face_geometry(vertices, faces)
        across = normal * area[:, None]
        loops = list(_loops(vertices, faces))
        border = np.unique(np.concatenate([loop for loop, _ in loops])) if loops else np.zeros(0, np.int64)
        for loop, rim in loops:
            points = vertices[loop]
            if (np.ptp(points, axis=0) > widest).any():
                continue
            size = float(np.linalg.norm(points[:, None] - points[None], axis=-1).max())
            middle = points - points.mean(0)
            plane = 0.5 * np.cross(middle, np.roll(middle, -1, axis=0)).sum(0)
            around = across[np.unique(rim)].sum(0)
            lengths = np.linalg.norm(plane) * np.linalg.norm(around)
            if size > widest or not plane @ around > FLUSH * lengths:
                continue
            others = vertices[np.setdiff1d(border, loop)] - points.mean(0)
            others = others[np.abs(others @ plane) < FLUSH * size * np.linalg.norm(plane)]
            outline, loose = np.split(_flat(np.concatenate([middle, others]), plane), [len(loop)])
            if _encloses(outline, loose).any():
                continue
            ears = _ears(outline)
            if len(ears):
                found.append(loop[ears])
                beside.append(np.full(len(ears), rim[0]))
                width.append(size)
    new = np.concatenate(found)
    return Closed(new.astype(np.int32), np.concatenate(beside), np.array(width), float(face_geometry(vertices, new)[1].sum()))


def _loops(vertices: NDArray, faces: NDArray) -> Iterator[tuple[NDArray, NDArray]]:
    """Yield the vertices of each loop of border edges, against the direction of its faces, and the face at each edge."""
    _, first, place = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    own = first[place.reshape(-1)][faces]  # one vertex for each place
    start, end = own.ravel(), np.roll(own, -1, axis=1).ravel()
    owner = np.repeat(np.arange(len(faces)), 3)
    count = len(vertices)
    _, inverse, uses = np.unique(np.minimum(start, end) * count + np.maximum(start, end), return_inverse=True, return_counts=True)
    border = (uses[inverse] == 1) & (start != end)
    onward = defaultdict(list)
    for a, b, face in zip(start[border], end[border], owner[border], strict=True):
        onward[int(b)].append((int(a), int(face)))
    # A walk that comes back to a vertex cuts off the loop between; a walk that ends belongs to no loop.
    for begin in list(onward):
        while onward[begin]:
            path, at = [(begin, -1)], {begin: 0}
            while onward[path[-1][0]]:
                vertex, face = onward[path[-1][0]].pop()
                if vertex in at:
                    loop = [*path[at[vertex] + 1 :], (vertex, face)]
                    if len(loop) > 2:
                        yield np.array([v for v, _ in loop]), np.array([f for _, f in loop])
                    for v, _ in path[at[vertex] + 1 :]:
                        del at[v]
                    del path[at[vertex] + 1 :]
                else:
                    at[vertex] = len(path)
                    path.append((vertex, face))


def _flat(points: NDArray, normal: NDArray) -> NDArray:
    """Return points (n, 3) in a plane (n, 2), counter-clockwise about its normal."""
    n = normal / np.linalg.norm(normal)
    u = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    u /= np.linalg.norm(u)
    return np.stack([points @ u, points @ np.cross(n, u)], 1)


def _encloses(outline: NDArray, points: NDArray) -> NDArray:
    """Whether a polygon (n, 2) has points (k, 2) inside: a ray to the right crosses its edges an odd number of times."""
    a, b = outline[:, None], np.roll(outline, -1, axis=0)[:, None]
    spans = (a[..., 1] > points[:, 1]) != (b[..., 1] > points[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[..., 0] + (points[:, 1] - a[..., 1]) * (b[..., 0] - a[..., 0]) / (b[..., 1] - a[..., 1])
    return (spans & (points[:, 0] < at)).sum(0) % 2 == 1


def _ears(points: NDArray) -> NDArray:
    """Triangulate a simple polygon (n, 2), counter-clockwise, by cutting off ears; (n - 2, 3), or nothing where that fails."""
    left, ears, least = list(range(len(points))), [], ROUNDING * float(np.ptp(points, axis=0).max()) ** 2
    while len(left) > 3:
        for i in range(len(left)):
            corner = left[i - 1], left[i], left[(i + 1) % len(left)]
            a, b, c = points[list(corner)]
            others = points[[k for k in left if k not in corner]]
            if _twice_area(a, b, c) > least and not _inside(others, a, b, c, least).any():
                ears.append(corner)
                del left[i]
                break
        else:
            return np.zeros((0, 3), np.int64)
    ears.append(tuple(left))
    return np.array(ears) if _twice_area(*points[left]) > least else np.zeros((0, 3), np.int64)


def _twice_area(a: NDArray, b: NDArray, c: NDArray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _inside(points: NDArray, a: NDArray, b: NDArray, c: NDArray, least: float) -> NDArray:
    """Whether points (n, 2) lie in a counter-clockwise triangle or on its border."""
    edges = ((a, b), (b, c), (c, a))
    side = [(q[0] - p[0]) * (points[:, 1] - p[1]) - (q[1] - p[1]) * (points[:, 0] - p[0]) for p, q in edges]
    return np.min(side, axis=0) >= -least if len(points) else np.zeros(0, bool)
