"""Which surface shines by itself, in which groups, and the radiance cache of everything that does not.

A face is a candidate when nearly all of its pixels in all views are saturated (LDR) or far brighter than the room
(HDR). That
is generous on purpose: the linear solve that follows gives a surface which merely reflects an emission near zero,
    and such
groups are dropped again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.cells import pack_keys, unpack_keys, voxel_indices

SMALL_AREA = 0.25
"""Surface (m^2) of a lamp that may be one group whatever its shape."""
_BRIDGE = 3  # faces by which pools reach over unseen surface


@dataclass(frozen=True)
class FaceStatistics:
    """What the photographs say about every face.

    Attributes:
        count: (F,) int32 observations.
        low: (F,) float32, lower quantile over the observations of the largest channel; 0 where unobserved.
        mean: (F, 3) float32 mean value; 0 where unobserved.
        front: (F,) float32 in [0, 1]: share of the observations from the side of the face normal.
    """

    count: np.ndarray
    low: np.ndarray
    mean: np.ndarray
    front: np.ndarray


def face_statistics(
    face: np.ndarray, value: np.ndarray, from_front: np.ndarray, n_faces: int, quantile: float = 0.05
) -> FaceStatistics:
    """Statistics of the pixels that see each face (METHOD 2.4, quantile form).

    Args:
        face: (n,) int, -1 = no face.
        value: (n, 3) sensor value (LDR) or radiance (HDR); rows with non-finite values are left out.
        from_front: (n,) bool, the camera is on the side of the face normal.
        n_faces: F.
        quantile: lower quantile; the observation of rank floor(quantile * count), so the minimum below 1 /
            quantile pixels.
    """
    good = (face >= 0) & np.isfinite(value).all(-1)
    face, value, from_front = face[good], np.asarray(value)[good], from_front[good]
    count = np.bincount(face, minlength=n_faces)
    divisor = np.maximum(count, 1)
    brightest = value.max(-1) if len(value) else np.zeros(0)
    order = np.lexsort((brightest, face))
    first = np.cumsum(count) - count
    low = np.zeros(n_faces, np.float32)
    seen = count > 0
    low[seen] = brightest[order][(first + np.floor(quantile * count).astype(np.int64))[seen]]
    mean = np.stack([np.bincount(face, value[:, c], n_faces) / divisor for c in range(3)], -1)
    front = np.bincount(face, from_front.astype(np.float64), n_faces) / divisor
    return FaceStatistics(count.astype(np.int32), low, mean.astype(np.float32), front.astype(np.float32))


def face_adjacency(faces: np.ndarray) -> np.ndarray:
    """Pairs of faces that share an edge (two vertex ids): (m, 2) int32, first < second; edges of more faces are
    chained."""
    faces = np.asarray(faces, np.int64)
    if not len(faces):
        return np.zeros((0, 2), np.int32)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    owner = np.tile(np.arange(len(faces)), 3)
    key = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    order = np.lexsort((owner, key))
    same = (key[order][1:] == key[order][:-1]) & (owner[order][1:] != owner[order][:-1])
    pairs = np.stack([owner[order][:-1][same], owner[order][1:][same]], 1)
    return np.unique(pairs, axis=0).astype(np.int32)


def face_geometry(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (F, 3) by the right-hand rule (0 for degenerate faces) and areas (F,) in m^2; float64."""
    p = np.asarray(vertices, np.float64)[faces]
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    length = np.linalg.norm(cross, axis=-1)
    return cross / np.maximum(length, 1e-30)[:, None], 0.5 * length


def hdr_threshold(statistics: FaceStatistics, ratio: float = 5.0) -> float:
    """Radiance above which a face may be an emitter: `ratio` times the median over pixels.

    The median is of the low quantile of the face that each pixel sees, so highlights do not count and emitters may
    fill up to half of the pixels. A white diffuse surface in a room reflects at most a few times the median; lamps
    and windows exceed it by 10 to 50. Infinite when nothing was seen.
    """
    seen = statistics.count > 0
    if not seen.any():
        return float("inf")
    low, weight = statistics.low[seen], statistics.count[seen]
    order = np.argsort(low, kind="stable")
    cumulative = np.cumsum(weight[order])
    median = float(low[order][np.searchsorted(cumulative, 0.5 * cumulative[-1])])
    positive = low[low > 0]
    floor = float(positive.min()) if len(positive) else 0.0
    return ratio * max(median, floor) if max(median, floor) > 0 else float("inf")


