"""Walls, floor and ceiling that a scan lacks: planes around it, put together to one closed surface."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, HalfspaceIntersection

from iif_core.surface.triangles import face_crosses, face_geometry

ALIKE = float(np.cos(np.radians(10.0)))
"""Cosine of the largest angle between normals of one direction."""
BESIDE = 0.1
"""Thickness (m) of the layer in which faces of one direction make a plane."""
LEAST = 0.02
"""Least share of the area of a mesh that makes a plane of it."""
BEYOND = 0.01
"""Largest share of the area that may lie behind a plane that bounds the room: what was scanned through a window."""
SHOWN = 0.01
"""Least share of points in a layer that tells how far a room reaches."""
SQUARE = 0.004
"""Least share of the area that makes a plane along a given axis, of which only the place is to be found."""
THIN = 0.05
"""Thickness (m) of the layers in which it is looked for."""
SNAPS = float(np.cos(np.radians(3.0)))
"""Cosine of the angle up to which a plane is square to a given axis, and its tilt is noise."""
_BINS = 32  # of normals, along each axis
_SHIFTS, _FITS = 8, 6
_DIRECTIONS = 24  # of planes that are looked at, the largest first


class Enclosure(NamedTuple):
    """A closed convex surface.

    Attributes:
        vertices: (n, 3) float64; faces: (m, 3) int64, whose normals point inward.
        side: (m,) int64, of each face.
        normal: (s, 3) float64 unit, of each side, inward.
        from_plane: (s,) bool, the side prolongs a plane of the mesh; else it bounds the extent.
    """

    vertices: NDArray
    faces: NDArray
    side: NDArray
    normal: NDArray
    from_plane: NDArray


def enclosure(
    vertices: ArrayLike,
    faces: ArrayLike,
    within: ArrayLike,
    kind: Literal["box", "planes"],
    margin: float = 0.02,
    beyond: float = BEYOND,
    noise: float = 0.0,
    shown: ArrayLike | None = None,
    square: ArrayLike | None = None,
) -> Enclosure:
    """Build the closed surface around a scan.

    `box` has six sides, along the three directions at right angles that most area of the scan faces. `planes` has the large
    planes of the scan that next to nothing lies behind, prolonged until they meet, and sides of that box where there are none.

    Args:
        vertices, faces: (n, 3), metres, and (m, 3) of the scan, of which some have an area.
        within: (k, 3) points that are inside, at least one: cameras.
        kind: which of the two.
        margin: distance (m) of the sides behind what they close, so that walls of the scan stay in front.
        beyond: largest share of the area that may lie behind a plane that bounds the room.
        noise: share of the area that is left out at each end of the extent; 0 = the extent of all vertices.
        shown: (p, 3) further points of surface, of which some may be far off; sides at the extent lie no nearer than the
            outermost layer that holds one in a hundred of them.
        square: (3, 3) axes of a room, unit and at right angles: planes that are nearly square to one of them are (`SNAPS`), and
            where no large plane bounds it along one of them, a smaller one does (`SQUARE`).

    Returns:
        The surface. It contains all points, and the scan but for what lies behind its planes and for noise.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    within = np.asarray(within, np.float64).reshape(-1, 3)
    normal, area = face_geometry(vertices, faces)
    axes_found = directions(normal, area)

    middle = vertices[faces].mean(1)

    # -------- planes of the scan that have nearly all of it, and every camera, on one side --------
    found = np.zeros((0, 4))
    if kind == "planes":
        signed = [sign * direction for direction in axes_found for sign in (1.0, -1.0)]
        planes = [_bounding(n, middle, normal, area, within, beyond) for n in signed]
        found = np.array([plane for plane in planes if plane is not None]).reshape(-1, 4)
        if square is not None:
            both = np.concatenate([np.asarray(square, np.float64), -np.asarray(square, np.float64)])
            found = found[(found[:, :3] @ both.T < SNAPS).all(1)]
            for least in (LEAST, SQUARE):
                lacking = [n for n in both if (found[:, :3] @ n < ALIKE).all()]
                planes = [_bounding(n, middle, normal, area, within, beyond, least, is_axis=True) for n in lacking]
                found = np.concatenate([found, np.array([plane for plane in planes if plane is not None]).reshape(-1, 4)])
        axes_found = np.concatenate([found[:, :3], axes_found])  # a plane tells its direction better than normals do

    # -------- sides along the axes of the room where there is none, at the extent of everything --------
    axes = _right_angled(axes_found)
    outward = np.concatenate([axes, -axes])
    outward = outward[(outward @ found[:, :3].T < ALIKE).all(1)]
    extent = [_end(middle @ n, area, noise) if noise > 0 else (vertices[np.unique(faces)] @ n).max() for n in outward]
    bound = np.maximum(extent, (within @ outward.T).max(0)) if len(outward) else np.zeros(0)
    if shown is not None and len(np.asarray(shown)) and len(outward):
        bound = np.maximum(bound, [_outermost(np.asarray(shown, np.float64) @ n) for n in outward])

    both = np.concatenate([found[:, :3], outward]), np.concatenate([found[:, 3], bound]) + margin
    return _polyhedron(*both, np.arange(len(both[0])) < len(found), within.mean(0))[0]


