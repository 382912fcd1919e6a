"""2D masks of many views -> objects, by view consensus (METHOD 2.2; written from that description).

A mask is a set of surface points that one view holds together. Views vote: view f *contains* mask m if most of what f sees
of m lies in one mask of f, and *splits* m if it does not. A mask that too many views split holds several things and is
dropped. Two masks belong together if nearly every view that contains both contains them in one mask:

    consensus(i, j) = |C_i and C_j| / |V_i and V_j|                    (supporters over observers)

with V_i the views that contain i, and C_i the masks that do. Pairs with many observers are joined first; what is joined is
one node from then on (V and C by union), and the bar is lowered step by step.

Points stand for equal pieces of surface; a mask's points are those that project into it. Rows of the sparse matrices are
handled in blocks of `BLOCK`: no dense mask-by-mask matrix is ever made.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from iif_core.camera.pinhole import project
from iif_core.errors import InputError

Array = np.ndarray

BLOCK = 2048
"""Masks whose rows are held densely at once."""

ENOUGH_POINTS = 500
"""So many visible points count as seeing a mask, however small their share."""

MASKED_SHARE = 0.5
"""A view whose masks cover less than this of what it sees of a mask has no opinion about it."""

MIN_OBSERVERS = 2
"""Views that must contain both masks of a pair before they can be joined."""

PERCENTILES = tuple(range(95, -1, -5))
"""Of the observers of all pairs with a supporter: the bars, from high to low."""


@dataclass(frozen=True)
class ConsensusOptions:
    """Shares in (0, 1]: see the module text. `min_points`: a mask of fewer points is ignored."""

    visible: float = 0.3
    contained: float = 0.8
    split: float = 0.5
    consensus: float = 0.9
    min_points: int = 4


def flatten_masks(masks: Sequence[Array]) -> Array:
    """One label map (H, W) int32 of overlapping masks (H, W) bool: painted from the largest on, so that small ones lie
    on top; label = position in the sequence + 1, 0 = none. Equal areas: the later one is on top.

    Raises:
        InputError: shapes that differ.
    """
    shapes = {np.shape(mask) for mask in masks}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise InputError(f"masks of one view have the shapes {sorted(shapes)}; all must be (H, W), the same")
    out = np.zeros(next(iter(shapes)), np.int32)
    area = np.array([np.count_nonzero(mask) for mask in masks])
    for i in np.argsort(-area, kind="stable").tolist():
        out[np.asarray(masks[i], bool)] = i + 1
    return out


def masks_at(
    points: ArrayLike,
    labels: ArrayLike,
    depth: ArrayLike,
    camera: tuple[float, float, float, float],
    pose: ArrayLike,
    slack: float,
) -> tuple[Array, Array]:
    """Which points a view sees, and the label there: (rows (n,) int64 ascending, label (n,) int32).

    A point is seen if the depth at the pixel that it projects to is its own within `slack` (metres) + 2 %.

    Args:
        points: (m, 3) metres.
        labels, depth: (H, W), z-depth in metres with 0 = miss.
        camera: fx, fy, cx, cy in pixels (`iif_core.camera.pinhole.project`).
        pose: (4, 4) world_from_camera.
    """
    labels, depth = np.asarray(labels), np.asarray(depth)
    height, width = depth.shape
    u, v, z = project(points, *camera, pose)
    row = np.flatnonzero((z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
    i, j = v[row].astype(np.int64), u[row].astype(np.int64)
    there = depth[i, j]
    seen = (there > 0) & (np.abs(there - z[row]) <= slack + 0.02 * z[row])
    return row[seen], labels[i[seen], j[seen]].astype(np.int32)


@dataclass(frozen=True)
class MaskPoints:
    """Masks of all views over E points: M masks sorted by view.

    in_mask: (M, E) csr float32 of 0 and 1; visible: (F, E) likewise; view: (M,) int32 view of each mask; label: (M,)
    int32 its label in that view's map.
    """

    in_mask: Any
    visible: Any
    view: Array
    label: Array


def gather_masks(seen: Sequence[tuple[Array, Array]], count: int, min_points: int) -> MaskPoints:
    """Masks from what `masks_at` found in every view; label 0 or less = no mask, as are masks of fewer points.

    `count`: number of points, E.
    """
    from scipy.sparse import csr_matrix, vstack

    rows, visible, views, labels = [], [], [], []
    for view, (point, label) in enumerate(seen):
        visible.append(csr_matrix((np.ones(len(point), np.float32), point, [0, len(point)]), (1, count)))
        kept = label > 0
        ids, which, size = np.unique(label[kept], return_inverse=True, return_counts=True)
        large = size >= min_points
        rank = np.cumsum(large) - 1
        used = large[which]
        at = (rank[which[used]], point[kept][used])
        rows.append(csr_matrix((np.ones(len(at[0]), np.float32), at), (int(large.sum()), count)))
        views.append(np.full(int(large.sum()), view, np.int32))
        labels.append(ids[large].astype(np.int32))
    return MaskPoints(vstack(rows, format="csr"), vstack(visible, format="csr"), np.concatenate(views), np.concatenate(labels))


@dataclass(frozen=True)
class Containment:
    """What view f says of mask m. container: (M, F) int32, the mask of f that contains m, -1 = none; split: (M, F) bool."""

    container: Array
    split: Array


def containment(masks: MaskPoints, options: ConsensusOptions) -> Containment:
    """Every view's vote on every mask: contained, split, or (neither) not seen well enough."""
    count, views = len(masks.view), masks.visible.shape[0]
    container, split = np.full((count, views), -1, np.int32), np.zeros((count, views), bool)
    for rows in _blocks(count):
        block = masks.in_mask[rows]
        size = np.asarray(block.sum(1)).ravel()
        seen = np.asarray((block @ masks.visible.T).todense())
        shared = (block @ masks.in_mask.T).tocsr()
        shared.sort_indices()
        row = np.repeat(np.arange(shared.shape[0]), np.diff(shared.indptr))
        view = masks.view[shared.indices]
        masked = np.zeros(seen.shape)
        np.add.at(masked, (row, view), shared.data)
        # The largest overlap of every (row, view), the lowest mask among equals: last after this sort.
        order = np.lexsort((-shared.indices, shared.data, view, row))
        last = np.flatnonzero(np.r_[np.diff(row[order] * views + view[order]) > 0, len(order) > 0])
        best = order[last]
        r, f = row[best], view[best]
        visible = (seen[r, f] >= options.visible * size[r]) | (seen[r, f] >= ENOUGH_POINTS)
        judged = visible & (masked[r, f] >= MASKED_SHARE * seen[r, f])
        inside = shared.data[best] > options.contained * masked[r, f]
        holds = judged & inside
        container[rows.start + r[holds], f[holds]] = shared.indices[best][holds]
        broken = judged & ~inside
        split[rows.start + r[broken], f[broken]] = True
    return Containment(container, split)


