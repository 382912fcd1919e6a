"""Clusters of masks -> objects on faces: parts that lie apart are told apart, then the pixels of every face vote."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .cells import neighbour_pairs, unpack_keys

Array = np.ndarray

PIECE_VIEWS = 3.0
"""What a piece of the mesh is worth as a whole, in views of one of its faces."""


@dataclass(frozen=True)
class Votes:
    """What photographs say about faces; n rows, one a (view, face, voxel of a cluster).

    face: (n,) int64; key: (n,) uint64 voxel and cluster (`iif_core.cells.pack_keys`); pixels: (n,) int64; share: (n,) float64
    of the view's pixels on that face. outside: (F,) float64 shares of pixels in no mask, summed over the views.
    """

    face: Array
    key: Array
    pixels: Array
    share: Array
    outside: Array


def view_votes(face: Array, key: Array, clustered: Array, masked: Array, count: int) -> Votes:
    """Votes of one view. All arguments (n,), a row a pixel that hits the mesh; `count` faces.

    key: voxel and cluster where `clustered`; masked: lies in a mask (whose cluster may be unknown: it does not vote).
    """
    seen = np.bincount(face, minlength=count)
    keys, which = np.unique(key[clustered], return_inverse=True)
    width = max(len(keys), 1)
    pair, pixels = np.unique(face[clustered].astype(np.int64) * width + which, return_counts=True)
    rows, at = pair // width, pair % width
    outside = np.bincount(face[~masked], minlength=count) / np.maximum(seen, 1)
    return Votes(rows, keys[at] if len(keys) else np.zeros(0, np.uint64), pixels, pixels / seen[rows], outside)


def joined(votes: list[Votes]) -> Votes:
    """All views together."""
    columns = {name: np.concatenate([getattr(v, name) for v in votes]) for name in ("face", "key", "pixels", "share")}
    return Votes(**columns, outside=np.sum([v.outside for v in votes], axis=0))


def split_apart(keys: Array) -> tuple[Array, Array]:
    """Part of every voxel, (n,) int32: voxels of one cluster that touch; and the cluster of every part.

    `keys`: (n,) uint64 sorted and distinct.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = neighbour_pairs(keys)
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (len(keys), len(keys)))
    count, part = connected_components(graph, directed=False)
    cluster = np.zeros(count, np.int64)
    cluster[part] = unpack_keys(keys)[1]
    return part, cluster


def elect(face: Array, label: Array, weight: Array, share: Array, piece: Array, piece_views: float = PIECE_VIEWS) -> Array:
    """Label of every face, (F,) int64, -1 where nothing is known.

        score(face, l) = W(face, l) + piece_views W(piece, l) / N(piece)

    W sums `weight` over the votes for l, N sums `share` over all votes in the face's piece of the mesh: faces that few
    photographs show follow their piece, others their own votes. Candidates are the labels of the face's votes and the first
    of its piece; ties go to the lowest label.

    Args:
        face, label, weight, share: (n,), a row a vote; labels from 0.
        piece: (F,) int from 0.
    """
    out = np.full(len(piece), -1, np.int64)
    if not len(face):
        return out
    span, pieces = int(label.max()) + 1, int(piece.max()) + 1
    of_piece = piece[face].astype(np.int64)
    pair, row = np.unique(of_piece * span + label, return_inverse=True)
    total = np.bincount(row, weight, len(pair))
    order = np.lexsort((pair % span, -total, pair // span))
    held, first = np.unique(pair[order] // span, return_index=True)
    favourite = np.zeros(pieces, np.int64)
    favourite[held] = pair[order][first] % span
    views = np.bincount(of_piece, share, pieces)

    voted = np.unique(face).astype(np.int64)
    code = np.concatenate([face.astype(np.int64) * span + label, voted * span + favourite[piece[voted]]])
    candidate, row = np.unique(code, return_inverse=True)
    score = np.bincount(row, np.concatenate([weight, np.zeros(len(voted))]), len(candidate))
    face_of, label_of = candidate // span, candidate % span
    of_piece = piece[face_of].astype(np.int64)
    score += piece_views * total[np.searchsorted(pair, of_piece * span + label_of)] / views[of_piece]
    order = np.lexsort((label_of, -score, face_of))
    first = np.unique(face_of[order], return_index=True)[1]
    out[face_of[order][first]] = label_of[order][first]
    return out


def label_faces(votes: Votes, cluster_size: Array, cluster_masks: Array, piece: Array) -> tuple[Array, Array, Array]:
    """Part of every face (F,) int64 (-1 = none), faces that lie mostly outside masks (F,) bool, and (P,) how far pixels agree.

    A vote weighs 1 / sqrt(size of its cluster): a small thing in front of a large one is lost whenever the two share a mask,
    the large one never. Clusters of one mask count only where no other does.

    Args:
        votes: of all views.
        cluster_size: (C,) points of a mask of the cluster, mean; cluster_masks: (C,) number of its masks.
        piece: (F,) pieces of the mesh.
    """
    keys, which = np.unique(votes.key, return_inverse=True)
    part_of_key, cluster = split_apart(keys)
    part = part_of_key[which]
    lone = cluster_masks[cluster[part]] < 2
    firm = np.zeros(len(piece), bool)
    firm[votes.face[~lone]] = True
    counted = ~lone | ~firm[votes.face]
    inside = np.bincount(votes.face[counted], votes.share[counted], len(piece))
    bare = votes.outside > inside
    counted &= ~bare[votes.face]
    face, part, share = votes.face[counted], part[counted], votes.share[counted]
    weight = share / np.sqrt(np.maximum(cluster_size[cluster[part]], 1.0))
    label = elect(face, part, weight, share, piece)
    pixels = votes.pixels[counted]
    mine = label[face] == part
    agreeing = np.bincount(part[mine], pixels[mine], len(cluster))
    cast = np.bincount(label[face], pixels, len(cluster)) if len(face) else np.zeros(len(cluster))
    return label, bare, agreeing / np.maximum(cast, 1)
