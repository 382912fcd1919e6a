"""Objects from 2D masks of many views by view consensus (docs/method/objects.md#masks, Eq. O.7 to O.12).

Points represent equal pieces of surface. The rows of the sparse matrices are handled in blocks of `BLOCK_MASKS`, so no dense
mask-by-mask matrix is made.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from iif_core.camera.pinhole import project
from iif_core.errors import InputError
from iif_core.numerics.arrays import numbered_by_first
from iif_core.numerics.graph import component_labels
from iif_core.objects.options import ConsensusOptions

Array = np.ndarray

BLOCK_MASKS = 2048
"""Number of masks whose rows are held densely at once."""

SUFFICIENT_POINTS = 500
"""Number of visible points that suffices to see a mask, whatever their share."""

MASKED_SHARE = 0.5
"""Share of the visible points of a mask that must lie in masks of a view; otherwise the view has no opinion."""

MIN_OBSERVERS = 2
"""Smallest number of views that must contain both masks of a pair before they can be joined."""

PERCENTILES = tuple(range(95, -1, -5))
"""Percentiles of the number of observers, over all pairs with a supporter, that are required step by step."""


def flatten_masks(masks: Sequence[Array]) -> Array:
    """Paint overlapping masks (H, W) bool into one label map (H, W) int32, from the largest to the smallest.

    The label of a mask is its position in the sequence + 1; 0 = none. Of equal areas the later mask is on top.

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
    """Find the points that a view sees, and the mask label at each.

    A point is seen if it projects into the picture and the depth map there differs from its depth by at most
    slack + 2 % (Eq. O.7).

    Args:
        points: (m, 3) in metres.
        labels: (H, W) int.
        depth: (H, W) z-depth in metres; 0 = miss.
        camera: fx, fy, cx, cy in pixels (`iif_core.camera.pinhole.project`).
        pose: (4, 4) world_from_camera.
        slack: tolerance in metres.

    Returns:
        Rows of the seen points, (n,) int64 ascending, and their labels (n,) int32.
    """
    labels, depth = np.asarray(labels), np.asarray(depth)
    height, width = depth.shape
    u, v, z = project(points, *camera, pose)
    row = np.flatnonzero((z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
    i, j = v[row].astype(np.int64), u[row].astype(np.int64)  # pixel i covers [i, i + 1)
    there = depth[i, j]
    seen = (there > 0) & (np.abs(there - z[row]) <= slack + 0.02 * z[row])
    return row[seen], labels[i[seen], j[seen]].astype(np.int32)


@dataclass(frozen=True)
class MaskPoints:
    """The masks of all views as sets of points; M masks in the order of their views, E points, F views.

    Attributes:
        in_mask: (M, E) csr float32 of 0 and 1; visible: (F, E) likewise.
        view: (M,) int32 view of each mask; label: (M,) int32 its label in the map of that view.
    """

    in_mask: Any
    visible: Any
    view: Array
    label: Array


def gather_masks(seen: Sequence[tuple[Array, Array]], count: int, min_points: int) -> MaskPoints:
    """Collect rows and labels (0 or less = no mask) of `masks_at` of all views as sets of points; masks below `min_points` are
    left out.
    """
    from scipy.sparse import csr_matrix, vstack

    rows, visible, views, labels = [], [], [], []
    for view, (point, label) in enumerate(seen):
        visible.append(csr_matrix((np.ones(len(point), np.float32), point, [0, len(point)]), (1, count)))
        kept = label > 0
        ids, which, size = np.unique(label[kept], return_inverse=True, return_counts=True)
        large = size >= min_points  # masks of enough points; `rank` is their row in this view
        rank = np.cumsum(large) - 1
        used = large[which]
        at = (rank[which[used]], point[kept][used])
        rows.append(csr_matrix((np.ones(len(at[0]), np.float32), at), (int(large.sum()), count)))
        views.append(np.full(int(large.sum()), view, np.int32))
        labels.append(ids[large].astype(np.int32))
    return MaskPoints(vstack(rows, format="csr"), vstack(visible, format="csr"), np.concatenate(views), np.concatenate(labels))


@dataclass(frozen=True)
class Containment:
    """Opinion of view f on mask m.

    Attributes:
        container: (M, F) int32, the mask of f that contains m; -1 = none.
        split: (M, F) bool, whether f splits m. A view that neither contains nor splits a mask has no opinion.
    """

    container: Array
    split: Array


def containment(masks: MaskPoints, options: ConsensusOptions) -> Containment:
    """Compute the opinion of every view on every mask (Eq. O.8, O.9)."""
    count, views = len(masks.view), masks.visible.shape[0]
    container, split = np.full((count, views), -1, np.int32), np.zeros((count, views), bool)
    for rows in _blocks(count):
        block = masks.in_mask[rows]
        # -------- |M| (n,), |S_f(M)| (n, F), shared points of every two masks (n, M) and |L_f(M)| (n, F) --------
        size = np.asarray(block.sum(1)).ravel()
        seen = np.asarray((block @ masks.visible.T).todense())
        shared = (block @ masks.in_mask.T).tocsr()
        shared.sort_indices()
        row = np.repeat(np.arange(shared.shape[0]), np.diff(shared.indptr))
        view = masks.view[shared.indices]
        # Masks of one view have no point in common, so their shares of M add up. A view without any of them has no entry below.
        masked = np.zeros(seen.shape)
        np.add.at(masked, (row, view), shared.data)
        # The largest overlap of every (row, view), the lowest mask among equals: last after this sort.
        order = np.lexsort((-shared.indices, shared.data, view, row))
        last = np.flatnonzero(np.r_[np.diff(row[order] * views + view[order]) > 0, len(order) > 0])
        best = order[last]
        # -------- which views can judge, contain or split (Eq. O.8, O.9) --------
        r, f = row[best], view[best]
        visible = (seen[r, f] >= options.visible * size[r]) | (seen[r, f] >= SUFFICIENT_POINTS)
        judged = visible & (masked[r, f] >= MASKED_SHARE * seen[r, f])
        inside = shared.data[best] > options.contained * masked[r, f]
        holds = judged & inside
        container[rows.start + r[holds], f[holds]] = shared.indices[best][holds]
        broken = judged & ~inside
        split[rows.start + r[broken], f[broken]] = True
    return Containment(container, split)


def undersegmented(votes: Containment, limit: float) -> Array:
    """Find masks that more than the share `limit` of the views that can judge them split (Eq. O.10); (M,) bool."""
    broken, whole = votes.split.sum(1), (votes.container >= 0).sum(1)
    return broken > limit * (broken + whole)


def cluster_masks(masks: MaskPoints, options: ConsensusOptions | None = None) -> Array:
    """Cluster the masks of all views.

    Returns:
        (M,) int32 clusters from 0 in the order of their first mask; -1 = dropped as under-segmented.

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
    # A dropped mask contains nothing: its view has no opinion on the masks that it held.
    container = np.where((votes.container >= 0) & ~dropped[votes.container], votes.container, -1)
    kept = np.flatnonzero(~dropped)
    if len(kept):
        labels[kept] = _join(container[kept], count, options.consensus)  # `container` keeps the numbers of all masks
    return labels


def _join(container: Array, count: int, consensus: float) -> Array:
    """Cluster n masks from the masks that contain them, (n, F); (n,) int32."""
    from scipy.sparse import csr_matrix

    n = len(container)
    # V_i as bits, and C_i as rows of a sparse matrix over all masks.
    views = packed_flags(container >= 0)
    row, view = np.nonzero(container >= 0)
    holders = csr_matrix((np.ones(len(row), np.float32), (row, container[row, view])), (n, count))
    node = np.arange(n)
    thresholds: list[int] | None = None  # falling minima of observers (Eq. O.12), known after the first turn
    while True:
        first, second, supporters, observers = agreeing_pairs(holders, views)
        # The minima come from pairs of single masks, before anything is joined.
        if thresholds is None:
            if not len(first):
                return numbered_by_first(node)
            found = np.floor(np.percentile(observers, PERCENTILES)).astype(int)
            thresholds = sorted({max(int(number), MIN_OBSERVERS) for number in found}, reverse=True)
        agree = supporters >= consensus * observers  # Eq. O.11
        # Minima that join nothing are passed over without a new count of pairs.
        while thresholds:
            linked = agree & (observers >= thresholds[0])
            if linked.any():
                break
            thresholds.pop(0)
        if not thresholds:
            return numbered_by_first(node)
        group = component_labels(len(views), first[linked], second[linked])
        # -------- joined nodes have the unions of views and masks; a minimum is used once --------
        node = group[node]
        views, holders = _merged(views, holders, group)
        thresholds.pop(0)
        if not thresholds:
            return numbered_by_first(node)


def agreeing_pairs(holders: Any, views: Array) -> tuple[Array, Array, Array, Array]:
    """Find pairs of nodes i < j with a supporter: i, j, supporters, observers.

    holders: (n, M) csr of 0 and 1, the masks that contain a node; views: `packed_flags` of the (n, F) views that do.
    """
    parts: list[tuple[Array, Array, Array, Array]] = []
    for rows in _blocks(holders.shape[0]):
        shared = (holders[rows] @ holders.T).tocoo()
        i, j = shared.row + rows.start, shared.col
        above = j > i  # each pair once, no node with itself
        i, j, supporters = i[above], j[above], shared.data[above]
        observers = np.bitwise_count(views[i] & views[j]).sum(1, dtype=np.int64)  # size of the intersection of V_i and V_j
        parts.append((i, j, supporters, observers))
    i, j, supporters, observers = (np.concatenate(column) for column in zip(*parts, strict=True))
    seen = observers > 0
    return i[seen], j[seen], supporters[seen], observers[seen]


def _merged(views: Array, holders: Any, group: Array) -> tuple[Array, Any]:
    """Views and holders of groups of nodes: the unions over their nodes."""
    from scipy.sparse import csr_matrix

    order = np.argsort(group, kind="stable")
    start = np.flatnonzero(np.r_[True, np.diff(group[order]) > 0])  # no group is empty, as `reduceat` needs
    together = csr_matrix((np.ones(len(group), np.float32), (group, np.arange(len(group)))), (len(start), len(group)))
    union = (together @ holders).tocsr()
    union.data[:] = 1  # the product counts a mask once for each node that has it
    return np.bitwise_or.reduceat(views[order], start, axis=0), union


def packed_flags(flags: Array) -> Array:
    """Pack (n, F) bool into (n, words) uint64."""
    width = -(-flags.shape[1] // 64) * 64
    padded = np.zeros((len(flags), width), bool)
    padded[:, : flags.shape[1]] = flags
    return np.packbits(padded, axis=1).view(np.uint64)


def _blocks(count: int) -> Iterator[slice]:
    return (slice(start, min(start + BLOCK_MASKS, count)) for start in range(0, count, BLOCK_MASKS))
