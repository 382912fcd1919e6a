"""Shapes as (vertices (n, 3) float64, faces (m, 3) int64), metres, z up, counter-clockwise seen from outside.

Every shape except the sheets is closed and has a positive signed volume.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from iif_core.numerics.arrays import unique_rows

Shape = tuple[np.ndarray, np.ndarray]
Point = Sequence[float]


def merge(*shapes: Shape) -> Shape:
    """Return several shapes as one."""
    offsets = np.cumsum([0] + [len(v) for v, _ in shapes])
    return (
        np.concatenate([v for v, _ in shapes]),
        np.concatenate([f + o for (_, f), o in zip(shapes, offsets[:-1], strict=True)]),
    )


def move(shape: Shape, offset: Point, turn: float = 0.0, tilt: float = 0.0) -> Shape:
    """Tilt a shape about x, turn it about z, then move it.

    Args:
        shape: vertices and faces.
        offset: (3,) metres.
        turn, tilt: degrees.

    Returns:
        The moved vertices, with the same faces.
    """
    a, b = np.radians([turn, tilt])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    return shape[0] @ (about_z @ about_x).T + np.asarray(offset, float), shape[1]


def stretch(shape: Shape, factors: Point) -> Shape:
    """Scale a shape along x, y and z about the origin by positive factors."""
    return shape[0] * np.asarray(factors, float), shape[1]


def sheet(origin: Point, edge_u: Point, edge_v: Point, step: float = 0.5) -> Shape:
    """Make an open rectangle that faces edge_u x edge_v.

    Args:
        origin: (3,) a corner, metres.
        edge_u, edge_v: (3,) the edges that meet there.
        step: edge of the squares that it is divided into, approximately.

    Returns:
        An open shape.
    """
    origin, edge_u, edge_v = (np.asarray(p, float) for p in (origin, edge_u, edge_v))
    nu, nv = (max(1, round(np.linalg.norm(e) / step)) for e in (edge_u, edge_v))
    return grid_sheet(origin, edge_u, edge_v, np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1))


def grid_sheet(
    origin: Point, edge_u: Point, edge_v: Point, u: np.ndarray, v: np.ndarray, hole: Sequence[float] | None = None
) -> Shape:
    """Make an open rectangle with given grid lines, perhaps with a hole.

    Args:
        origin: (3,) a corner, metres.
        edge_u, edge_v: (3,) the edges that meet there.
        u, v: grid lines as fractions of the edges, ascending from 0 to 1.
        hole: (u0, u1, v0, v1), on grid lines; the cells between them are left out.

    Returns:
        An open shape that faces edge_u x edge_v.
    """
    origin, edge_u, edge_v = (np.asarray(p, float) for p in (origin, edge_u, edge_v))
    gu, gv = np.meshgrid(u, v, indexing="ij")
    vertices = origin + gu.reshape(-1, 1) * edge_u + gv.reshape(-1, 1) * edge_v
    i, j = np.meshgrid(np.arange(len(u) - 1), np.arange(len(v) - 1), indexing="ij")
    if hole is not None:
        cu, cv = (u[:-1] + u[1:])[i] / 2, (v[:-1] + v[1:])[j] / 2
        keep = ~((cu > hole[0]) & (cu < hole[1]) & (cv > hole[2]) & (cv < hole[3]))
        i, j = i[keep], j[keep]
    a = (i * len(v) + j).ravel()
    b = a + len(v)
    faces = np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)])
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def box(low: Point, high: Point, bevel: float = 0.0) -> Shape:
    """Make an axis-parallel box; `bevel` metres (at most 0.4 of the thinnest side) are cut off every edge."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    if not (high > low).all():
        raise ValueError(f"box from {low} to {high} has no volume")
    bevel = min(bevel, 0.4 * float((high - low).min()))
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    centre, half = (low + high) / 2, (high - low) / 2
    if bevel == 0:
        return hull(centre + signs * half)
    insets = [np.where(np.arange(3) == axis, 0, bevel) for axis in range(3)]
    return hull(np.concatenate([centre + signs * (half - inset) for inset in insets]))


