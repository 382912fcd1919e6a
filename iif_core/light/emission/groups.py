"""Candidate faces merged into groups that share one unknown radiance (docs/method/light.md#emitter-groups)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.light.emission.candidates import SMALL_AREA, FaceStatistics, components
from iif_core.numerics.graph import component_labels


@dataclass(frozen=True)
class EmitterGroups:
    """Emitter groups; group g is row g of the arrays.

    Attributes:
        of_face: (F,) int32 group of every face, -1 = none.
        side: (F,) int32: +1 shines to the side of the normal, -1 to the other, 0 to both; 0 where `of_face` is -1.
        faces: (G,) int32; area: (G,) m^2; observed: (G, 3) mean observed value, weighted by pixels; count: (G,) pixels, 0 for
            surface that no camera sees.
        dropped: [(faces, area, reason)] groups that were left out.
    """

    of_face: np.ndarray
    side: np.ndarray
    faces: np.ndarray
    area: np.ndarray
    observed: np.ndarray
    count: np.ndarray
    dropped: list[tuple[int, float, str]]

    @classmethod
    def none(cls, faces: int) -> EmitterGroups:
        """No groups on a mesh of so many faces."""
        of_face, side = np.full(faces, -1, np.int32), np.zeros(faces, np.int32)
        count = np.zeros(0, np.int64)
        return cls(of_face, side, count.astype(np.int32), np.zeros(0), np.zeros((0, 3)), count, [])

    @property
    def size(self) -> int:
        return len(self.faces)

    @property
    def is_hidden(self) -> np.ndarray:
        """(G,) bool: no camera sees the group, or hardly (`odds.ObjectLooks.known`)."""
        return self.count == 0

    @property
    def sides(self) -> np.ndarray:
        """(G,) int32 side that shines, as in `side`; 0 = both, or some faces the one and some the other."""
        sides = (np.unique(self.side[self.of_face == g]) for g in range(self.size))
        return np.array([own[0] if len(own) == 1 else 0 for own in sides], np.int32)

    def select(self, kept: np.ndarray) -> EmitterGroups:
        """The groups of a mask (G,), renumbered."""
        number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1).astype(np.int32)  # the last is for -1, no group
        of_face = number[self.of_face]
        side = np.where(of_face >= 0, self.side, 0).astype(np.int32)
        rows = (self.faces[kept], self.area[kept], self.observed[kept], self.count[kept])
        return EmitterGroups(of_face, side, *rows, self.dropped)


@dataclass(frozen=True)
class GroupingOptions:
    """Which candidates are merged (Eq. L.5), and which groups are kept.

    Attributes:
        max_angle: degrees between the normals of two groups that are merged.
        max_ratio: of any channel between the colours of two groups that are merged.
        small_area: m^2; a connected piece below it is one group whatever its normals (bulbs, shades), and a group below it that
            was never seen unsaturated joins a neighbour that was not either (the rim of a panel).
        min_faces, min_area (m^2): a group needs one of the two.
        min_observations: pixels that must have seen a group; nothing bounds the radiance of a highlight on one face.
        max_groups: the strongest groups (area x radiance) are kept.
    """

    max_angle: float = 15.0
    max_ratio: float = 1.5
    small_area: float = SMALL_AREA
    min_faces: int = 3
    min_area: float = 1e-4
    max_groups: int = 64
    min_observations: int = 8


def group_emitters(
    candidate: np.ndarray,
    statistics: FaceStatistics,
    adjacency: np.ndarray,
    normals: np.ndarray,
    areas: np.ndarray,
    options: GroupingOptions | None = None,
    glowing: np.ndarray | None = None,
) -> EmitterGroups:
    """Merge candidates into groups that share one radiance (docs/method/light.md#emitter-groups).

    Faces of a group are connected, shine to the same side, and have similar normals and colours. Merging is greedy from the
    most similar neighbours on and compares the means of whole groups, so that a gradient is cut into steps instead of being
    chained into one group.

    Args:
        candidate: (F,) bool.
        statistics: of the faces of the same mesh.
        adjacency: (E, 2) pairs of neighbouring faces.
        normals, areas: (F, 3) unit vectors, and (F,) m^2.
        options: None = defaults.
        glowing: (F,) from `candidates.glowing_pieces`: groups with faces of one piece that shine to one side are
            joined, whatever their normals and colours; None = none.

    Returns:
        The groups, strongest first.
    """
    options = options or GroupingOptions()
    ids = np.flatnonzero(candidate)
    side = _sides(candidate, statistics)
    pair = adjacency[candidate[adjacency[:, 0]] & candidate[adjacency[:, 1]]]
    pair = pair[side[pair[:, 0]] == side[pair[:, 1]]]
    # Candidates are numbered from 0 in what follows.
    local = np.full(len(candidate), -1, np.int64)
    local[ids] = np.arange(len(ids))
    label = components(local[pair], np.ones(len(ids), bool)) if len(ids) else np.zeros(0, np.int64)
    piece_area = np.bincount(label, areas[ids])[label] if len(ids) else np.zeros(0)
    # A face that is always saturated has no colour to compare.
    weight = statistics.clear[ids].astype(np.float64)
    colour = statistics.mean[ids] * weight[:, None]
    small, min_cosine = piece_area < options.small_area, np.cos(np.radians(options.max_angle))
    limits = min_cosine, options.max_ratio, options.small_area
    parent = _merge(local[pair], normals[ids], areas[ids], colour, weight, small, *limits)
    label = np.unique(parent, return_inverse=True)[1] if len(ids) else np.zeros(0, np.int64)
    if glowing is not None and (glowing[ids] >= 0).any():
        # One number for each piece and side.
        label = _joined(label, np.where(glowing[ids] >= 0, 3 * glowing[ids].astype(np.int64) + side[ids] + 1, -1))
    return _strongest(ids, label, side, statistics, areas, options)


def _joined(label: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """Join groups, (n,) from 0, that have faces of the same piece, (n,) >= 0, -1 = of none; returns labels from 0."""
    inside = np.flatnonzero(piece >= 0)
    size = int(label.max()) + 1
    # Groups and pieces are the nodes of one graph, in which each face links its group to its piece.
    node = size + np.unique(piece[inside], return_inverse=True)[1]
    joined = component_labels(int(node.max()) + 1, label[inside], node)
    return np.unique(joined[label], return_inverse=True)[1]


def _sides(candidate: np.ndarray, statistics: FaceStatistics) -> np.ndarray:
    """(F,) int32 side to which each candidate shines; unseen ones (far sides) follow the majority of what was seen, or the
    normal where nothing was."""
    side, ids = np.zeros(len(candidate), np.int32), np.flatnonzero(candidate)
    front = statistics.front[ids]
    side[ids] = np.where(front > 0.9, 1, np.where(front < 0.1, -1, 0))
    unseen = statistics.count[ids] == 0
    seen_sides = side[ids[~unseen]]
    side[ids[unseen]] = (1 if (seen_sides >= 0).mean() >= 0.5 else -1) if len(seen_sides) else 1
    return side


def _strongest(
    ids: np.ndarray,
    label: np.ndarray,
    side: np.ndarray,
    statistics: FaceStatistics,
    areas: np.ndarray,
    options: GroupingOptions,
) -> EmitterGroups:
    """The groups that are large enough, seen often enough and strong enough; `label` is the group of each face `ids`."""
    count = np.bincount(label)
    area = np.bincount(label, areas[ids])
    pixels = np.bincount(label, statistics.count[ids])
    observed = np.stack([np.bincount(label, statistics.mean[ids, c] * statistics.count[ids]) for c in range(3)], -1)
    observed = observed / np.maximum(pixels, 1)[:, None]
    solid = ((count >= options.min_faces) | (area >= options.min_area)) & (pixels >= options.min_observations)
    # By power, the strongest first; ties by number.
    order = np.lexsort((np.arange(len(count)), -area * observed.sum(-1)))
    kept = np.array([g for g in order if solid[g]][: options.max_groups], np.int64)
    reasons = np.where(solid, f"not among the {options.max_groups} strongest", "too small or hardly seen")
    dropped = [(int(count[g]), float(area[g]), str(reasons[g])) for g in order if g not in set(kept)]
    number = np.full(len(count), -1, np.int64)
    number[kept] = np.arange(len(kept))
    of_face = np.full(len(side), -1, np.int32)
    of_face[ids] = number[label]
    return EmitterGroups(
        of_face,
        np.where(of_face < 0, 0, side).astype(np.int32),
        count[kept].astype(np.int32),
        area[kept],
        observed[kept].astype(np.float64),
        pixels[kept].astype(np.int64),
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
    rim_area: float,
) -> np.ndarray:
    """Union-find over neighbouring faces (Eq. L.5); returns the root of each. Whole groups below `rim_area` that were never seen
    unsaturated then join neighbours that were not either, whatever the normals."""
    n = len(areas)
    parent = np.arange(n)
    normal_sum, colour_sum, weight_sum = normals * areas[:, None], colour.copy(), weight.astype(np.float64).copy()
    area_sum = areas.astype(np.float64).copy()

    def root(i: int) -> int:
        # Path halving keeps the trees flat.
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    def ratio(i: int, j: int) -> float:
        # A group that is always saturated has no colour to compare and passes.
        if weight_sum[i] == 0 or weight_sum[j] == 0:
            return 1.0
        a, b = colour_sum[i] / weight_sum[i] + 1e-6, colour_sum[j] / weight_sum[j] + 1e-6
        return float(np.max(np.maximum(a / b, b / a)))

    def join(i: int, j: int) -> None:
        i, j = min(i, j), max(i, j)
        parent[j] = i
        for total in (normal_sum, colour_sum, weight_sum, area_sum):
            total[i] += total[j]

    # -------- greedy merging, the most similar neighbours first --------
    # Ratios are taken anew from whole groups before each merge, so a gradient is cut into steps.
    first = np.array([ratio(i, j) for i, j in pair]) if len(pair) else np.zeros(0)
    for e in np.argsort(first, kind="stable"):
        i, j = root(int(pair[e, 0])), root(int(pair[e, 1]))
        if i == j or ratio(i, j) >= max_ratio:
            continue
        # All faces of a connected piece have the same entry in `small`, so the root's entry holds for the group.
        if not small[i]:
            a, b = normal_sum[i], normal_sum[j]
            if a @ b < min_cosine * np.sqrt((a @ a) * (b @ b)):
                continue
        join(i, j)

    # -------- rims of saturated panels --------
    # A photograph that is saturated on lamp and rim alike cannot say that the rim only reflects. Groups are whole by now: the
    # smallest is joined to its largest neighbour first.
    seen_clear, area = weight_sum > 0, area_sum.copy()
    edge = np.array([[root(int(i)), root(int(j))] for i, j in pair], np.int64).reshape(-1, 2)
    edge = np.unique(np.sort(edge[(edge[:, 0] != edge[:, 1]) & ~seen_clear[edge].any(1)], axis=1), axis=0)
    small_one, large_one = area[edge].min(1), area[edge].max(1)
    for i, j in edge[np.lexsort((-large_one, small_one))]:
        i, j = root(int(i)), root(int(j))
        if i != j and min(area_sum[i], area_sum[j]) < rim_area:
            join(i, j)
    return np.array([root(i) for i in range(n)])
