"""Flat walls, floor and ceiling: in the place of the surface that lies on them, whose noise would turn its normals, and where
depth maps found nothing, because a wall without texture looks the same everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iif_core.reconstruction.sweep import Picture
from iif_core.surface.closest import closest_points, hidden_from
from iif_core.surface.enclosure import BESIDE, Enclosure, enclosure, moved
from iif_core.surface.triangles import face_geometry

TILE = 0.04
"""Edge (m) of the squares of which walls are made: what is painted on them is told apart by squares."""
MOST_TILES = 200_000
"""Squares of all walls; in larger rooms they are larger."""
NEAR = 0.06
"""Distance (m) from the mesh up to which surface is there already."""
ALONG = 0.9
"""Cosine, with the normal of a plane, of the normals of surface by which its place is found."""
DEVIATIONS = 3.0
"""Distance from a plane, in standard deviations of that surface, up to which surface is of it; at least `NEAR`."""
PARALLEL = 0.7
"""Cosine of the normals of surface that is of a plane, noise included."""
BEHIND = 0.02
"""Distance (m) by which tiles of sides at the extent that overlap with the mesh lie behind it, so that no crack is left."""
OVERLAP = 0.2
"""How far (m) they overlap."""
CLOSES = 0.5
"""Sides at the extent are built if more than this share of the sides are planes: they close a room, and do not make one up."""
LAYERS = ((0.03, 0.25, 45.0), (0.01, 0.05, 0.25))
"""Of two searches, the second about what the first finds: thickness (m) of the layers by which the direction of the walls is
told, steps (degrees) in which it is looked for, and how far to either side."""
MOST_FACES = 50_000
"""Faces that are counted."""
THROUGH = 0.05
"""Share by which a depth map must look beyond a tile to say that nothing is there."""
BEYOND = 0.05
"""Largest share of the area behind a wall: depth that is wrong."""
NOISE = 0.005
"""Share of the area at each end of the room that is such depth."""


class Walls(NamedTuple):
    """Flat surface that closes a room.

    Attributes:
        vertices: (n, 3); faces: (m, 3) int64, normals inward.
        side: (m,) int64, row of `sides` of each face.
        found: (m,) bool, surface lay there that the face takes the place of.
        sides: the planes.
        error: (s,) root mean square distance (m) of the mesh from each side that prolongs a plane of it, NaN for others.
    """

    vertices: NDArray
    faces: NDArray
    side: NDArray
    found: NDArray
    sides: Enclosure
    error: NDArray

    def height(self) -> float | None:
        """Return the distance of floor and ceiling (m) in the middle of the room; None unless both prolong planes of the mesh."""
        level = np.abs(self.sides.normal[:, 2]) > ALONG
        if level.sum() != 2 or not self.sides.from_plane[level].all():
            return None
        middle = self.sides.vertices.mean(0)
        at = [self.sides.vertices[self.sides.faces[self.sides.side == i][0, 0]] for i in np.flatnonzero(level)]
        normal = self.sides.normal[level]
        return float(np.abs(np.einsum("ij,ij->i", at - middle, normal) / normal[:, 2]).sum())

    def scaled(self, factor: float) -> Walls:
        """Return the same, larger by a factor."""
        sides = self.sides._replace(vertices=self.sides.vertices * factor)
        return self._replace(vertices=self.vertices * factor, sides=sides, error=self.error * factor)

    def turned(self, turn: NDArray) -> Walls:
        """Return the same after a rotation (3, 3) of the world."""
        sides = self.sides._replace(vertices=self.sides.vertices @ turn.T, normal=self.sides.normal @ turn.T)
        return self._replace(vertices=self.vertices @ turn.T, sides=sides)


def flat_walls(
    vertices: NDArray, faces: NDArray, depths: Sequence[NDArray], pictures: Sequence[Picture], points: NDArray | None = None
) -> tuple[Walls, NDArray]:
    """Return the planes around a room, and (m,) bool: the faces of its mesh whose place they take, and those behind them that
    no picture can see.

    The planes are those of `enclosure`; along the axes of the room a little surface is enough, such as a picture or a door on a
    wall without texture. A square of a plane is built unless depth maps show something behind it, as through a
    door. Where a plane prolongs surface of the mesh, it takes the place of the surface that lies on it. Planes at the extent
    close what is left, if more than half of the sides are planes: there squares are built where no surface is near, and go on a
    little behind the surface at their border.

    Args:
        vertices, faces: (n, 3), metres, and (m, 3), with an area.
        depths: (H, W) z-depth of each picture, NaN = unknown.
        pictures: their cameras.
        points: (p, 3) that photographs show: where no plane is, sides go at least as far as most of the outermost ones.
    """
    centres = np.array([picture.centre for picture in pictures])
    normal, area = face_geometry(vertices, faces)
    square = room_axes(vertices[faces].mean(1), normal, area)
    sides = enclosure(vertices, faces, centres, "planes", margin=0.0, beyond=BEYOND, noise=NOISE, shown=points, square=square)
    sides, error = _placed(sides, vertices[faces].mean(1), normal, area)
    is_plane = np.isfinite(error)
    corners, quads, side = _squares(sides)

    # -------- squares of planes, with nothing behind them, and the surface whose place they take --------
    middle, of_plane = corners[quads].mean(1), is_plane[side]
    kept = ~_seen_through(middle, depths, pictures)
    found, thickness = np.zeros(len(quads), bool), np.fmax(NEAR, DEVIATIONS * error)  # sides at the extent have no error
    found[of_plane] = _distance(vertices, faces, middle[of_plane]) <= thickness[side[of_plane]]
    own = kept & of_plane
    flat = _lies_on(sides, thickness, corners, quads[own], side[own], vertices, faces)

    # -------- squares at the extent, where surface is lacking; some beside them overlap with it, behind it --------
    rest = faces[~flat]
    near = ~of_plane
    near[near] = _distance(vertices, rest, middle[near]) <= NEAR
    kept &= of_plane | (is_plane.mean() > CLOSES)
    kept &= ~near
    edge = np.linalg.norm(corners[quads[0, 1]] - corners[quads[0, 0]])
    for _ in range(max(1, round(OVERLAP / edge))):
        touched = np.zeros(len(corners), bool)
        touched[quads[kept & ~of_plane]] = True
        kept |= near & touched[quads].any(1)
    found = found[kept]
    quads, side = quads[kept], side[kept]
    used, first, local = np.unique(quads, return_index=True, return_inverse=True)
    placed, of_corner = corners[used], side[first // 4]
    hides = ~is_plane[of_corner]
    hides[hides] = _distance(vertices, rest, placed[hides]) <= NEAR
    placed = placed - (BEHIND * hides)[:, None] * sides.normal[of_corner]
    local = local.reshape(-1, 4)
    both = np.concatenate([local[:, [0, 1, 2]], local[:, [0, 2, 3]]])
    walls = Walls(placed, both, np.tile(side, 2), np.tile(found, 2), sides, error)
    return walls, flat | _behind(walls, thickness, vertices, faces, depths, pictures)


def room_axes(middle: NDArray, normal: NDArray, area: NDArray) -> NDArray:
    """Return axes (3, 3) of a room with z up: x and y along the walls, where upright surface lies in the thinnest layers,

    argmax over phi of sum_b h_b(phi)^2 + sum_b h'_b(phi)^2 (docs/method/reconstruction.md, Eq. D.5),

    with the area h_b, h'_b in layers along both axes (`LAYERS`). Normals alone are off by degrees on noisy surface.

    Args:
        middle, normal: (m, 3) of the faces, metres; area: (m,).
    """
    upright = np.flatnonzero(np.abs(normal[:, 2]) < np.sqrt(1 - ALONG**2))
    upright = upright[:: max(1, len(upright) // MOST_FACES)]
    place, weight = middle[upright, :2] - middle[upright, :2].mean(0), area[upright]
    if not len(upright):
        return np.eye(3)

    def packed(along: NDArray, layer: float) -> float:
        number = np.rint(along / layer).astype(np.int64)
        return float(np.square(np.bincount(number - number.min(), weight)).sum())

    best = 0.0
    for layer, step, reach in LAYERS:
        angles = np.radians(np.arange(-reach, reach, step)) + best
        axes = np.stack([np.cos(angles), np.sin(angles)], 1)
        best = float(angles[np.argmax([packed(place @ (x, y), layer) + packed(place @ (-y, x), layer) for x, y in axes])])
    x, y = np.cos(best), np.sin(best)
    return np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])


def _placed(sides: Enclosure, middle: NDArray, normal: NDArray, area: NDArray) -> tuple[Enclosure, NDArray]:
    """Return the sides, those that prolong a plane in the middle of its surface and not at its border, and the root mean square
    distance (s,) of that surface, NaN for sides at the extent."""
    place, error = np.zeros((2, len(sides.normal)))
    for number, inward in enumerate(sides.normal):
        place[number] = (sides.vertices[np.unique(sides.faces[sides.side == number])] @ inward).mean()
        away = middle @ inward - place[number]
        own = (np.abs(normal @ inward) > ALONG) & (np.abs(away) < BESIDE) & sides.from_plane[number]
        error[number] = np.nan
        if area[own].sum() > 0:
            shift = float(np.average(away[own], weights=area[own]))
            place[number] += shift
            error[number] = np.sqrt(np.average((away[own] - shift) ** 2, weights=area[own]))
    sides, left = moved(sides, place)
    return sides, error[left]


def _squares(sides: Enclosure) -> tuple[NDArray, NDArray, NDArray]:
    """Return corners (n, 3), squares (m, 4) of them that fill all sides, and the side (m,) of each."""
    size = face_geometry(sides.vertices, sides.faces)[1].sum()
    edge = max(TILE, float(np.sqrt(size / MOST_TILES)))
    corners, quads, side, count = [], [], [], 0
    for number, inward in enumerate(sides.normal):
        own_corners, own_quads = _tiles(sides.vertices[np.unique(sides.faces[sides.side == number])], inward, edge)
        corners.append(own_corners)
        quads.append(own_quads + count)
        side.append(np.full(len(own_quads), number))
        count += len(own_corners)
    return np.concatenate(corners), np.concatenate(quads), np.concatenate(side)


def _lies_on(
    sides: Enclosure, thickness: NDArray, corners: NDArray, quads: NDArray, side: NDArray, vertices: NDArray, faces: NDArray
) -> NDArray:
    """Return (m,) bool: the faces of a mesh whose place the squares of some side take.

    `quads` (q, 4) of `corners` lie on the sides `side` (q,), which prolong planes. All of such a face is within `thickness` (s,)
    of a square, and it is about parallel; or it is as near to squares of two sides, where surface is round that should have an
    edge.
    """
    normal, middle = face_geometry(vertices, faces)[0], vertices[faces].mean(1)
    parallel, count = np.zeros(len(faces), bool), np.zeros(len(faces), np.int64)
    for number, inward in enumerate(sides.normal):
        own = quads[side == number]
        if not len(own):
            continue
        away = np.abs((vertices - corners[own[0, 0]]) @ inward)
        close = np.flatnonzero(away[faces].max(1) <= thickness[number])
        if not len(close):
            continue
        foot = closest_points(corners, np.concatenate([own[:, [0, 1, 2]], own[:, [0, 2, 3]]]), middle[close]).points
        off = middle[close] - foot
        beside = np.linalg.norm(off - (off @ inward)[:, None] * inward, axis=1)
        close = close[beside < 0.5 * TILE]
        count[close] += 1
        parallel[close] |= np.abs(normal[close] @ inward) > PARALLEL
    return parallel | (count > 1)


def _behind(
    walls: Walls, thickness: NDArray, vertices: NDArray, faces: NDArray, depths: Sequence[NDArray], pictures: Sequence[Picture]
) -> NDArray:
    """Return (m,) bool: the faces of a mesh that lie as a whole behind some side, by more than its `thickness` (s,), and that
    squares hide from all pictures that have them in view: they are noise."""
    behind = np.zeros(len(faces), bool)
    for number, inward in enumerate(walls.sides.normal):
        place = walls.sides.vertices[walls.sides.faces[walls.sides.side == number][0, 0]]
        behind |= (((place - vertices) @ inward)[faces] > thickness[number]).all(1)
    far = np.flatnonzero(behind)
    middle = vertices[faces[far]].mean(1)
    for depth, picture in zip(depths, pictures, strict=True) if len(far) and len(walls.faces) else ():
        inside = picture.pixels(middle, depth.shape)[3] & behind[far]
        hidden = hidden_from(walls.vertices, walls.faces, picture.centre, middle[inside])
        behind[far[np.flatnonzero(inside)[~hidden]]] = False
    return behind


def turn_to_walls(walls: Walls) -> NDArray:
    """Return the rotation (3, 3) about z by which the largest upright side that prolongs a plane faces along x or y, by less than
    half a right angle; the identity without one."""
    upright = np.abs(walls.sides.normal[:, 2]) < 0.5
    area = np.bincount(walls.sides.side, face_geometry(walls.sides.vertices, walls.sides.faces)[1], len(upright))
    size = area * (upright & walls.sides.from_plane)
    if not size.any():
        return np.eye(3)
    normal = walls.sides.normal[int(size.argmax())]
    angle = np.arctan2(normal[1], normal[0])
    off = angle - np.round(angle / (np.pi / 2)) * (np.pi / 2)
    c, s = np.cos(off), np.sin(off)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _distance(vertices: NDArray, faces: NDArray, points: NDArray) -> NDArray:
    if not len(points) or not len(faces):
        return np.full(len(points), np.inf)
    return np.linalg.norm(closest_points(vertices, faces, points).points - points, axis=1)


def _tiles(outline: NDArray, inward: NDArray, edge: float) -> tuple[NDArray, NDArray]:
    """Corners (n, 3) and squares (m, 4) of about `edge` that fill a convex outline (k, 3), seen from the side of `inward`."""
    u = np.cross(inward, np.eye(3)[np.abs(inward).argmin()])
    u /= np.linalg.norm(u)
    # Along the longest edge of the outline.
    middle = outline.mean(0)
    flat = np.column_stack([(outline - middle) @ u, (outline - middle) @ np.cross(inward, u)])
    order = np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))
    edges = np.roll(outline[order], -1, 0) - outline[order]
    u = edges[np.linalg.norm(edges, axis=1).argmax()]
    u /= np.linalg.norm(u)
    v = np.cross(inward, u)
    flat = np.column_stack([(outline - middle) @ u, (outline - middle) @ v])[order]
    low, high = flat.min(0), flat.max(0)
    count = np.maximum(np.ceil((high - low) / edge).astype(int), 1)
    a, b = (np.linspace(low[i], high[i], count[i] + 1) for i in range(2))
    grid = np.stack(np.meshgrid(a, b, indexing="ij"), -1).reshape(-1, 2)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(count[0]), np.arange(count[1]), indexing="ij"))
    first = i * (count[1] + 1) + j
    quads = np.stack([first, first + count[1] + 1, first + count[1] + 2, first + 1], 1)
    # Squares of which a corner or the middle is inside: across a slanted border they reach behind the next side.
    along = np.roll(flat, -1, 0) - flat
    inside = np.zeros(len(quads), bool)
    for part in (*grid[quads].transpose(1, 0, 2), grid[quads].mean(1)):
        off = part[:, None] - flat
        inside |= (along[:, 0] * off[..., 1] - along[:, 1] * off[..., 0] >= -1e-9).all(1)
    return middle + grid[:, :1] * u + grid[:, 1:] * v, quads[inside]


def _seen_through(points: NDArray, depths: Sequence[NDArray], pictures: Sequence[Picture]) -> NDArray:
    """(n,) bool: at least two depth maps show something well behind a point, and more of them than show surface at it."""
    through, met = np.zeros((2, len(points)), np.int64)
    for depth, picture in zip(depths, pictures, strict=True):
        row, column, z, inside = picture.pixels(points, depth.shape)
        with np.errstate(invalid="ignore"):
            behind = depth[row, column] - z
            through += inside & (behind > THROUGH * z + NEAR)
            met += inside & (np.abs(behind) <= THROUGH * z + NEAR)
    return (through >= 2) & (through > met)