def undersegmented(votes: Containment, limit: float) -> Array:
    """(M,) bool: more than `limit` of the views with an opinion split the mask."""
    broken, whole = votes.split.sum(1), (votes.container >= 0).sum(1)
    return broken > limit * (broken + whole)


def cluster_masks(masks: MaskPoints, options: ConsensusOptions | None = None) -> Array:
    """Cluster of every mask, (M,) int32 from 0 in order of the first mask; -1 = dropped as under-segmented.

    Raises:
        InputError: an option outside (0, 1].
    """
    options = options or ConsensusOptions()
    for name in ("visible", "contained", "split", "consensus"):
        if not 0 < getattr(options, name) <= 1:
            raise InputError(f"mask clustering: {name} is {getattr(options, name)}; it must be above 0 and at most 1")
    count = len(masks.view)
    labels = np.full(count, -1, np.int32)
    if count == 0:
        return labels
    votes = containment(masks, options)
    dropped = undersegmented(votes, options.split)
    # A dropped mask's opinion is void: the view neither contains nor splits what lay in it.
    container = np.where((votes.container >= 0) & ~dropped[votes.container], votes.container, -1)
    kept = np.flatnonzero(~dropped)
    if len(kept):
        labels[kept] = _join(container[kept], count, options.consensus)
    return labels


