"""Candidate faces in groups that share one unknown radiance (METHOD 8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.light.emission.candidates import SMALL_AREA, FaceStatistics, components


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

    def select(self, kept: np.ndarray) -> EmitterGroups:
        """The groups of a mask (G,), renumbered."""
        number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1).astype(np.int32)
        of_face = number[self.of_face]
        side = np.where(of_face >= 0, self.side, 0).astype(np.int32)
        rows = (self.faces[kept], self.area[kept], self.observed[kept], self.count[kept])
        return EmitterGroups(of_face, side, *rows, self.dropped)


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
    label = components(local[pair], np.ones(len(ids), bool)) if len(ids) else np.zeros(0, np.int64)
    piece_area = np.bincount(label, areas[ids])[label] if len(ids) else np.zeros(0)
    # A face that is always saturated has no colour to compare.
    weight = statistics.clear[ids].astype(np.float64)
    colour = statistics.mean[ids] * weight[:, None]
    parent = _merge(
        local[pair],
        normals[ids],
        areas[ids],
        colour,
        weight,
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
