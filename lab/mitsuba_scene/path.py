"""Chooses camera positions and views of a room that together see as much of it as possible, from the mesh and one pose.

Positions lie at eye height in free space that is connected to the pose; views are chosen greedily by the surface points that they
add (1, 0.6, 0.4 for the first, second and third view of a point). Lengths are metres. The result is a function of the seed.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from iif_core.camera.pinhole import look_at

Array = np.ndarray
Trace = Callable[[Array, Array], tuple[Array, Array]]
"""(origins (n, 3), directions (n, 3)) -> (face (n,) int32, -1 = miss; t (n,) float32, inf = miss)."""

CLEARANCE = 0.35  # metres
EYE_HEIGHTS = (1.0, 1.9)  # metres
MIN_MEDIAN_DISTANCE = 1.0  # metres; a view below this looks at a wall
YAWS = 16
PITCHES = (-30.0, -8.0, 14.0)  # degrees
CANDIDATE_POSITIONS = 768
FREE_POSITIONS = 128
SPHERE_DIRECTIONS = 384
SURFACE_POINTS = 16000
GRAZING_COSINE = 0.15  # below this a surface point does not count as seen
PLAUSIBLE_DISTANCES = (0.3, 30.0)
"""Median distance seen from the sensor in a scene whose unit is the metre; outside of it all lengths scale with the distance."""
_GAIN_OF_VIEW = (1.0, 0.6, 0.4)  # of the first, second and third view of a point
_GAIN_LATER = 0.02


@dataclass(frozen=True)
class Lens:
    """Half extents of the picture on the plane z = 1."""

    x: float
    y: float


@dataclass(frozen=True)
class Path:
    """Chosen poses (v, 4, 4) `world_from_camera` of OpenCV axes, whether each was given (v,), facts and notes about coverage."""

    poses: Array
    given: Array
    facts: dict[str, Any]
    notes: list[str]


def plan_views(
    solid: Trace,
    visible: Trace,
    vertices: Array,
    faces: Array,
    given: list[tuple[Array, Lens]],
    lens: Lens,
    up: Array,
    count: int,
    seed: int,
) -> Path:
    """Choose `count` views of the room that the first given pose stands in; the given poses come first.

    Args:
        solid: traces everything that a camera cannot pass through, glass included.
        visible: traces the surface that a camera sees.
        vertices, faces: the visible mesh.
        given: poses of the scene's own sensors with their lenses, at least one.
        lens: of the chosen views.
        up: (3,) unit vector.
        count: views >= 1; surplus given poses are left out.
        seed: of the positions and surface points.

    Returns:
        At most `count` poses.
    """
    given = given[:count]
    rng = np.random.default_rng([seed, 0x9A7])
    start = given[0][0][:3, 3]
    sphere = fibonacci_sphere(SPHERE_DIRECTIONS)
    notes: list[str] = []

    directions = fibonacci_sphere(4 * SPHERE_DIRECTIONS)
    _, around = solid(np.broadcast_to(start, directions.shape), directions)
    seen = np.isfinite(around)
    reach = float(np.median(around[seen])) if seen.any() else 1.0
    escape = float(1 - seen.mean())
    unit = 1.0
    if not PLAUSIBLE_DISTANCES[0] <= reach <= PLAUSIBLE_DISTANCES[1]:
        unit = reach / 2.5
        notes.append(f"the median distance seen from the sensor is {reach:.3g} m: is the scene's unit the metre?")
    room = _Room(start, up, directions, around, reach, escape, unit)
    positions, distances, facts = _free_positions(solid, room, sphere, count, rng)
    if len(positions) and facts["clearance_m"] < CLEARANCE * unit:
        wanted = CLEARANCE * unit
        notes.append(f"cameras keep {facts['clearance_m']:.3g} m from surfaces: too few places have {wanted:.3g} m")

    points, normals = _surface_points(vertices, faces, *room.box(), rng)
    sees = _visibility(visible, positions, points, normals)
    own = _visibility(visible, np.array([pose[:3, 3] for pose, _ in given]), points, normals)
    reachable = own.any(0) | sees.any(0)
    points, sees, own = points[reachable], sees[:, reachable], own[:, reachable]

    counts = np.zeros(len(points), np.int64)
    for (pose, own_lens), row in zip(given, own, strict=True):
        counts += row & _in_frustum(pose, own_lens, points)
    near = min(MIN_MEDIAN_DISTANCE * unit, 0.5 * reach)
    views, poses = _views(positions, distances, sphere, sees, points, lens, up, near, escape)
    chosen = _greedy(views, counts, count - len(given))
    if len(given) + len(chosen) < count:
        notes.append(f"only {len(given) + len(chosen)} of {count} views: the free space allows no more")

    area = max(len(points), 1)
    facts = {
        "up": up.tolist(),
        "positions": len(positions),
        "surface_points": len(points),
        "escape_share": round(escape, 4),
        "coverage_1": round(float((counts >= 1).sum() / area), 4),
        "coverage_3": round(float((counts >= 3).sum() / area), 4),
        **facts,
    }
    all_poses = np.concatenate([np.array([pose for pose, _ in given]), poses[chosen].reshape(-1, 4, 4)])
    return Path(all_poses, np.arange(len(all_poses)) < len(given), facts, notes)


def fibonacci_sphere(n: int) -> Array:
    """Return n directions spread evenly over the sphere, (n, 3) float32."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z]).astype(np.float32)