def emitter_candidates(
    statistics: FaceStatistics, adjacency: np.ndarray, areas: np.ndarray, threshold: float, min_observations: int = 8
) -> np.ndarray:
    """Faces that may shine by themselves: (F,) bool (METHOD 2.4).

    A face counts when its low quantile reaches `threshold` over at least `min_observations` pixels. Faces seen by fewer
    pixels are pooled: neighbours (also across a few unseen faces) that all reach the threshold count when together
    they were seen often enough: finely tessellated lamps. Unseen surface whose seen neighbours are candidates to
        90 % joins
    them, up to four times their area or `SMALL_AREA`: the gaps between them, and the far side of a lamp.
    """
    solid, unseen = areas > 1e-12, statistics.count == 0
    bright = ~unseen & (statistics.low >= threshold) & solid
    if not bright.any():
        return bright
    first, second = adjacency[:, 0], adjacency[:, 1]
    reached = bright.copy()
    for _ in range(_BRIDGE):
        grown = reached.copy()
        grown[first[reached[second]]] = True
        grown[second[reached[first]]] = True
        reached = bright | (grown & unseen)
    label = _components(adjacency, reached)
    pooled = np.bincount(label, np.where(bright, statistics.count, 0))
    candidate = bright & (pooled[label] >= min_observations)
    return candidate | (_enclosed(adjacency, areas, unseen, candidate, label) & solid)