def moved(sides: Enclosure, place: ArrayLike) -> tuple[Enclosure, NDArray]:
    """Return the same surface with each side at n . x = `place` (s,), and the numbers of the sides that are left of it."""
    place = np.asarray(place, np.float64)
    return _polyhedron(-sides.normal, -place, sides.from_plane, sides.vertices.mean(0))


def fitted_plane(
    outward: NDArray, own: NDArray, middle: NDArray, normal: NDArray, area: NDArray, beside: float = BESIDE
) -> tuple[NDArray, NDArray]:
    """Fit a plane to faces by least squares, and again to those beside it, as their normals alone would not tell it.

    Args:
        outward: (3,) unit, about the direction.
        own: (m,) bool, the faces to begin with.
        middle, normal, area: (m, 3), (m, 3) and (m,) of all faces.
        beside: largest distance of a face from the plane.

    Returns:
        The direction (3,), and (m,) bool: the faces that are of the plane.
    """
    for _ in range(_FITS):
        if not area[own].sum() > 0:
            break
        centre = np.average(middle[own], axis=0, weights=area[own])
        apart = middle[own] - centre
        axis = np.linalg.eigh((apart * area[own, None]).T @ apart)[1][:, 0]
        axis = axis if axis @ outward > 0 else -axis
        if axis @ outward < ALIKE:  # too little surface to tell
            break
        outward = axis
        own = (np.abs(normal @ outward) >= ALIKE) & (np.abs((middle - centre) @ outward) <= beside)
    return outward, own


def directions(normal: NDArray, area: NDArray) -> NDArray:
    """Return directions (k, 3) that much of the area faces, whichever way round, the largest first."""
    # Normals become the means of bins of a few degrees; a face and one that is turned over are of the same.
    turned = np.where(_first_sign(normal)[:, None] < 0, -normal, normal)
    key = (np.rint(turned * _BINS).astype(np.int64) + _BINS) @ [(2 * _BINS + 1) ** 2, 2 * _BINS + 1, 1]
    of_face = np.unique(key, return_inverse=True)[1].ravel()
    weight = np.bincount(of_face, area)
    axis = np.stack([np.bincount(of_face, area * component) for component in turned.T], 1)
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-300)
    found, left = [], weight.copy()
    while len(found) < _DIRECTIONS:
        seeds = np.argsort(-left, kind="stable")[:64]
        mean = axis[seeds[np.argmax((np.abs(axis[seeds] @ axis.T) >= ALIKE) @ left)]]
        for _ in range(_SHIFTS):  # to the middle of what is there; the mean of axes is the eigenvector of their moments
            near = np.abs(axis @ mean) >= ALIKE
            mean = np.linalg.eigh((axis[near] * left[near, None]).T @ axis[near])[1][:, -1]
        near = np.abs(axis @ mean) >= ALIKE
        if left[near].sum() < LEAST * weight.sum() and found:
            break
        found.append(mean * (_first_sign(mean[None])[0] or 1.0))
        left[near] = 0.0
        if not left.any():
            break
    return np.array(found)


def _first_sign(vector: NDArray) -> NDArray:
    """Return the sign (n,) of the first component of vectors (n, 3) that is not small."""
    large = np.abs(vector) > 0.5 / _BINS
    return np.sign(np.take_along_axis(vector, large.argmax(1)[:, None], 1)[:, 0])