def upright(direction: Array) -> Array:
    """Return the signed coordinate axis nearest to a direction, such as the upward axis of a scene from its sensor's."""
    axis = int(np.argmax(np.abs(direction)))
    return np.eye(3)[axis] * np.sign(direction[axis])


def _basis(up: Array) -> tuple[Array, Array]:
    """Return two unit vectors that span the plane square to `up`."""
    e1 = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    e1 /= np.linalg.norm(e1)
    return e1, np.cross(up, e1)


@dataclass(frozen=True)
class _Room:
    """The surroundings of the starting pose.

    Attributes:
        start, up: (3,) position and upward direction.
        directions, around: (n, 3) directions and the distances along them, (n,).
        reach: median distance.
        escape: share of the directions that meet no surface.
        unit: metres per unit as far as the size of the scene suggests; 1 where its size is plausible.
    """

    start: Array
    up: Array
    directions: Array
    around: Array
    reach: float
    escape: float
    unit: float

    @property
    def seen(self) -> Array:
        """Points (n, 3) of the surrounding surface; the unit sphere where there is none."""
        hit = np.isfinite(self.around)
        return self.start + (self.directions[hit] * self.around[hit, None] if hit.any() else self.directions)

    def box(self) -> tuple[Array, Array]:
        """Return the corners of a box around the seen points without the outermost half per cent on each side."""
        low, high = np.percentile(self.seen, [0.5, 99.5], axis=0)
        return low - 0.05 * self.reach, high + 0.05 * self.reach


def _free_positions(solid: Trace, room: _Room, sphere: Array, count: int, rng: Any) -> tuple[Array, Array, dict[str, Any]]:
    """Return positions (n, 3) where a camera can stand, distances (n, SPHERE_DIRECTIONS) around each, and facts."""
    start, up = room.start, room.up
    e1, e2 = _basis(up)
    across = np.column_stack([room.seen @ e1, room.seen @ e2])
    low, high = np.percentile(across, [1, 99], axis=0)
    drop = _distance(solid, start[None], -up)[0]
    if not np.isfinite(drop):
        drop = 1.5 * room.unit
    eye = _eye_heights(drop, _distance(solid, start[None], up)[0], room.unit)

    # A low-discrepancy sequence (Roberts' R3): two coordinates across the room, the third over the eye heights.
    ratio = 1.2207440846057596
    sequence = (rng.random(3) + np.arange(1, CANDIDATE_POSITIONS + 1)[:, None] * ratio ** -np.arange(1.0, 4.0)) % 1
    flat = low + (high - low) * sequence[:, :2]
    columns = flat[:, :1] * e1 + flat[:, 1:] * e2 + (start @ up) * up
    below = _distance(solid, columns, -up)
    floors = (columns @ up - below)[_sees(solid, start, columns) & np.isfinite(below)]
    floor = min(float(np.percentile(floors, 10)) if len(floors) else np.inf, float(start @ up - drop))
    height = floor + eye[0] + (eye[1] - eye[0]) * sequence[:, 2]
    positions = columns + (height - start @ up)[:, None] * up

    distances = _spheres(solid, positions, sphere)
    nearest = distances.min(1)
    inside = np.isinf(distances).mean(1) <= room.escape + 0.15
    clearance = min(CLEARANCE * room.unit, 0.25 * room.reach)
    enough = min(max(8, count), FREE_POSITIONS)
    for _ in range(8):
        roomy = np.flatnonzero(inside & (nearest >= clearance))
        kept = roomy[_connected(solid, start, positions[roomy])]
        if len(kept) >= enough:
            break
        clearance *= 0.75
    kept = kept[:FREE_POSITIONS]
    facts = {
        "clearance_m": round(float(min(clearance, nearest[kept].min())) if len(kept) else 0.0, 6),
        "floor_m": round(floor, 6),
        "eye_heights_m": [round(e, 6) for e in eye],
    }
    return positions[kept], distances[kept], facts


