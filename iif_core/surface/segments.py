"""Objects on faces, and segments in views: one object in one view, numbered view by view (docs/method/objects.md, Eq. O.1).

Ids are int32, -1 = none.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.numerics.graph import component_labels

WELD_ULPS = 4.0
"""Vertices closer than so many spacings of single precision at the largest coordinate are one vertex."""


@dataclass(frozen=True)
class SegmentTable:
    """The segments of all views in the order of their ids; all columns int32 (S,)."""

    segment_id: NDArray
    view: NDArray
    object: NDArray
    pixels: NDArray

    def __len__(self) -> int:
        return len(self.segment_id)


def view_segments(object_map: NDArray, first_segment: int = 0) -> tuple[NDArray, NDArray, NDArray]:
    """Number the segments of one view (Eq. O.1) from `first_segment` on; negative objects of the (H, W) map = none.

    Returns segment ids (H, W) int32 with -1 = none, and object and number of pixels of each segment, (s,) int32.

    Example:
        >>> view_segments(np.array([[7, -1], [3, 7]]))[0].tolist()
        [[1, -1], [0, 1]]
    """
    object_map = _integer_map(object_map, "object map")
    seen = object_map >= 0
    objects, rank, pixels = np.unique(object_map[seen], return_inverse=True, return_counts=True)
    segment_map = np.full(object_map.shape, -1, np.int32)
    segment_map[seen] = first_segment + rank
    return segment_map, objects.astype(np.int32), pixels.astype(np.int32)


def segment_table(object_maps: Iterable[NDArray]) -> tuple[list[NDArray], SegmentTable]:
    """Number the segments of all views, (H, W) maps with negative = none; `view` in the table is the position in the sequence."""
    maps, views, objects, pixels, first = [], [], [], [], 0
    for view, object_map in enumerate(object_maps):
        segment_map, ids, counts = view_segments(object_map, first)
        maps.append(segment_map)
        views.append(np.full(len(ids), view, np.int32))
        objects.append(ids)
        pixels.append(counts)
        first += len(ids)

    columns = (np.concatenate([np.zeros(0, np.int32), *parts]) for parts in (views, objects, pixels))
    return maps, SegmentTable(np.arange(first, dtype=np.int32), *columns)


def interior(object_map: NDArray, border: int) -> NDArray:
    """Find pixels whose (2 border + 1)^2 neighbourhood has one object id (Eq. O.2): bool (H, W).

    The edge of the picture is no border. Pixels without an object (-1) are never interior; border = 0 keeps every pixel that
    has an object.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    object_map = _integer_map(object_map, "object map")
    if border < 0:
        raise InputError(f"border is {border} pixels; it must be 0 or more")
    if border == 0 or object_map.size == 0:
        return object_map >= 0
    # Minimum and maximum agree where there is one id. Repeating the edge adds no other id, so it is no border (Eq. O.2).
    size = 2 * border + 1
    same = minimum_filter(object_map, size, mode="nearest") == maximum_filter(object_map, size, mode="nearest")
    return same & (object_map >= 0)