def hull(points: np.ndarray) -> Shape:
    """Return the convex hull, facing outward, in an order that does not depend on SciPy's version."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    normals = hull.equations[:, :3].round(6) + 0.0
    faces, middle = [], points.mean(0)
    for normal in np.unique(normals, axis=0):  # triangulate each flat side as a fan about its lowest vertex
        ring = np.unique(hull.simplices[(normals == normal).all(1)])
        axis = np.eye(3)[np.argmin(np.abs(normal))]
        right = np.cross(axis, normal)
        spokes = points[ring] - points[ring].mean(0)
        ring = ring[np.argsort(np.arctan2(spokes @ np.cross(normal, right), spokes @ right))]
        ring = np.roll(ring, -int(np.argmin(ring)))
        faces += [(ring[0], ring[i], ring[i + 1]) for i in range(1, len(ring) - 1)]
    faces = np.array(faces)
    corner = points[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert (np.einsum("ij,ij->i", normal, corner.mean(1) - middle) > 0).all()
    return points, faces


def wedge(base_low: Point, base_high: Point, top_low: Point, top_high: Point) -> Shape:
    """Make a frustum between two horizontal rectangles.

    Args:
        base_low, base_high: (x, y, z) corners of the lower rectangle.
        top_low, top_high: the same of the upper rectangle.

    Returns:
        A closed shape.
    """
    (x0, y0, z0), (x1, y1, _), (u0, v0, z1), (u1, v1, _) = base_low, base_high, top_low, top_high
    base = [[x, y, z0] for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    top = [[x, y, z1] for x, y in ((u0, v0), (u1, v0), (u1, v1), (u0, v1))]
    return hull(np.array(base + top, float))


def tub(low: Point, high: Point, wall: float, floor: float) -> Shape:
    """Make a box without a lid, closed as a solid.

    Args:
        low, high: (3,) outer corners, metres.
        wall, floor: thicknesses, metres.

    Returns:
        A closed shape.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    xi, yi = ([low[i], low[i] + wall, high[i] - wall, high[i]] for i in (0, 1))
    around = [(0, 0), (3, 0), (3, 3), (0, 3)]
    inner = [(1, 1), (2, 1), (2, 2), (1, 2)]
    rings = [(around, low[2]), (around, high[2]), (inner, high[2]), (inner, low[2] + floor)]
    vertices = np.array([[xi[i], yi[j], z] for ring, z in rings for i, j in ring])
    faces = [(0, 2, 1), (0, 3, 2), (12, 13, 14), (12, 14, 15)]
    for ring in range(3):
        for k in range(4):
            a, b = 4 * ring + k, 4 * ring + (k + 1) % 4
            faces += [(a, b, b + 4), (a, b + 4, a + 4)]
    return vertices, np.array(faces)


def mm(profile: str, radius: float = 1.0, height: float = 1.0) -> list[tuple[float, float]]:
    """Return a profile in metres from `radius,height` pairs in millimetres, times two factors.

    >>> mm("0,0 40,0 40,90")
    [(0.0, 0.0), (0.04, 0.0), (0.04, 0.09)]
    """
    pairs = (pair.split(",") for pair in profile.split())
    return [(float(r) / 1000 * radius, float(z) / 1000 * height) for r, z in pairs]


def lathe(profile: Sequence[tuple[float, float]], centre: Point = (0, 0, 0), segments: int = 28) -> Shape:
    """Turn a profile of (radius, z) about the vertical through `centre`.

    The profile starts and ends on the axis (radius 0) and has positive radii between. It runs up the outside of a solid, or up
    the outside and down the inside of a bowl.
    """
    profile = np.asarray(profile, float)
    angle = 2 * np.pi * np.arange(segments) / segments
    rim = profile[1:-1]
    height = np.broadcast_to(rim[:, 1:], (len(rim), segments))
    rings = np.stack([np.cos(angle) * rim[:, :1], np.sin(angle) * rim[:, :1], height], -1)
    vertices = np.concatenate([[[0, 0, profile[0, 1]]], rings.reshape(-1, 3), [[0, 0, profile[-1, 1]]]])
    k, after = np.arange(segments), (np.arange(segments) + 1) % segments
    last = len(vertices) - 1
    faces = [np.stack([np.zeros_like(k), 1 + after, 1 + k], 1)]
    for ring in range(len(rim) - 1):
        a, b = 1 + ring * segments + k, 1 + ring * segments + after
        faces += [np.stack([a, b, b + segments], 1), np.stack([a, b + segments, a + segments], 1)]
    top = 1 + (len(rim) - 1) * segments
    faces.append(np.stack([top + k, top + after, np.full_like(k, last)], 1))
    return vertices + np.asarray(centre, float), np.concatenate(faces)


def cylinder(base: Point, radius: float, height: float, bevel: float = 0.0, segments: int = 28) -> Shape:
    """Make an upright cylinder.

    Args:
        base: (3,) middle of its foot.
        radius, height: metres.
        bevel: metres that are cut off both rims.
        segments: around the axis.

    Returns:
        A closed shape.
    """
    side = [(radius, 0), (radius, height)]
    if bevel:
        side = [(radius - bevel, 0), (radius, bevel), (radius, height - bevel), (radius - bevel, height)]
    return lathe([(0, 0), *side, (0, height)], base, segments)