def _end(place: NDArray, area: NDArray, noise: float) -> float:
    """Return the place beyond which a share `noise` of the area lies."""
    order = np.argsort(place)
    share = np.cumsum(area[order]) / area.sum()
    return float(place[order][min(np.searchsorted(share, 1.0 - noise), len(order) - 1)])


def _outermost(place: NDArray) -> float:
    """Return the middle of the outermost layer, of thickness `BESIDE`, that holds a share `SHOWN` of places (p,): points on a
    wall lie together, those that are wrong lie apart."""
    layer = ((place - place.min()) / BESIDE).astype(np.int64)
    layer = np.unique(layer, return_inverse=True)[1].ravel()  # however far the stray ones are
    full = np.flatnonzero(np.bincount(layer) >= SHOWN * len(place))
    return float(np.median(place[layer == full[-1]] if len(full) else place))


def _right_angled(directions: NDArray) -> NDArray:
    """Return three axes (3, 3) at right angles: the first direction, the next that is nearly square to it, and their cross."""
    first = directions[0]
    square = directions[np.abs(directions @ first) < np.sqrt(1 - ALIKE**2)]
    second = square[0] if len(square) else np.eye(3)[np.abs(first).argmin()]
    second = second - (second @ first) * first
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)])


def _bounding(
    outward: NDArray,
    middle: NDArray,
    normal: NDArray,
    area: NDArray,
    within: NDArray,
    beyond: float,
    least: float = LEAST,
    is_axis: bool = False,
) -> NDArray | None:
    """Return the outermost plane of one direction (4,): n and d with n . x = d; None = none bounds the room.

    Args:
        outward: (3,) unit.
        middle, normal, area: (m, 3), (m, 3) and (m,) of the faces.
        within: (k, 3) points that must be inside.
        beyond: largest share of the area behind the plane.
        least: least share of the area that makes a plane.
        is_axis: the plane is square to `outward`, where its surface lies in the mean; otherwise its direction is fitted, and it
            lies at its outer border.
    """
    thick = THIN if is_axis else BESIDE
    place, faces_it = middle @ outward, np.abs(normal @ outward) >= ALIKE
    layer = ((place - place.min()) / thick).astype(np.int64)
    own, every = np.bincount(layer, area * faces_it, layer.max() + 2), np.bincount(layer, area, layer.max() + 2)
    behind = np.append(np.cumsum(every[::-1])[::-1], 0.0)
    # A plane may lie across the border of two layers.
    two = own[:-1] + own[1:]
    fits = (two >= least * area.sum()) & (behind[2 : len(two) + 2] <= beyond * area.sum())
    for k in np.flatnonzero(fits)[::-1]:
        better, of_plane = outward, faces_it & (layer >= k) & (layer <= k + 1)
        if not is_axis:
            better, of_plane = fitted_plane(outward, of_plane, middle, normal, area)
        if not of_plane.any():
            continue
        at = float(np.average(place[of_plane], weights=area[of_plane]) if is_axis else (middle[of_plane] @ better).max())
        if at >= (within @ better).max():
            return np.append(better, at)
    return None


def _polyhedron(outward: NDArray, bound: NDArray, from_plane: NDArray, inside: NDArray) -> tuple[Enclosure, NDArray]:
    """Put the half-spaces n . x <= bound together; `inside`: (3,) a point that lies in all of them. Also returns which of them
    bound the whole."""
    corners = HalfspaceIntersection(np.column_stack([outward, -bound]), inside).intersections
    size = np.ptp(corners, axis=0).max()
    corners = np.unique(np.round(corners / (1e-9 * size)).astype(np.int64), axis=0) * (1e-9 * size)
    hull = ConvexHull(corners)
    corners, faces = corners[hull.vertices], np.searchsorted(hull.vertices, hull.simplices, sorter=np.argsort(hull.vertices))
    faces = np.argsort(hull.vertices)[faces]
    # The front of a face is inside.
    normal = hull.equations[:, :3]
    turned = np.einsum("ij,ij->i", face_crosses(corners, faces), normal) > 0
    faces[turned] = faces[turned][:, ::-1]
    used, side = np.unique((normal @ outward.T).argmax(1), return_inverse=True)
    return Enclosure(corners, faces.astype(np.int64), side.ravel(), -outward[used], from_plane[used]), used
