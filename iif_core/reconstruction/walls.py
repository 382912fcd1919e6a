"""Flat walls, floor and ceiling where depth maps found nothing, because a wall without texture looks the same everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iif_core.reconstruction.sweep import Picture
from iif_core.surface.closest import closest_points
from iif_core.surface.enclosure import BESIDE, Enclosure, enclosure
from iif_core.surface.triangles import face_geometry

TILE = 0.1
"""Edge (m) of the squares of which walls are made."""
NEAR = 0.06
"""Distance (m) from the mesh up to which a tile is there already."""
BEHIND = 0.02
"""Least distance (m) by which tiles that overlap with the mesh lie behind it, so that no crack is left at its border."""
RINGS = 2
"""Tiles by which they overlap."""
THROUGH = 0.05
"""Share by which a depth map must look beyond a tile to say that nothing is there."""
BEYOND = 0.05
"""Largest share of the area behind a wall: depth that is wrong."""
NOISE = 0.005
"""Share of the area at each end of the room that is such depth."""


class Walls(NamedTuple):
    """Surface that closes a room.

    Attributes:
        vertices: (n, 3); faces: (m, 3) int64, normals inward.
        side: (m,) int64, row of `sides` of each face.
        sides: the planes.
        error: (s,) root mean square distance (m) of the mesh from each side that prolongs a plane of it, NaN for others.
    """

    vertices: NDArray
    faces: NDArray
    side: NDArray
    sides: Enclosure
    error: NDArray

    def turned(self, turn: NDArray) -> Walls:
        """Return the same after a rotation (3, 3) of the world."""
        sides = self.sides._replace(vertices=self.sides.vertices @ turn.T, normal=self.sides.normal @ turn.T)
        return self._replace(vertices=self.vertices @ turn.T, sides=sides)


def missing_walls(
    vertices: NDArray, faces: NDArray, depths: Sequence[NDArray], pictures: Sequence[Picture], points: NDArray | None = None
) -> Walls:
    """Return what a mesh lacks of the planes around it.

    The planes are those of `enclosure`. A square of a plane is built where no surface is near, and no depth map shows anything
    behind it, as through a door. What is built goes on a little behind the surface at its border.

    Args:
        vertices, faces: (n, 3), metres, and (m, 3), with an area.
        depths: (H, W) z-depth of each picture, NaN = unknown.
        pictures: their cameras.
        points: (p, 3) that photographs show: where no plane is, sides go at least as far as most of the outermost ones.
    """
    centres = np.array([picture.centre for picture in pictures])
    sides = enclosure(vertices, faces, centres, "planes", margin=0.0, beyond=BEYOND, noise=NOISE, shown=points)
    normal, area = face_geometry(vertices, faces)
    middle = vertices[faces].mean(1)
    corners, tiles, of_side, error = [], [], [], np.full(len(sides.normal), np.nan)
    for number, inward in enumerate(sides.normal):
        outline = sides.vertices[np.unique(sides.faces[sides.side == number])]
        offset = float(outline.mean(0) @ inward)
        # A plane lies in the middle of the surface that it prolongs, not at its border.
        if sides.from_plane[number]:
            away = middle @ inward - offset
            own = (np.abs(normal @ inward) > 0.9) & (np.abs(away) < BESIDE)
            shift = float(np.average(away[own], weights=area[own])) if area[own].sum() > 0 else 0.0
            error[number] = np.sqrt(np.average((away[own] - shift) ** 2, weights=area[own])) if area[own].sum() > 0 else np.nan
            outline = outline + shift * inward
        own_corners, own_tiles = _tiles(outline, inward)
        tiles.append(own_tiles + sum(map(len, corners)))
        corners.append(own_corners)
        of_side.append(np.full(len(own_tiles), number))
    grid, quads, side = np.concatenate(corners), np.concatenate(tiles), np.concatenate(of_side)
    centre = grid[quads].mean(1)
    away = _distance(vertices, faces, centre)
    lacks = (away > NEAR) & ~_seen_through(centre, depths, pictures)

    # -------- tiles beside those that are lacking overlap with the mesh, behind it --------
    kept = lacks.copy()
    for _ in range(RINGS):
        touched = np.zeros(len(grid), bool)
        touched[quads[kept]] = True
        kept |= (away <= NEAR) & touched[quads].any(1)
    quads, side = quads[kept], side[kept]
    used, first, local = np.unique(quads, return_index=True, return_inverse=True)
    of_corner = side[first // 4]
    placed = grid[used]
    back = np.where(np.isnan(error), BEHIND, np.maximum(2 * np.nan_to_num(error), BEHIND))[of_corner]
    placed = placed - (back * (_distance(vertices, faces, placed) <= NEAR))[:, None] * sides.normal[of_corner]
    local = local.reshape(-1, 4)
    both = np.concatenate([local[:, [0, 1, 2]], local[:, [0, 2, 3]]])
    return Walls(placed, both, np.concatenate([side, side]), sides, error)


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
    if not len(points):
        return np.zeros(0)
    return np.linalg.norm(closest_points(vertices, faces, points).points - points, axis=1)


def _tiles(outline: NDArray, inward: NDArray) -> tuple[NDArray, NDArray]:
    """Corners (n, 3) and squares (m, 4) of about `TILE` that fill a convex outline (k, 3), seen from the side of `inward`."""
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
    count = np.maximum(np.ceil((high - low) / TILE).astype(int), 1)
    a, b = (np.linspace(low[i], high[i], count[i] + 1) for i in range(2))
    grid = np.stack(np.meshgrid(a, b, indexing="ij"), -1).reshape(-1, 2)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(count[0]), np.arange(count[1]), indexing="ij"))
    first = i * (count[1] + 1) + j
    quads = np.stack([first, first + count[1] + 1, first + count[1] + 2, first + 1], 1)
    inner = grid[quads].mean(1)
    along = np.roll(flat, -1, 0) - flat
    turn = along[None, :, 0] * (inner[:, None, 1] - flat[None, :, 1]) - along[None, :, 1] * (inner[:, None, 0] - flat[None, :, 0])
    return middle + grid[:, :1] * u + grid[:, 1:] * v, quads[(turn >= -1e-9).all(1)]


def _seen_through(points: NDArray, depths: Sequence[NDArray], pictures: Sequence[Picture]) -> NDArray:
    """(n,) bool: at least two depth maps show something well behind a point."""
    count = np.zeros(len(points), np.int64)
    for depth, picture in zip(depths, pictures, strict=True):
        row, column, z, inside = picture.pixels(points, depth.shape)
        with np.errstate(invalid="ignore"):
            count += inside & (depth[row, column] > (1 + THROUGH) * z + NEAR)
    return count >= 2