def sphere(centre: Point, radius: float, segments: int = 20) -> Shape:
    """Make a sphere of `segments` around the vertical and half as many from pole to pole."""
    polar = np.pi * np.arange(1, segments // 2) / (segments // 2)
    rings = [(radius * np.sin(t), -radius * np.cos(t)) for t in polar]
    return lathe([(0, -radius), *rings, (0, radius)], centre, segments)


def ellipsoid(centre: Point, half: Point, segments: int = 20, turn: float = 0.0) -> Shape:
    """Make an ellipsoid with half axes `half` (3,), turned about the vertical by `turn` degrees.

    Args:
        centre: (3,) its middle.
        half: (3,) half axes along x, y and z before the turn.
        segments: around the vertical.
        turn: degrees, counter-clockwise seen from above.

    Returns:
        A closed shape.
    """
    return move(stretch(sphere((0, 0, 0), 1.0, segments), half), centre, turn)


def tube(path: Sequence[Point], radius: float | Sequence[float], segments: int = 12) -> Shape:
    """Make a round rod along a polyline; `radius` may change from point to point."""
    path = np.asarray(path, float)
    radii = np.broadcast_to(np.asarray(radius, float), len(path))
    steps = np.diff(path, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    mitres = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    before = np.concatenate([steps[:1], steps])
    side = np.cross(steps[0], np.eye(3)[np.argmin(np.abs(steps[0]))])
    side /= np.linalg.norm(side)
    angle = 2 * np.pi * np.arange(segments) / segments
    rings = []
    for k, (point, mitre, r) in enumerate(zip(path, mitres, radii, strict=True)):
        step = before[k]
        if k > 1:  # the frame is carried around the corner without twist
            side = side - (side @ step) / (1 + before[k - 1] @ step) * (before[k - 1] + step)
        spokes = r * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(step, side))
        rings.append(point + spokes - (spokes @ mitre / (step @ mitre))[:, None] * step)
    vertices = np.concatenate([*rings, path[:1], path[-1:]])
    k, after = np.arange(segments), (np.arange(segments) + 1) % segments
    first, last = len(vertices) - 2, len(vertices) - 1
    faces = [np.stack([np.full_like(k, first), after, k], 1)]
    for ring in range(len(path) - 1):
        a, b = ring * segments + k, ring * segments + after
        faces += [np.stack([a, b, b + segments], 1), np.stack([a, b + segments, a + segments], 1)]
    top = (len(path) - 1) * segments
    faces.append(np.stack([top + k, top + after, np.full_like(k, last)], 1))
    return vertices, np.concatenate(faces)


def ring(centre: Point, radius: float, thickness: float, axis_u: Point, axis_v: Point, segments: int = 28) -> Shape:
    """Make a torus.

    Args:
        centre: (3,) metres.
        radius: of the circle inside the tube, metres.
        thickness: radius of the tube, metres.
        axis_u, axis_v: (3,) unit vectors of its plane, square to each other.
        segments: around the ring.

    Returns:
        A closed shape.
    """
    centre, u, v = (np.asarray(p, float) for p in (centre, axis_u, axis_v))
    around, across = 2 * np.pi * np.arange(segments) / segments, 2 * np.pi * np.arange(10) / 10
    spoke = np.cos(around)[:, None] * u + np.sin(around)[:, None] * v
    out, up = (radius + thickness * np.cos(across))[None, :, None], (thickness * np.sin(across))[None, :, None]
    vertices = (centre + spoke[:, None] * out + np.cross(u, v) * up).reshape(-1, 3)
    i, j = (g.ravel() for g in np.meshgrid(np.arange(segments), np.arange(10), indexing="ij"))
    a, b = i * 10 + j, (i + 1) % segments * 10 + j
    c, d = (i + 1) % segments * 10 + (j + 1) % 10, i * 10 + (j + 1) % 10
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def quarter(vertices: np.ndarray, faces: np.ndarray) -> Shape:
    """Split every face at the midpoints of its edges, which neighbours share: vertices (n', 3) float64 and faces (4 m, 3) int64,
    those of face i at 4 i ... 4 i + 3."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    edges, edge_of = unique_rows(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1))
    a, b, c = faces.T
    ab, bc, ca = len(vertices) + edge_of.reshape(-1, 3).T
    corners = (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)
    split = np.stack([np.stack(triangle, 1) for triangle in corners], 1)
    return np.concatenate([vertices, vertices[edges].mean(1)]), split.reshape(-1, 3)