def _eye_heights(below: float, above: float, unit: float) -> tuple[float, float]:
    """Return the lowest and highest eye height above the floor: 1.0 to 1.9 m and the sensor's own, at most 0.85 of the room."""
    low, high = EYE_HEIGHTS[0] * unit, EYE_HEIGHTS[1] * unit
    if not 0.5 * unit <= below <= 4 * unit:
        low, high = 0.6 * below, 1.15 * below
    low, high = min(low, below), max(high, below)
    if np.isfinite(above):
        low, high = min(low, 0.4 * (below + above)), min(high, 0.85 * (below + above))
    return float(low), float(high)


def _distance(trace: Trace, origins: Array, direction: Array) -> Array:
    return trace(origins, np.broadcast_to(direction, origins.shape))[1].astype(np.float64)


def _sees(trace: Trace, origins: Array, targets: Array) -> Array:
    """Return whether the lines from origins to targets (n, 3) are free, up to 0.1 % before the targets."""
    origins = np.broadcast_to(origins, targets.shape)
    return trace(origins, targets - origins)[1] > 0.999


def _spheres(trace: Trace, positions: Array, sphere: Array) -> Array:
    """Return the distances (n, directions) from positions along the directions of a sphere."""
    _, t = trace(np.repeat(positions, len(sphere), 0), np.tile(sphere, (len(positions), 1)))
    return t.reshape(len(positions), len(sphere))


def _connected(trace: Trace, start: Array, positions: Array) -> Array:
    """Return the indices of the positions that can be reached from `start` along free straight lines, in ascending order."""
    reached = np.zeros(len(positions), bool)
    front = start[None]
    while len(front) and not reached.all():
        rest = np.flatnonzero(~reached)
        pairs = np.repeat(front, len(rest), 0), np.tile(positions[rest], (len(front), 1))
        new = rest[_sees(trace, *pairs).reshape(len(front), len(rest)).any(0)]
        reached[new] = True
        front = positions[new]
    return np.flatnonzero(reached)


def _surface_points(vertices: Array, faces: Array, low: Array, high: Array, rng: Any) -> tuple[Array, Array]:
    """Return SURFACE_POINTS points drawn uniformly over the area within a box, and unit normals of either sign."""
    a, b, c = (vertices[faces[:, i]].astype(np.float32) for i in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1).astype(np.float64)
    cumulative = np.cumsum(area)
    points = np.zeros((0, 3))
    normals = np.zeros((0, 3))
    for _ in range(8):  # faces may be larger than the box, so that only some of the points drawn lie within
        face = np.searchsorted(cumulative, rng.random(SURFACE_POINTS) * cumulative[-1])
        face = np.minimum(face, len(faces) - 1)
        u, v = rng.random((2, SURFACE_POINTS))
        outside = u + v > 1
        u, v = np.where(outside, 1 - u, u), np.where(outside, 1 - v, v)
        p = a[face] + u[:, None] * (b - a)[face] + v[:, None] * (c - a)[face]
        inside = ((p >= low) & (p <= high)).all(1) & (area[face] > 0)
        points = np.concatenate([points, p[inside]])
        normals = np.concatenate([normals, normal[face[inside]] / area[face[inside], None]])
        if len(points) >= SURFACE_POINTS:
            break
    return points[:SURFACE_POINTS], normals[:SURFACE_POINTS]