def face_adjacency(faces: NDArray, vertices: NDArray | None = None) -> NDArray:
    """Find pairs of faces that share an edge: (M, 2) int32, lower face first, sorted; n > 2 faces at an edge give a chain of
    pairs.

    If vertices are given, those at one position to rounding count as one, so that seams do not separate faces
    (docs/method/numerics.md#vertices-that-almost-coincide).
    """
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(f"faces have shape {faces.shape}; they must be (F, 3) vertex indices")
    if len(faces) == 0:
        return np.zeros((0, 2), np.int32)
    if vertices is not None:
        faces = _welded(np.asarray(vertices), faces)
    # Sorted by edge, faces that share one stand next to each other.
    key = _edge_keys(faces)
    owner = np.tile(np.arange(len(faces), dtype=np.int32), 3)
    order = np.argsort(key, kind="stable")
    key, owner = key[order], owner[order]
    shared = np.flatnonzero(key[1:] == key[:-1])
    pairs = np.stack([owner[shared], owner[shared + 1]], 1)
    pairs.sort(axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]  # a degenerate face shares an edge with itself
    code = np.unique(pairs[:, 0].astype(np.int64) * len(faces) + pairs[:, 1])
    return np.stack([code // len(faces), code % len(faces)], 1).astype(np.int32)


def _edge_keys(faces: NDArray) -> NDArray:
    """A number for each edge, (3 F,) int64: first the edges v0v1 of all faces, then v1v2 and v2v0."""
    corners = faces.astype(np.int64)
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    return edges.min(1) * (corners.max() + 1) + edges.max(1)


def _welded(vertices: NDArray, faces: NDArray) -> NDArray:
    """Faces (F, 3) int64 whose vertices at one position are one: equal positions first, and then those of edges with a single
    face that lie within `WELD_ULPS` spacings of the coordinates, which is few of a mesh that is joined already."""
    from scipy.spatial import cKDTree

    # -------- equal positions: each vertex takes the number of the first one there --------
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    new = np.r_[True, (ordered[1:] != ordered[:-1]).any(1)]
    number = np.empty(len(vertices), np.int64)
    number[order] = order[np.flatnonzero(new)][np.cumsum(new) - 1]
    faces = number[faces]
    # -------- open edges, and their vertices that almost coincide --------
    _, first, count = np.unique(_edge_keys(faces), return_index=True, return_counts=True)
    # `_edge_keys` lists the edges v0v1 of all faces first, then v1v2, then v2v0.
    face, side = first[count == 1] % len(faces), first[count == 1] // len(faces)
    loose = np.unique(np.concatenate([faces[face, side], faces[face, (side + 1) % 3]]))
    if not len(loose):
        return faces
    reach = WELD_ULPS * float(np.finfo(np.float32).eps) * float(np.abs(vertices[loose]).max())
    # Components of these pairs: vertices further apart than `reach` become one through others between them.
    pairs = cKDTree(vertices[loose]).query_pairs(reach, output_type="ndarray")
    _, lowest, part = np.unique(component_labels(len(loose), *pairs.T), return_index=True, return_inverse=True)
    number = np.arange(len(vertices))
    number[loose] = loose[lowest[part]]
    return number[faces]


@dataclass(frozen=True)
class FaceVotes:
    """Result of `vote_faces`.

    Attributes:
        object_of_face: (F,) int32.
        votes: (F,) int32 pixels that saw the face; 0 = the label came from a neighbour or is the background.
        object_id: (O,) int32 ascending, every id that occurs on a face.
        pixels, agreement: (O,) votes cast on the faces of the object, and the share of them for it; 0 without votes.
        background: id of the faces that no label reached; None if there are none.
    """

    object_of_face: NDArray
    votes: NDArray
    object_id: NDArray
    pixels: NDArray
    agreement: NDArray
    background: int | None


def vote_faces(
    face_id: NDArray,
    instance_id: NDArray,
    n_faces: int,
    faces_adjacency: NDArray | None = None,
) -> FaceVotes:
    """Label every face by the majority of the pixels that see it (Eq. O.3).

    Pixels with a negative id cast no vote, and ties go to the lowest instance id. A face without votes takes the label of the
    nearest labelled face, counted in steps across shared edges; at equal distance the lowest label.

    Args:
        face_id, instance_id: integer arrays of one shape, the pixels of all views; negative = miss or not labelled.
        n_faces: number of faces, F.
        faces_adjacency: (M, 2) of `face_adjacency`.

    Returns:
        Labels of the faces, and how far the votes agree.

    Raises:
        InputError: shapes that differ, or a face id that the mesh does not have.
    """
    face, instance = np.ravel(face_id), np.ravel(instance_id)
    if face.shape != instance.shape:
        raise InputError(f"{face.size} face ids and {instance.size} instance ids; one of each per pixel is needed")
    voting = (face >= 0) & (instance >= 0)
    face, instance = face[voting].astype(np.int64), instance[voting].astype(np.int64)
    if face.size and face.max() >= n_faces:
        raise InputError(f"face id {face.max()} in a map, but the mesh has {n_faces} faces; map and mesh differ")

    # -------- the winner of each face --------
    span = int(instance.max()) + 1 if instance.size else 1
    pair, count = np.unique(face * span + instance, return_counts=True)
    pair_face, pair_instance = pair // span, pair % span
    order = np.lexsort((pair_instance, -count, pair_face))  # by face, most votes first, then lowest id
    winner = order[np.unique(pair_face[order], return_index=True)[1]]
    label = np.full(n_faces, -1, np.int64)
    label[pair_face[winner]] = pair_instance[winner]
    votes = np.bincount(face, minlength=n_faces)

    # -------- faces without a vote --------
    if faces_adjacency is not None and len(faces_adjacency):
        label = _spread(label, np.asarray(faces_adjacency))
    unreached = label < 0
    background = span if instance.size else 0
    label[unreached] = background

    # -------- agreement: votes for the label of the face over all votes on the object's faces --------
    object_id = np.unique(label)
    column = np.searchsorted(object_id, label)
    pixels = np.bincount(column, votes, len(object_id))
    agreeing = (
        np.bincount(np.searchsorted(object_id, label[pair_face]), count * (label[pair_face] == pair_instance), len(object_id))
        if pair.size
        else np.zeros(len(object_id))
    )
    return FaceVotes(
        label.astype(np.int32),
        votes.astype(np.int32),
        object_id.astype(np.int32),
        pixels.astype(np.int64),
        (agreeing / np.maximum(pixels, 1)).astype(np.float32),
        background if unreached.any() else None,
    )


def fill_within(label: NDArray, piece: NDArray, closed: NDArray, adjacency: NDArray) -> NDArray:
    """Label the remaining faces by the pieces of the mesh.

    A face without a label takes the label of the nearest labelled face across shared edges. The search neither leaves the piece
    nor enters a closed face. The faces that remain become one new object per piece, numbered after the others.

    Args:
        label: (F,) int; -1 = no label.
        piece: (F,) int, piece of the mesh of every face.
        closed: (F,) bool, faces that neither receive nor pass on labels.
        adjacency: (M, 2) of `face_adjacency`.

    Returns:
        (F,) int32 labels >= 0.
    """
    label, piece, closed = np.asarray(label, np.int64), np.asarray(piece, np.int64), np.asarray(closed, bool)
    pairs = np.asarray(adjacency).reshape(-1, 2)
    a, b = pairs.T
    label = _spread(label, pairs[(piece[a] == piece[b]) & ~closed[a] & ~closed[b]])
    rest = label < 0
    if rest.any():
        label[rest] = label.max(initial=-1) + 1 + np.unique(piece[rest], return_inverse=True)[1]
    return label.astype(np.int32)


def partition_agreement(a: NDArray, b: NDArray, weight: NDArray) -> tuple[float, NDArray]:
    """Compare two partitions, labels (n,) from 0, by the weighted adjusted Rand index (Eq. O.20): 1 = equal, about 0 = by chance.

    Also returns the best overlap over union of every label of `a` with a label of `b` (Eq. O.21); NaN for labels without weight.

    Raises:
        InputError: shapes that differ, or no weight at all.
    """
    from scipy.sparse import coo_matrix

    a, b, weight = np.ravel(a), np.ravel(b), np.ravel(weight).astype(np.float64)
    if not (a.shape == b.shape == weight.shape):
        raise InputError(f"partitions of {a.size} and {b.size} elements with {weight.size} weights; all must be as many")
    total = weight.sum()
    if not total > 0:
        raise InputError("partitions without weight cannot be compared")
    table = coo_matrix((weight, (a, b))).tocsr()  # sums entries at the same position
    table = table.tocoo()
    of_a, of_b = np.bincount(a, weight), np.bincount(b, weight)  # a_i and b_j
    p, q = (of_a**2).sum(), (of_b**2).sum()
    chance = p * q / total**2
    most = 0.5 * (p + q) - chance
    # If both partitions have a single part, the quotient is 0 / 0; they are equal, hence 1.
    index = ((table.data**2).sum() - chance) / most if most > 1e-12 * total**2 else 1.0
    best = np.where(of_a > 0, 0.0, np.nan)
    union = of_a[table.row] + of_b[table.col] - table.data
    found = table.data > 0
    np.maximum.at(best, table.row[found], table.data[found] / union[found])
    return float(index), best


def _spread(label: NDArray, adjacency: NDArray) -> NDArray:
    """Grow labels over the face graph ring by ring; a face that several labels reach in one ring takes the lowest."""
    n = len(label)
    # -------- neighbours of face f: ends[start[f] : start[f + 1], 1] --------
    ends = np.concatenate([adjacency, adjacency[:, ::-1]]).astype(np.int64)
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    start = np.searchsorted(ends[:, 0], np.arange(n + 1))
    label = label.copy()
    ring = np.flatnonzero(label >= 0)
    unset = np.iinfo(np.int64).max
    while ring.size:
        # -------- all neighbours of the ring at once, without a loop over its faces --------
        degree = start[ring + 1] - start[ring]
        offset = np.arange(degree.sum()) - np.repeat(np.cumsum(degree) - degree, degree)
        neighbour = ends[np.repeat(start[ring], degree) + offset, 1]
        source = np.repeat(label[ring], degree)
        fresh = label[neighbour] < 0  # labels of earlier rings stay
        neighbour, source = neighbour[fresh], source[fresh]
        ring, column = np.unique(neighbour, return_inverse=True)
        lowest = np.full(len(ring), unset)
        np.minimum.at(lowest, column, source)
        label[ring] = lowest
    return label


def _integer_map(values: NDArray, name: str) -> NDArray:
    values = np.asarray(values)
    if values.ndim != 2 or values.dtype.kind not in "iu":
        raise InputError(
            f"{name} has shape {values.shape} and type {values.dtype}; it must be (H, W) of integers with -1 for none"
        )
    return values.astype(np.int32, copy=False)