def _join(container: Array, count: int, consensus: float) -> Array:
    """Clusters (n,) int32 of n masks from the masks that contain them, (n, F)."""
    from scipy.sparse import csr_matrix

    n = len(container)
    views = packed_flags(container >= 0)
    row, view = np.nonzero(container >= 0)
    holders = csr_matrix((np.ones(len(row), np.float32), (row, container[row, view])), (n, count))
    node = np.arange(n)
    bars: list[int] | None = None
    while True:
        first, second, supporters, observers = agreeing_pairs(holders, views)
        if bars is None:
            if not len(first):
                return _numbered(node)
            found = np.floor(np.percentile(observers, PERCENTILES)).astype(int)
            bars = sorted({max(int(bar), MIN_OBSERVERS) for bar in found}, reverse=True)
        agree = supporters >= consensus * observers
        while bars:
            joined = agree & (observers >= bars[0])
            if joined.any():
                break
            bars.pop(0)
        if not bars:
            return _numbered(node)
        group = components(len(views), first[joined], second[joined])
        node = group[node]
        views, holders = _merged(views, holders, group)
        bars.pop(0)
        if not bars:
            return _numbered(node)


def agreeing_pairs(holders: Any, views: Array) -> tuple[Array, Array, Array, Array]:
    """Pairs of nodes i < j with a supporter: i, j, supporters, observers.

    holders: (n, M) csr of 0 and 1, the masks that hold a node; views: `packed_flags` of the (n, F) views that do.
    """
    parts: list[tuple[Array, Array, Array, Array]] = []
    for rows in _blocks(holders.shape[0]):
        shared = (holders[rows] @ holders.T).tocoo()
        i, j = shared.row + rows.start, shared.col
        above = j > i
        i, j, supporters = i[above], j[above], shared.data[above]
        observers = np.bitwise_count(views[i] & views[j]).sum(1, dtype=np.int64)
        parts.append((i, j, supporters, observers))
    i, j, supporters, observers = (np.concatenate(column) for column in zip(*parts, strict=True))
    seen = observers > 0
    return i[seen], j[seen], supporters[seen], observers[seen]


def _merged(views: Array, holders: Any, group: Array) -> tuple[Array, Any]:
    """Views and holders of the groups: unions over their nodes."""
    from scipy.sparse import csr_matrix

    order = np.argsort(group, kind="stable")
    start = np.flatnonzero(np.r_[True, np.diff(group[order]) > 0])
    together = csr_matrix((np.ones(len(group), np.float32), (group, np.arange(len(group)))), (len(start), len(group)))
    union = (together @ holders).tocsr()
    union.data[:] = 1
    return np.bitwise_or.reduceat(views[order], start, axis=0), union


def components(count: int, first: Array, second: Array) -> Array:
    """(count,) connected component of every node of a graph with the edges (first, second)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(first), np.int8), (first, second)), (count, count))
    return connected_components(graph, directed=False)[1]


def packed_flags(flags: Array) -> Array:
    """(n, F) bool as (n, words) uint64."""
    width = -(-flags.shape[1] // 64) * 64
    padded = np.zeros((len(flags), width), bool)
    padded[:, : flags.shape[1]] = flags
    return np.packbits(padded, axis=1).view(np.uint64)


def _blocks(count: int) -> Iterator[slice]:
    return (slice(start, min(start + BLOCK, count)) for start in range(0, count, BLOCK))


def _numbered(labels: Array) -> Array:
    """Labels counted from 0 in order of first occurrence, int32."""
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    return rank[inverse.ravel()]