def _components(adjacency: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Label of the connected component of every face; faces outside `mask` are alone."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(mask)
    pair = adjacency[mask[adjacency[:, 0]] & mask[adjacency[:, 1]]]
    graph = coo_matrix((np.ones(len(pair), np.int8), (pair[:, 0], pair[:, 1])), (n, n))
    return connected_components(graph, directed=False)[1]


def _enclosed(
    adjacency: np.ndarray, areas: np.ndarray, unseen: np.ndarray, candidate: np.ndarray, pool: np.ndarray
) -> np.ndarray:
    """Unseen faces in regions that border on candidates (almost) alone and are not much larger than their pools."""
    region = _components(adjacency, unseen)
    size = int(region.max(initial=-1)) + 1
    pair = np.concatenate([adjacency, adjacency[:, ::-1]])
    pair = pair[unseen[pair[:, 0]] & ~unseen[pair[:, 1]]]
    border = np.bincount(region[pair[:, 0]], minlength=size)
    pair = pair[candidate[pair[:, 1]]]
    shining = np.bincount(region[pair[:, 0]], minlength=size)
    pool_area = np.bincount(pool, np.where(candidate, areas, 0.0))
    # Each pool counts once for a region, however many edges they share.
    pair = np.unique(np.stack([region[pair[:, 0]], pool[pair[:, 1]]], 1), axis=0)
    lit_area = np.bincount(pair[:, 0], pool_area[pair[:, 1]], size)
    area = np.bincount(region, np.where(unseen, areas, 0.0), size)
    inside = (shining >= 0.9 * border) & (border > 0) & (area <= np.maximum(4.0 * lit_area, SMALL_AREA))
    return unseen & inside[region]


@dataclass(frozen=True)
class EmitterGroups:
    """Emitter groups; group g is row g of the arrays.

    Attributes:
        of_face: (F,) int32 group of every face, -1 = none.
        side: (F,) int32: +1 shines to the side of the normal, -1 to the other, 0 to both; 0 where `of_face` is -1.
        faces: (G,) int32; area: (G,) m^2; observed: (G, 3) mean observed value, weighted by pixels; count: (G,) pixels.
        dropped: [(faces, area, reason)] candidates that were left out.
    """

    of_face: np.ndarray
    side: np.ndarray
    faces: np.ndarray
    area: np.ndarray
    observed: np.ndarray
    count: np.ndarray
    dropped: list[tuple[int, float, str]]

    @property
    def size(self) -> int:
        return len(self.faces)


def group_emitters(
    candidate: np.ndarray,
    statistics: FaceStatistics,
    adjacency: np.ndarray,
    normals: np.ndarray,
    areas: np.ndarray,
    max_angle: float = 15.0,
    max_ratio: float = 1.5,
    small_area: float = SMALL_AREA,
    min_faces: int = 3,
    min_area: float = 1e-4,
    max_groups: int = 64,
    min_observations: int = 8,
) -> EmitterGroups:
    """Candidates in groups that share one radiance (METHOD 8): connected, normals within `max_angle`, colours within
    `max_ratio`, same side. A connected piece below `small_area` is one group whatever its normals (bulbs, shades).

    Merging is greedy from the most similar neighbours on and compares the means of the groups, so that a gradient
    is cut into steps instead of being chained into one group.

    Args:
        candidate: (F,) bool; statistics, adjacency, normals (F, 3), areas (F,): of the same mesh.
        max_angle: degrees; max_ratio: of any channel between two groups; small_area, min_area: m^2.
        min_faces, min_area: a group needs one of the two.
        min_observations: pixels that must have seen a group; a highlight on one face has fewer, and nothing bounds
            its radiance.
        max_groups: the strongest (area x radiance) are kept.
    """
    n_faces = len(candidate)
    ids = np.flatnonzero(candidate)
    side = np.zeros(n_faces, np.int32)
    front = statistics.front[ids]
    side[ids] = np.where(front > 0.9, 1, np.where(front < 0.1, -1, 0))
    # Unseen faces (far sides) follow the majority of what was seen; the normal's side when nothing was.
    unseen = statistics.count[ids] == 0
    seen_sides = side[ids[~unseen]]
    side[ids[unseen]] = (1 if (seen_sides >= 0).mean() >= 0.5 else -1) if len(seen_sides) else 1

    pair = adjacency[candidate[adjacency[:, 0]] & candidate[adjacency[:, 1]]]
    pair = pair[side[pair[:, 0]] == side[pair[:, 1]]]
    local = np.full(n_faces, -1, np.int64)
    local[ids] = np.arange(len(ids))
    label = _components(local[pair], np.ones(len(ids), bool)) if len(ids) else np.zeros(0, np.int64)
    piece_area = np.bincount(label, areas[ids])[label] if len(ids) else np.zeros(0)
    weight = np.maximum(statistics.count[ids], 1e-3).astype(np.float64)
    colour = np.where(unseen[:, None], 0.0, statistics.mean[ids]) * weight[:, None]
    parent = _merge(
        local[pair],
        normals[ids],
        areas[ids],
        colour,
        np.where(unseen, 0.0, weight),
        piece_area < small_area,
        np.cos(np.radians(max_angle)),
        max_ratio,
    )
    label = np.unique(parent, return_inverse=True)[1] if len(ids) else np.zeros(0, np.int64)
    count = np.bincount(label)
    area = np.bincount(label, areas[ids])
    pixels = np.bincount(label, statistics.count[ids])
    observed = np.stack([np.bincount(label, statistics.mean[ids, c] * statistics.count[ids]) for c in range(3)], -1)
    observed = observed / np.maximum(pixels, 1)[:, None]
    solid = ((count >= min_faces) | (area >= min_area)) & (pixels >= min_observations)
    power = area * observed.sum(-1)
    order = np.lexsort((np.arange(len(count)), -power))
    kept = [g for g in order if solid[g]][:max_groups]
    dropped = [
        (
            int(count[g]),
            float(area[g]),
            "too small or hardly seen" if not solid[g] else f"not among the {max_groups} strongest",
        )
        for g in order
        if g not in set(kept)
    ]
    number = np.full(len(count), -1, np.int64)
    number[kept] = np.arange(len(kept))
    of_face = np.full(n_faces, -1, np.int32)
    of_face[ids] = number[label]
    side[of_face < 0] = 0
    kept_index = np.array(kept, np.int64)
    return EmitterGroups(
        of_face,
        side,
        count[kept_index].astype(np.int32),
        area[kept_index],
        observed[kept_index].astype(np.float64),
        pixels[kept_index].astype(np.int64),
        dropped,
    )


def _merge(
    pair: np.ndarray,
    normals: np.ndarray,
    areas: np.ndarray,
    colour: np.ndarray,
    weight: np.ndarray,
    small: np.ndarray,
    min_cosine: float,
    max_ratio: float,
) -> np.ndarray:
    """Union-find over neighbouring faces; returns the root of each."""
    n = len(areas)
    parent = np.arange(n)
    normal_sum, colour_sum, weight_sum = normals * areas[:, None], colour.copy(), weight.astype(np.float64).copy()

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    def ratio(i: int, j: int) -> float:
        if weight_sum[i] == 0 or weight_sum[j] == 0:
            return 1.0
        a, b = colour_sum[i] / weight_sum[i] + 1e-6, colour_sum[j] / weight_sum[j] + 1e-6
        return float(np.max(np.maximum(a / b, b / a)))

    first = np.array([ratio(i, j) for i, j in pair]) if len(pair) else np.zeros(0)
    for e in np.argsort(first, kind="stable"):
        i, j = root(int(pair[e, 0])), root(int(pair[e, 1]))
        if i == j or ratio(i, j) >= max_ratio:
            continue
        if not small[i]:
            a, b = normal_sum[i], normal_sum[j]
            if a @ b < min_cosine * np.sqrt((a @ a) * (b @ b)):
                continue
        i, j = min(i, j), max(i, j)
        parent[j] = i
        normal_sum[i] += normal_sum[j]
        colour_sum[i] += colour_sum[j]
        weight_sum[i] += weight_sum[j]
    return np.array([root(i) for i in range(n)])


@dataclass(frozen=True)
class RadianceVoxels:
    """A sparse voxel radiance cache.

    Attributes:
        edge: m; origin: (3,) corner of voxel (0, 0, 0).
        ijk: (n, 3) int32, in order of key; a voxel that is not listed is unknown, not black (METHOD H27).
        radiance: (n, 3) float32 mean of the uncensored observations; where there are none the largest censored
            one, a lower bound (H60).
        samples: (n,) int32 observations behind `radiance`.
        censored: (n,) bool, `radiance` is a lower bound.
    """

    edge: float
    origin: np.ndarray
    ijk: np.ndarray
    radiance: np.ndarray
    samples: np.ndarray
    censored: np.ndarray


class RadianceSums:
    """Running sums per voxel: `add` the pixels of one view after another, then `finish` (METHOD 2.0).

    Args:
        edge: voxel edge in m.
        origin: (3,) corner of voxel (0, 0, 0), below all points: `cells.grid_origin` of the mesh.
    """

    def __init__(self, edge: float, origin: np.ndarray):
        self.edge, self.origin = float(edge), np.asarray(origin, np.float32)
        self._key = np.zeros(0, np.uint64)
        # columns: sum R G B, count, largest censored R G B, censored count
        self._value = np.zeros((0, 8))

    def add(self, points: np.ndarray, radiance: np.ndarray, censored: np.ndarray) -> None:
        """Add pixels: points (n, 3) in m, radiance (n, 3) linear, censored (n,) bool; non-finite rows are left out.

        The caller leaves out pixels on emitters (METHOD H28).

        Raises:
            InputError: edge not positive, or a point outside the 65536 voxels an axis from the origin.
        """
        good = np.isfinite(radiance).all(-1) & np.isfinite(points).all(-1)
        key = pack_keys(voxel_indices(np.asarray(points)[good], self.edge, self.origin))
        value, clipped = np.asarray(radiance, np.float64)[good], np.asarray(censored)[good]
        row = np.concatenate(
            [
                np.where(clipped[:, None], 0.0, value),
                (~clipped)[:, None],
                np.where(clipped[:, None], value, 0.0),
                clipped[:, None],
            ],
            1,
        )
        key = np.concatenate([self._key, key])
        row = np.concatenate([self._value, row])
        if not len(key):
            return
        order = np.argsort(key, kind="stable")
        starts = np.flatnonzero(np.r_[True, key[order][1:] != key[order][:-1]])
        self._key = key[order][starts]
        sums = np.add.reduceat(row[order], starts, 0)
        sums[:, 4:7] = np.maximum.reduceat(row[order][:, 4:7], starts, 0)
        self._value = sums

    def finish(self) -> RadianceVoxels:
        """The cache of what was added so far."""
        count, clipped = self._value[:, 3], self._value[:, 7]
        bound = count == 0
        mean = self._value[:, :3] / np.maximum(count, 1)[:, None]
        radiance = np.where(bound[:, None], self._value[:, 4:7], mean)
        ijk = unpack_keys(self._key)[0]
        samples = np.where(bound, clipped, count).astype(np.int32)
        return RadianceVoxels(self.edge, self.origin, ijk, radiance.astype(np.float32), samples, bound)