def _visibility(trace: Trace, positions: Array, points: Array, normals: Array) -> Array:
    """Return (positions, points) bool: which points each position sees at more than a grazing angle."""
    out = np.zeros((len(positions), len(points)), bool)
    for row, position in enumerate(positions):
        toward = points - position
        distance = np.linalg.norm(toward, axis=1)
        facing = np.abs((toward * normals).sum(1)) > GRAZING_COSINE * distance
        index = np.flatnonzero(facing)
        out[row, index] = _sees(trace, position, points[index])
    return out


def _in_frustum(pose: Array, lens: Lens, points: Array) -> Array:
    return _in_frusta(pose[None, :3, :3], lens, points - pose[:3, 3])[0]


def _in_frusta(rotations: Array, lens: Lens, rays: Array) -> Array:
    """Return (rotations, rays) bool: which rays (n, 3) from the camera fall into the picture of each rotation (k, 3, 3)."""
    # einsum is faster than a threaded BLAS for matrices this thin.
    columns, rays = rotations.astype(np.float32), np.ascontiguousarray(rays.T, np.float32)
    x, y, z = (np.einsum("ka,an->kn", columns[:, :, axis], rays) for axis in range(3))
    return (z > 0) & (np.abs(x) <= lens.x * z) & (np.abs(y) <= lens.y * z)


def _views(
    positions: Array,
    distances: Array,
    sphere: Array,
    sees: Array,
    points: Array,
    lens: Lens,
    up: Array,
    near: float,
    escape: float,
) -> tuple[Array, Array]:
    """Return candidate views, the points that each sees (packed bits) and its pose, without views of near walls or of nothing."""
    e1, e2 = _basis(up)
    packed, poses = [], []
    for index, position in enumerate(positions):
        turn = 2 * np.pi * (0.6180339887498949 * index % 1) / YAWS  # gives every position its own yaws
        yaw, pitch = np.meshgrid(turn + 2 * np.pi * np.arange(YAWS) / YAWS, np.radians(PITCHES), indexing="ij")
        across = np.cos(yaw).reshape(-1, 1) * e1 + np.sin(yaw).reshape(-1, 1) * e2
        forward = np.cos(pitch).reshape(-1, 1) * across + np.sin(pitch).reshape(-1, 1) * up
        candidates = np.array([look_at(position, position + f, up) for f in forward])
        rotations = candidates[:, :3, :3]
        around = _in_frusta(rotations, lens, sphere)
        seen = np.flatnonzero(sees[index])
        ahead = _in_frusta(rotations, lens, points[seen] - position)
        for pose, inside, mask in zip(candidates, around, ahead, strict=True):
            distance = distances[index, inside]
            hit = np.isfinite(distance)
            if hit.mean() < 1 - escape - 0.35 or not hit.any() or np.median(distance[hit]) < near:
                continue
            flags = np.zeros(len(points), bool)
            flags[seen[mask]] = True
            packed.append(np.packbits(flags))
            poses.append(pose)
    if not poses:
        return np.zeros((0, (len(points) + 7) // 8), np.uint8), np.zeros((0, 4, 4))
    return np.array(packed), np.array(poses)


def _greedy(views: Array, counts: Array, wanted: int) -> Array:
    """Return the indices of `wanted` views, best first; `counts`, the views of each point, is updated in place."""
    n = len(counts)

    def gain_of_points() -> Array:
        first = np.array(_GAIN_OF_VIEW)[np.minimum(counts, len(_GAIN_OF_VIEW) - 1)]
        return np.where(counts < len(_GAIN_OF_VIEW), first, _GAIN_LATER / np.maximum(counts, 1))

    def gain(view: int) -> float:
        return float(weight[np.unpackbits(views[view], count=n).view(bool)].sum())

    weight = gain_of_points()
    queue = [(-gain(view), view) for view in range(len(views))]
    heapq.heapify(queue)
    chosen: list[int] = []
    while queue and len(chosen) < wanted:
        _, view = heapq.heappop(queue)
        now = -gain(view)
        if queue and (now, view) > queue[0]:
            heapq.heappush(queue, (now, view))
            continue
        chosen.append(view)
        counts += np.unpackbits(views[view], count=n)
        weight = gain_of_points()
    return np.array(chosen, int)
