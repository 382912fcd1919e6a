"""From clusters of masks to objects on faces (docs/method/objects.md#from-clusters-to-faces, Eq. O.13 to O.17)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from iif_core.numerics.graph import component_labels
from iif_core.objects.mask_clustering import agreeing_pairs, packed_flags
from iif_core.surface.cells import neighbour_pairs, unpack_keys

Array = np.ndarray

PIECE_VIEWS = 3.0
"""Weight of the vote of a whole piece of the mesh, in views of one of its faces (Eq. O.14)."""

JOIN_VIEWS = 3
JOIN_SHARE = 0.8
"""Objects are joined if at least JOIN_VIEWS views see both, and the share JOIN_SHARE of them in one mask (Eq. O.17)."""

TIE_VIEWS = 1e-6
"""Tolerance, in views, within which two sums of shares count as equal."""


@dataclass(frozen=True)
class Votes:
    """Votes of the views for faces; n rows, one per (view, face, voxel of a cluster).

    Attributes:
        face: (n,) int64; key: (n,) uint64 voxel and cluster (`iif_core.surface.cells.pack_keys`).
        pixels: (n,) int64; share: (n,) float64 share of the view's pixels on that face.
        outside: (F,) float64, shares of pixels in no mask, summed over the views.
    """

    face: Array
    key: Array
    pixels: Array
    share: Array
    outside: Array


def view_votes(face: Array, key: Array, clustered: Array, masked: Array, count: int) -> Votes:
    """Collect the votes of one view from its pixels that hit the mesh.

    Args:
        face: (n,) face of every pixel.
        key: (n,) uint64 voxel and cluster, where `clustered`.
        clustered: (n,) bool, whether the cluster of the pixel is known.
        masked: (n,) bool, whether the pixel lies in a mask; without a cluster it does not vote.
        count: number of faces.

    Returns:
        Votes of the view.
    """
    seen = np.bincount(face, minlength=count)  # pixels of each face in this view
    keys, which = np.unique(key[clustered], return_inverse=True)
    width = max(len(keys), 1)
    # One number for a pair of face and key, so that one sort counts the pixels of all pairs.
    pair, pixels = np.unique(face[clustered].astype(np.int64) * width + which, return_counts=True)
    rows, at = pair // width, pair % width
    outside = np.bincount(face[~masked], minlength=count) / np.maximum(seen, 1)
    return Votes(rows, keys[at] if len(keys) else np.zeros(0, np.uint64), pixels, pixels / seen[rows], outside)


def merge_votes(votes: list[Votes]) -> Votes:
    """Merge the votes of all views."""
    columns = {name: np.concatenate([getattr(v, name) for v in votes]) for name in ("face", "key", "pixels", "share")}
    return Votes(**columns, outside=np.sum([v.outside for v in votes], axis=0))


def split_apart(keys: Array) -> tuple[Array, Array]:
    """Number the connected parts of clusters: part of every voxel (n,) int32, and the cluster of every part.

    `keys` (n,) uint64 are sorted and distinct; voxels of one cluster are connected if they touch.
    """
    part = component_labels(len(keys), *neighbour_pairs(keys).T)
    cluster = np.zeros(part.max(initial=-1) + 1, np.int64)
    cluster[part] = unpack_keys(keys)[1]  # all voxels of a part agree
    return part, cluster


def elect_labels(face: Array, label: Array, weight: Array, share: Array, piece: Array, piece_views: float = PIECE_VIEWS) -> Array:
    """Choose the label of every face (Eq. O.14).

        score(face, l) = W(face, l) + piece_views W(piece, l) / N(piece)

    W sums `weight` over the votes for l, and N sums `share` over all votes in the piece of the mesh. Faces that few
    photographs show therefore follow their piece. Candidates are the labels of the face's votes and the best label of its
    piece; ties go to the lowest label.

    Args:
        face, label, weight, share: (n,) columns of the votes; labels from 0.
        piece: (F,) int from 0, piece of the mesh of every face.
        piece_views: weight of the vote of a piece.

    Returns:
        (F,) int64 labels; -1 for a face without a vote.
    """
    out = np.full(len(piece), -1, np.int64)
    if not len(face):
        return out
    # -------- votes of the pieces: W(piece, l), the favourite of each piece, N(piece) --------
    span, pieces = int(label.max()) + 1, int(piece.max()) + 1
    of_piece = piece[face].astype(np.int64)
    pair, row = np.unique(of_piece * span + label, return_inverse=True)
    total = np.bincount(row, weight, len(pair))
    order = np.lexsort((pair % span, -total, pair // span))  # by piece, heaviest first, then lowest label
    held, first = np.unique(pair[order] // span, return_index=True)
    favourite = np.zeros(pieces, np.int64)
    favourite[held] = pair[order][first] % span
    views = np.bincount(of_piece, share, pieces)  # N(piece), in views of a face

    # -------- candidates of the faces that have a vote: their own labels, and the favourite with weight 0 --------
    voted = np.unique(face).astype(np.int64)
    code = np.concatenate([face.astype(np.int64) * span + label, voted * span + favourite[piece[voted]]])
    candidate, row = np.unique(code, return_inverse=True)
    score = np.bincount(row, np.concatenate([weight, np.zeros(len(voted))]), len(candidate))
    face_of, label_of = candidate // span, candidate % span
    of_piece = piece[face_of].astype(np.int64)
    # Every candidate has a vote in its piece, so the search finds its exact pair and N is not 0.
    score += piece_views * total[np.searchsorted(pair, of_piece * span + label_of)] / views[of_piece]
    order = np.lexsort((label_of, -score, face_of))
    first = np.unique(face_of[order], return_index=True)[1]
    out[face_of[order][first]] = label_of[order][first]
    return out


def label_faces(votes: Votes, cluster_size: Array, cluster_masks: Array, piece: Array) -> tuple[Array, Array, Array]:
    """Choose the part of every face (Eq. O.13 to O.15).

    A vote weighs 1 / sqrt(size of its cluster), so that a small thing is not lost when it shares a mask with a large one in
    some views. Clusters of one mask count only on faces without a vote for another cluster.

    Args:
        votes: of all views.
        cluster_size: (C,) mean number of points of the masks of a cluster.
        cluster_masks: (C,) number of masks of a cluster.
        piece: (F,) int, pieces of the mesh.

    Returns:
        Part of every face (F,) int64, -1 = none; faces that lie mostly outside masks, (F,) bool; and for every part the share
        of the pixels on its faces that voted for it.
    """
    # -------- which votes count: clusters of one mask only where no other cluster votes --------
    keys, which = np.unique(votes.key, return_inverse=True)
    part_of_key, cluster = split_apart(keys)
    part = part_of_key[which]
    lone = cluster_masks[cluster[part]] < 2
    firm = np.zeros(len(piece), bool)
    firm[votes.face[~lone]] = True
    counted = ~lone | ~firm[votes.face]
    inside = np.bincount(votes.face[counted], votes.share[counted], len(piece))
    # -------- bare faces (Eq. O.15) lose their votes; the others are weighted and elected (Eq. O.13, O.14) --------
    bare = votes.outside > inside
    counted &= ~bare[votes.face]
    face, part, share = votes.face[counted], part[counted], votes.share[counted]
    weight = share / np.sqrt(np.maximum(cluster_size[cluster[part]], 1.0))
    label = elect_labels(face, part, weight, share, piece)
    # -------- agreement: pixels for the part over pixels on its faces --------
    pixels = votes.pixels[counted]
    mine = label[face] == part
    agreeing = np.bincount(part[mine], pixels[mine], len(cluster))
    cast = np.bincount(label[face], pixels, len(cluster)) if len(face) else np.zeros(len(cluster))
    return label, bare, agreeing / np.maximum(cast, 1)


@dataclass(frozen=True)
class Sightings:
    """Masks in which the views show fragments of objects; n rows, one per (view, fragment, mask).

    Attributes:
        view, fragment, mask: (n,) int64; masks are numbered from 1 in every view.
        pixels: (n,) float64 > 0.
    """

    view: Array
    fragment: Array
    mask: Array
    pixels: Array


def sightings(views: Iterable[tuple[Array, Array]]) -> Sightings:
    """Collect the fragment and the mask of the pixels of every view, both (p,) int; only pixels that lie in a mask."""
    columns = []
    for view, (fragment, mask) in enumerate(views):
        span = int(mask.max(initial=0)) + 1
        code, pixels = np.unique(fragment.astype(np.int64) * span + mask, return_counts=True)
        columns.append((np.full(len(code), view, np.int64), code // span, code % span, pixels.astype(np.float64)))
    return Sightings(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def part_objects(home: Array, seen: Sightings) -> Array:
    """Separate fragments that the views do not show in one mask with the rest of their object (Eq. O.16).

    A fragment is what an object has of one piece of the mesh. Every object grows from its fragment with the most pixels. Of
    the n views that see a fragment and something of the object so far, t_f is the share of the fragment's pixels in the mask
    of view f that holds most of the object. The fragment joins if

        1 + sum t_f > (1 + n) / 2,

    a majority in which its election into the object counts as one view; a tie parts. When none joins, fragments that no view
    shows with the object do. The remaining fragments become one new object, which grows in the same way.

    `home` (n,) is the object of every fragment; returns (n,) int64.
    """
    home = np.array(home, np.int64)
    # waits: fragments that are in no grown object yet; size: pixels of each fragment over all views.
    waits, size = np.ones(len(home), bool), np.bincount(seen.fragment, seen.pixels, len(home))
    span = int(seen.view.max(initial=0)) + 1
    _, pair = np.unique(seen.fragment * span + seen.view, return_inverse=True)
    # (n,) share of a fragment's pixels in one view that lie in the mask of the row.
    share = seen.pixels / np.bincount(pair, seen.pixels)[pair]
    waits[_largest(home, size, waits)] = False
    while waits.any():
        together, views = _support(home, waits, seen, share)
        joins = waits & (views > 0) & (1 + together > 0.5 * (1 + views) + TIE_VIEWS)
        if not joins.any():
            # No view says anything about these, so the election stands.
            joins = waits & (views == 0)
        waits &= ~joins
        if not joins.any():
            home[waits] = int(home.max()) + 1 + np.unique(home[waits], return_inverse=True)[1]
            waits[_largest(home, size, waits)] = False
    return home


def _largest(home: Array, size: Array, waits: Array) -> Array:
    """Of every object with waiting fragments, the waiting fragment with the most pixels; of equals the first."""
    rows = np.flatnonzero(waits)
    rows = rows[np.lexsort((rows, -size[rows], home[rows]))]
    return rows[np.unique(home[rows], return_index=True)[1]]


def _support(home: Array, waits: Array, seen: Sightings, share: Array) -> tuple[Array, Array]:
    """For every waiting fragment: sum of t_f, and the number of views that see it with its object; 0 for other fragments."""
    # Objects that still wait for fragments; others need no more work.
    growing = np.zeros(int(home.max()) + 1, bool)
    growing[home[waits]] = True
    rows = np.flatnonzero(growing[home[seen.fragment]])
    views = int(seen.view.max(initial=0)) + 1
    place = home[seen.fragment[rows]] * views + seen.view[rows]
    waiting = waits[seen.fragment[rows]]

    # -------- the mask that holds most of each growing object in each view --------
    there = rows[~waiting]
    at, chosen, _ = _main_masks(place[~waiting], seen.mask[there], seen.pixels[there])
    rows, place = rows[waiting], place[waiting]
    # -------- waiting fragments in views that see their object too --------
    both = np.isin(place, at)
    rows, place = rows[both], place[both]
    inside = seen.mask[rows] == chosen[np.searchsorted(at, place)]
    fragment = seen.fragment[rows]
    # Shares of a fragment in one view add up to 1, so the second sum counts views.
    return np.bincount(fragment, share[rows] * inside, len(home)), np.bincount(fragment, share[rows], len(home))


def _main_masks(place: Array, mask: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Places in ascending order, the mask that holds most pixels of each (of equals the lowest), and its share of the pixels."""
    masks = int(mask.max(initial=0)) + 1
    held, which = np.unique(place * masks + mask, return_inverse=True)
    count = np.bincount(which, pixels, len(held))
    order = np.lexsort((held, -count, held // masks))
    at, first = np.unique(held[order] // masks, return_index=True)
    total = np.bincount(np.searchsorted(at, held // masks), count, len(at))
    return at, held[order][first] % masks, count[order][first] / total


def join_objects(home: Array, seen: Sightings) -> Array:
    """Join objects that the views show in one mask (Eq. O.17); the lowest number stays.

    A view sees an object in the mask that holds more than half of its pixels. Two objects become one if at least JOIN_VIEWS
    views see both, and JOIN_SHARE of these views in the same mask. This is repeated until nothing changes.

    `home` (n,) is the object of every fragment; returns (n,) int64.
    """
    from scipy.sparse import csr_matrix

    home = np.array(home, np.int64)
    views, masks = int(seen.view.max(initial=0)) + 1, int(seen.mask.max(initial=0)) + 1
    while True:
        objects, at = np.unique(home, return_inverse=True)
        # A share above 1/2 leaves no second mask; an object that a view cuts up evenly is not seen by it.
        place, mask, share = _main_masks(at[seen.fragment] * views + seen.view, seen.mask, seen.pixels)
        node, view, mask = place[share > 0.5] // views, place[share > 0.5] % views, mask[share > 0.5]
        # Masks are numbered over all views, so two objects share a supporter only within one view.
        holders = csr_matrix((np.ones(len(node), np.float32), (node, view * masks + mask)), (len(objects), views * masks))
        by = np.zeros((len(objects), views), bool)
        by[node, view] = True
        first, second, supporters, observers = agreeing_pairs(holders, packed_flags(by))
        one = (observers >= JOIN_VIEWS) & (supporters >= JOIN_SHARE * observers - TIE_VIEWS)
        if not one.any():
            return home
        group = component_labels(len(objects), first[one], second[one])
        lowest = np.full(int(group.max()) + 1, int(home.max()))
        np.minimum.at(lowest, group, objects)
        home = lowest[group[at]]
