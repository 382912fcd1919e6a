"""A mesh as a scan of a room has it: bent, with holes, and decimated (lab/docs/simulated.md#as-captured)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from iif_core.numerics.arrays import unique_rows
from iif_core.surface.holes import close_holes
from iif_core.surface.simplify import clean, simplify
from iif_core.surface.triangles import face_geometry
from workflow.settings.source import PhotographedSource

Array = np.ndarray

BULGE = 0.008
"""Median over the surface of the displacement along its normal, metres."""
CORRELATION = 0.5
"""Correlation length of the displacement in metres: at this distance the correlation is exp(-1/2)."""
HOLES = 0.03
"""Share of the area that is missing."""
HOLE = (0.03, 0.15)
"""Smallest and largest radius of a hole, metres."""
KEPT = 0.25
"""Share of the faces that decimation keeps."""
EDGE = 0.1
"""Longest edge in metres before the mesh is bent: a fifth of the correlation length."""
NEAR = 10.0
"""Distance in metres to the nearest camera up to which that is so; beyond, edges grow with it, as the pixels of a scan do."""
_WAVES = 64


@dataclass(frozen=True)
class Bend:
    """A smooth random displacement of space; u(x) = sum_w a_w sin(k_w x + phi_w), k_w ~ N(0, 1 / CORRELATION^2).

    Space as a whole is bent, not every surface along its own normal, so thin things keep their two sides apart and surfaces that
    touch go on touching. Along any one direction the displacement has the same distribution.

    Attributes:
        wave: (w, 3) radians per metre; phase: (w,); size: (w, 3) metres.
    """

    wave: Array
    phase: Array
    size: Array

    def __call__(self, points: Array) -> Array:
        """Return the displacement (n, 3) at points (n, 3), metres."""
        return np.sin(np.asarray(points, np.float64) @ self.wave.T + self.phase) @ self.size


@dataclass(frozen=True)
class Scanned:
    """A scan of a mesh.

    Attributes:
        vertices: (n, 3) float32 metres; faces: (m, 3) int32.
        ids: (m, k) int32, emission: (m, 3) float32: of the face of the true mesh that each face comes from.
    """

    vertices: Array
    faces: Array
    ids: Array
    emission: Array


def scanned(
    vertices: Array, faces: Array, ids: Array, emission: Array, rng: np.random.Generator, eyes: Array | None = None
) -> Scanned:
    """Scan a mesh: bend it, cut holes, decimate it.

    Args:
        vertices: (n, 3) metres; faces: (m, 3).
        ids: (m, k) int, such as object and material of each face; the mesh stays cut where they change.
        emission: (m, 3) radiance of each face. Faces that shine are bent, but have no holes and are not decimated: the loss of a
            lamp would be another question.
        rng: random numbers.
        eyes: (v, 3) positions of the cameras; None = all surface is near one.
    """
    kinds, part = unique_rows(np.column_stack([ids, emission]).astype(np.float64))
    count = ids.shape[1]
    rows, local = unique_rows(np.column_stack([vertices[faces].reshape(-1, 3).astype(np.float64), np.repeat(part, 3)]))
    vertices, faces, source = refined(rows[:, :3], local.reshape(-1, 3), EDGE, eyes)
    part, whole = part[source], kinds[:, count:].any(1)
    far = np.zeros(len(faces), bool) if eyes is None else cKDTree(eyes).query(vertices[faces].mean(1))[0] > 2 * NEAR
    left = clean(faces, vertices) & without_holes(vertices, faces, whole[part], HOLES, rng, far)
    vertices, faces, part = vertices + drawn_bend(vertices, faces, rng)(vertices), faces[left], part[left]
    fixed = whole[part]
    simple = simplify(vertices, faces[~fixed], part[~fixed], max(1, round(KEPT * int((~fixed).sum()))))
    fixed |= ~np.isin(part, simple[2])  # a part that would vanish stays as it was
    faces = np.concatenate([faces[fixed], simple[1] + len(vertices)])
    vertices, part = np.concatenate([vertices, simple[0]]), np.concatenate([part[fixed], simple[2]])
    good = clean(faces, vertices)
    used, local = np.unique(faces[good], return_inverse=True)
    kind = kinds[part[good]]
    return Scanned(
        vertices[used].astype(np.float32),
        local.reshape(-1, 3).astype(np.int32),
        kind[:, :count].astype(np.int32),
        kind[:, count:].astype(np.float32),
    )


def closed(scan: Scanned) -> Scanned:
    """Close the holes of a scan, as the product does by default when it reads one."""
    part = unique_rows(np.column_stack([scan.ids, scan.emission]).astype(np.float64))[1]
    found = close_holes(scan.vertices, scan.faces, PhotographedSource.model_fields["close_holes"].default, part)
    faces = np.concatenate([scan.faces, found.faces.astype(np.int32)])
    ids, emission = (np.concatenate([of_face, of_face[found.beside]]) for of_face in (scan.ids, scan.emission))
    return Scanned(scan.vertices, faces, ids, emission)


def drawn_bend(vertices: Array, faces: Array, rng: np.random.Generator) -> Bend:
    """Draw a displacement whose median along the normals of a mesh, by area, is `BULGE`."""
    wave, phase = rng.normal(0, 1 / CORRELATION, (_WAVES, 3)), rng.uniform(0, 2 * np.pi, _WAVES)
    bend = Bend(wave, phase, rng.normal(size=(_WAVES, 3)))
    normal, area = face_geometry(vertices, faces)
    along = np.abs((bend(vertices[faces].mean(1)) * normal).sum(1))
    order = np.argsort(along)
    summed = np.cumsum(area[order])
    median = along[order][np.searchsorted(summed, summed[-1] / 2)]
    return Bend(wave, phase, bend.size * BULGE / median)


def refined(vertices: Array, faces: Array, longest: float, eyes: Array | None = None) -> tuple[Array, Array, Array]:
    """Halve edges until none is longer than `longest`; both faces of an edge are cut, so a closed mesh stays closed.

    An edge whose middle is farther than `NEAR` from the nearest of the `eyes` may be longer by that ratio.

    Returns:
        Vertices, faces, and the given face (m',) that each lies on.
    """
    source = np.arange(len(faces))
    cameras = None if eyes is None else cKDTree(eyes)
    while True:
        ends = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1), -1).reshape(-1, 2)
        edges, edge = np.unique(ends, axis=0, return_inverse=True)
        allowed = np.full(len(edges), longest)
        if cameras is not None:
            allowed *= np.maximum(cameras.query(vertices[edges].mean(1))[0] / NEAR, 1.0)
        long = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) > allowed
        if not long.any():
            return vertices, faces, source
        middle = np.where(long, len(vertices) + np.cumsum(long) - 1, -1)[edge.reshape(-1, 3)]
        vertices = np.concatenate([vertices, vertices[edges[long]].mean(1)])
        faces, source = _cut(faces, middle, source)


def _cut(faces: Array, middle: Array, source: Array) -> tuple[Array, Array]:
    """Cut faces at the middles (m, 3) of their edges 01, 12 and 20, -1 = not cut."""
    cut = middle >= 0
    count = cut.sum(1)
    out, of = [faces[count == 0]], [source[count == 0]]
    # Turned such that the cut edges come first: one (01), two (01, 12) or all.
    first = np.where(count == 1, cut.argmax(1), np.where(count == 2, ((~cut).argmax(1) + 1) % 3, 0))
    turn = (first[:, None] + np.arange(3)) % 3
    corner, mid = np.take_along_axis(faces, turn, 1), np.take_along_axis(middle, turn, 1)
    points = np.concatenate([corner, mid], 1)  # a b c ab bc ca
    patterns = {1: [[0, 3, 2], [3, 1, 2]], 2: [[3, 1, 4], [0, 3, 4], [0, 4, 2]], 3: [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]}
    for number, pattern in patterns.items():
        here = count == number
        out.append(points[here][:, pattern].reshape(-1, 3))
        of.append(np.repeat(source[here], len(pattern)))
    return np.concatenate(out), np.concatenate(of)


def without_holes(
    vertices: Array, faces: Array, whole: Array, share: float, rng: np.random.Generator, far: Array | None = None
) -> Array:
    """Return which faces (m,) are left when round holes have taken `share` of the area, to within a face.

    Args:
        vertices, faces: the mesh, metres.
        whole: (m,) bool, faces that are never taken.
        share: of the area of all faces but those that are `far`.
        rng: random numbers.
        far: (m,) bool, faces that are not taken either, and do not count; None = none.
    """
    far = np.zeros(len(faces), bool) if far is None else far
    area, middle = face_geometry(vertices, faces)[1], vertices[faces].mean(1)
    left, to_take, whole = np.ones(len(faces), bool), share * area[~far].sum(), whole | far
    open_area, tree = np.where(whole, 0.0, area), cKDTree(middle)
    to_take = min(to_take, open_area.sum())
    while to_take > 0 and (open_area[left] > 0).any():
        weight = open_area * left
        centre, radius = middle[rng.choice(len(faces), p=weight / weight.sum())], rng.uniform(*HOLE)
        near = np.sort(tree.query_ball_point(centre, radius))
        near = near[left[near] & ~whole[near]]
        near = near[np.argsort(np.linalg.norm(middle[near] - centre, axis=1), kind="stable")]
        taken = near[np.cumsum(area[near]) - area[near] < to_take]
        left[taken] = False
        to_take -= area[taken].sum()
    return left
