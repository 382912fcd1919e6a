"""Faces that may shine by themselves (docs/method/light.md#emitter-candidates).

The test accepts too many on purpose, because the solve that follows recognises surfaces that merely reflect (`pruning`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.numerics.graph import component_labels

LOW_QUANTILE = 0.25
"""Share of the pixels of a face that may be dark although it shines: blur, compression and wrong poses put the surroundings of a
small lamp into some of its pixels."""
SMALL_AREA = 0.25
"""Surface (m^2) of a lamp that may be one group whatever its shape."""
_BRIDGE = 3  # faces by which pools reach over unseen surface


@dataclass(frozen=True)
class FaceStatistics:
    """What the photographs say about every face.

    Attributes:
        count: (F,) int32 observations.
        low: (F,) float32, lower quantile over the observations of the largest channel; 0 where unobserved.
        bounded: (F,) bool, saturation hides that quantile: `low` is the highest radiance that was reached.
        mean: (F, 3) float32 mean of the observations that are not saturated, of the bounds where all are; 0 where
            unobserved.
        clear: (F,) int32 observations that are not saturated in any channel.
        front: (F,) float32 in [0, 1]: share of the observations from the side of the face normal.
    """

    count: np.ndarray
    low: np.ndarray
    bounded: np.ndarray
    mean: np.ndarray
    clear: np.ndarray
    front: np.ndarray


def face_statistics(
    face: np.ndarray,
    value: np.ndarray,
    from_front: np.ndarray,
    n_faces: int,
    bound: np.ndarray | None = None,
    quantile: float = LOW_QUANTILE,
) -> FaceStatistics:
    """Summarise the pixels that see each face.

    A saturated pixel gives a lower bound only. The lower quantile is therefore Kaplan and Meier's (1958) estimate from
    right-censored data (Eq. L.2): bounds below a value do not count against it. Without saturation it is the observation of
    rank floor(quantile * count).

    Args:
        face: (n,) int, -1 = no face.
        value: (n, 3) radiance; rows with non-finite values are left out.
        from_front: (n,) bool, the camera is on the side of the face normal.
        n_faces: F.
        bound: (n, 3) bool, `value` is a lower bound; None = nowhere.
        quantile: lower quantile; the minimum below 1 / quantile pixels.

    Returns:
        Statistics of F faces.
    """
    value = np.asarray(value)
    good = (face >= 0) & np.isfinite(value).all(-1)
    bounded = np.zeros(len(face), bool) if bound is None else np.asarray(bound).any(-1)
    face, value, from_front, bounded = face[good], value[good], from_front[good], bounded[good]
    count = np.bincount(face, minlength=n_faces)
    clear = np.bincount(face[~bounded], minlength=n_faces)
    brightest = value.max(-1) if len(value) else np.zeros(0)
    low, hidden = _censored_quantile(face, brightest, bounded, count, quantile)
    # Bounds enter the mean only where a face has nothing else.
    used = np.where(bounded & (clear[face] > 0), 0.0, 1.0)
    divisor = np.maximum(np.where(clear > 0, clear, count), 1)
    mean = np.stack([np.bincount(face, value[:, c] * used, n_faces) / divisor for c in range(3)], -1)
    front = np.bincount(face, from_front.astype(np.float64), n_faces) / np.maximum(count, 1)
    counts = (count.astype(np.int32), clear.astype(np.int32))
    return FaceStatistics(counts[0], low, hidden, mean.astype(np.float32), counts[1], front.astype(np.float32))


def _censored_quantile(
    face: np.ndarray, value: np.ndarray, bounded: np.ndarray, count: np.ndarray, quantile: float
) -> tuple[np.ndarray, np.ndarray]:
    """Kaplan-Meier quantile per face, and whether it lies beyond the last value; it is the largest value then."""
    low, hidden = np.zeros(len(count), np.float32), np.zeros(len(count), bool)
    order = np.lexsort((bounded, value, face))  # of equal values, bounds come last
    owner, ordered, known = face[order], value[order], ~bounded[order]
    first = np.cumsum(count) - count
    # N - i + 1 of Eq. L.2: pixels of the face that are at least as bright.
    at_risk = count[owner] - (np.arange(len(owner)) - first[owner])
    # The last observation of a face, if it is not a bound, ends the curve: log 0.
    with np.errstate(divide="ignore"):
        step = np.where(known, np.log1p(-1.0 / np.maximum(at_risk, 1)), 0.0)
    last = at_risk == 1
    finite = np.where(last & known, 0.0, step)
    # log S as one running sum over the faces in turn, from which the sum over earlier faces is taken off.
    total = np.cumsum(finite)
    before = np.where(first[owner] > 0, total[np.maximum(first[owner] - 1, 0)], 0.0)
    survival = np.where(last & known, 0.0, np.exp(total - before))
    # The margin keeps rounding of the sums from deciding at the quantile itself.
    reached = known & (survival < 1.0 - quantile - 1e-9)
    hit = np.flatnonzero(reached)
    faces, index = np.unique(owner[hit], return_index=True)
    low[faces] = ordered[hit[index]]
    seen = count > 0
    hidden[seen] = True
    hidden[faces] = False
    # Saturation hides the quantile; the largest value stands for it.
    beyond = np.flatnonzero(hidden)
    low[beyond] = ordered[first[beyond] + count[beyond] - 1] if len(beyond) else 0
    return low, hidden


def with_thin_objects(
    interior: FaceStatistics,
    every: FaceStatistics,
    object_id: np.ndarray,
    face: np.ndarray,
    bright: np.ndarray,
    inside: np.ndarray,
    min_observations: int,
) -> FaceStatistics:
    """Take the statistics of interior pixels, and those of all pixels for objects too thin to have interior ones.

    Pixels at the border of an object mix it with its surroundings. An object without interior pixels (a filament) is judged by
    all of its pixels if nine tenths of them are bright, which excludes the frame of a window.

    Args:
        interior, every: statistics of the interior pixels, and of all.
        object_id: (F,) of the faces, -1 = none.
        face, bright, inside: (n,) of all pixels: face; reaches the threshold or is saturated; interior.
        min_observations: interior pixels from which an object is not thin.

    Returns:
        Statistics of F faces.
    """
    owner, size = object_id[face] + 1, int(object_id.max(initial=-1)) + 2  # entry 0 is for faces without an object
    share = np.bincount(owner, bright, size) / np.maximum(np.bincount(owner, minlength=size), 1)
    thin = np.bincount(owner, inside, size) < min_observations
    allow = (thin & (share >= 0.9))[object_id + 1] & (object_id >= 0)

    def pick(name: str) -> np.ndarray:
        whole, inner = getattr(every, name), getattr(interior, name)
        return np.where(allow.reshape(-1, *[1] * (whole.ndim - 1)), whole, inner)

    return FaceStatistics(**{name: pick(name) for name in FaceStatistics.__dataclass_fields__})


CANDIDATE_RATIO = 5.0
"""Radiance of a candidate relative to the median of the room."""


def radiance_threshold(statistics: FaceStatistics, ratio: float = CANDIDATE_RATIO) -> float:
    """Find the radiance above which a face may be an emitter: `ratio` times the median over pixels (Eq. L.3).

    The median is of the low quantile of the face that each pixel sees, so highlights do not count and emitters may fill up to
    half of the pixels. Infinite when nothing was seen.
    """
    seen = statistics.count > 0
    if not seen.any():
        return float("inf")
    low, weight = statistics.low[seen], statistics.count[seen]
    # Median over pixels: each face counts as often as it was seen.
    order = np.argsort(low, kind="stable")
    cumulative = np.cumsum(weight[order])
    median = float(low[order][np.searchsorted(cumulative, 0.5 * cumulative[-1])])
    positive = low[low > 0]
    floor = float(positive.min()) if len(positive) else 0.0
    return ratio * max(median, floor) if max(median, floor) > 0 else float("inf")


GLOW_RATIO = 4.0
"""Radiance of a piece that glows as a whole relative to the median of the room, both of means over faces."""
LARGEST_CHANGE = 0.7
"""Standard deviation over views of the logarithm of what a piece shows, above which it is a mirror rather than a lamp."""


def glowing_pieces(
    statistics: FaceStatistics,
    adjacency: np.ndarray,
    object_id: np.ndarray,
    pixels: tuple[np.ndarray, np.ndarray, np.ndarray],
    min_observations: int = 8,
) -> np.ndarray:
    """Find connected surface of one object that is much brighter than the room as a whole (Eq. L.4), in all views alike.

    Curtains, blinds and shades with light behind them transmit it unevenly, so that few of their faces are bright all over.
    Each pixel stands for the mean radiance of the face that it sees. A piece counts when the median over its pixels is at least
    `GLOW_RATIO` times the median over all pixels. What a mirror shows depends on where the camera stands.

    Args:
        statistics: of F faces; adjacency: (E, 2) pairs of neighbouring faces; object_id: (F,), -1 = none.
        pixels: face, view and largest channel of each pixel, (n,) each; face -1 = none.
        min_observations: pixels that must have seen a piece.

    Returns:
        (F,) int32 number of the piece, -1 on all other surface.
    """
    same = object_id[adjacency[:, 0]] == object_id[adjacency[:, 1]]
    piece = component_labels(len(object_id), *adjacency[same].T)
    brightness, count = statistics.mean.max(-1), statistics.count.astype(np.float64)
    size = int(piece.max(initial=-1)) + 1
    if not count.any():
        return np.full(len(object_id), -1, np.int32)
    # Median over pixels: each face counts as often as it was seen.
    order = np.argsort(brightness, kind="stable")
    middle = brightness[order][np.searchsorted(np.cumsum(count[order]), 0.5 * count.sum())]
    threshold = GLOW_RATIO * middle if middle > 0 else np.inf
    seen = np.bincount(piece, count, size)
    bright = np.bincount(piece, np.where(brightness >= threshold, count, 0.0), size)
    # The median over the pixels of a piece reaches the threshold if half of them do.
    glows = (seen >= min_observations) & (bright >= 0.5 * seen)
    if glows.any():
        glows &= _change_over_views(piece, size, *pixels) <= LARGEST_CHANGE
    return np.where(glows[piece] & (object_id >= 0), piece, -1).astype(np.int32)


def _change_over_views(piece: np.ndarray, size: int, face: np.ndarray, view: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return how much the logarithm of the mean of each piece varies over views: standard deviation by pixels, (size,)."""
    good = (face >= 0) & np.isfinite(value)
    views = int(view.max(initial=0)) + 1
    # One mean for each piece in each view that shows it.
    key = piece[face[good]].astype(np.int64) * views + view[good]
    kinds, at = np.unique(key, return_inverse=True)
    count = np.bincount(at, minlength=len(kinds)).astype(np.float64)
    log_mean = np.log(np.maximum(np.bincount(at, value[good], len(kinds)) / count, 1e-30))
    owner = kinds // views
    total = np.maximum(np.bincount(owner, count, size), 1e-30)
    mean = np.bincount(owner, count * log_mean, size) / total
    return np.sqrt(np.bincount(owner, count * (log_mean - mean[owner]) ** 2, size) / total)


LARGEST_STEP = 1.5
"""Ratio of the radiances of neighbouring faces below which surface goes on without an edge."""
LARGEST_TURN = 30.0
"""Degrees between the normals of such faces; the mesh of a scan bulges."""
_HALF_CIRCLE = float(np.sqrt(np.pi))  # half of the perimeter of a circle of area 1
_EQUILATERAL = 2.0 / 3.0**0.25  # edge of an equilateral triangle of area 1


def fading_surface(
    candidate: np.ndarray,
    statistics: FaceStatistics,
    adjacency: np.ndarray,
    normals: np.ndarray,
    areas: np.ndarray,
    glowing: np.ndarray | None = None,
) -> np.ndarray:
    """Find candidates that fade into the surface around them, as light on a ceiling does and no lamp
    (docs/method/light.md#emitter-candidates).

    Only unsaturated radiance tells: next to a lamp that saturates all photographs, surface is as bright as its bounds.

    Args:
        candidate: (F,) bool; statistics: of F faces; adjacency: (E, 2) pairs of neighbouring faces.
        normals, areas: (F, 3) unit vectors, and (F,) m^2.
        glowing: (F,) from `glowing_pieces`, each of which fades as a whole or not at all; None = none.

    Returns:
        (F,) bool, a part of `candidate`.
    """
    n, (a, b) = len(candidate), adjacency.T
    brightness = statistics.mean.max(-1).astype(np.float64)
    told = (statistics.count > 0) & ~statistics.bounded & (2 * statistics.clear >= statistics.count) & (brightness > 0)
    # -------- edges of the mesh across which surface goes on, and so does its radiance --------
    flat = (normals[a] * normals[b]).sum(1) > np.cos(np.radians(LARGEST_TURN))
    step = np.maximum(brightness[a], brightness[b]) < LARGEST_STEP * np.minimum(brightness[a], brightness[b])
    smooth = told[a] & told[b] & flat & step
    # -------- patches of candidates that such edges join; a piece that glows is one patch --------
    inner = smooth & candidate[a] & candidate[b]
    whole = np.flatnonzero(glowing >= 0) if glowing is not None else np.zeros(0, np.int64)
    piece = np.unique(glowing[whole], return_inverse=True)[1] if glowing is not None else whole
    size = n + int(piece.max(initial=-1)) + 1
    patch = component_labels(size, np.r_[a[inner], whole], np.r_[b[inner], n + piece])[:n]
    # -------- of their border, what leads on to other surface: half of it is enough --------
    border = smooth & (candidate[a] != candidate[b])
    owner = np.where(candidate[a], patch[a], patch[b])[border]
    length = np.bincount(owner, _EQUILATERAL * np.sqrt(np.minimum(areas[a], areas[b]))[border], size)
    area = np.bincount(patch[candidate], areas[candidate], size)
    return candidate & ((length > 0) & (length >= _HALF_CIRCLE * np.sqrt(area)))[patch]


def emitter_candidates(
    statistics: FaceStatistics,
    adjacency: np.ndarray,
    areas: np.ndarray,
    threshold: float,
    min_observations: int = 8,
    glowing: np.ndarray | None = None,
) -> np.ndarray:
    """Find the faces that may shine by themselves.

    A face counts when its low quantile reaches `threshold` or is hidden by saturation. Neighbours that count, also across a few
    unseen faces, are pooled, and the pool must have been seen by `min_observations` pixels: finely tessellated lamps. Unseen
    surface joins when 90 % of its border are candidates, up to four times their area or `SMALL_AREA`: gaps, and the far side
    of a lamp.

    Args:
        statistics: of F faces.
        adjacency: (E, 2) pairs of neighbouring faces.
        areas: (F,) m^2.
        threshold: radiance, see `radiance_threshold`.
        min_observations: pixels that must have seen a pool.
        glowing: (F,) from `glowing_pieces`, whose faces all count; None = none.

    Returns:
        (F,) bool.
    """
    # -------- bright faces --------
    solid, unseen = areas > 1e-12, statistics.count == 0
    bright = ~unseen & ((statistics.low >= threshold) | statistics.bounded) & solid
    if glowing is not None:
        bright |= (glowing >= 0) & solid
    if not bright.any():
        return bright

    # -------- pools, which reach across a few rings of unseen faces --------
    # Rings grow over unseen faces only: dark surface that was seen stops them.
    first, second = adjacency[:, 0], adjacency[:, 1]
    reached = bright.copy()
    for _ in range(_BRIDGE):
        grown = reached.copy()
        grown[first[reached[second]]] = True
        grown[second[reached[first]]] = True
        reached = bright | (grown & unseen)
    label = components(adjacency, reached)

    # -------- pools that were seen often enough, and what they enclose --------
    pooled = np.bincount(label, np.where(bright, statistics.count, 0))
    candidate = bright & (pooled[label] >= min_observations)
    return candidate | (_enclosed(adjacency, areas, unseen, candidate, label) & solid)


def components(adjacency: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Label of the connected component of every face; faces outside `mask` are alone."""
    inside = mask[adjacency[:, 0]] & mask[adjacency[:, 1]]
    return component_labels(len(mask), *adjacency[inside].T)


def _enclosed(
    adjacency: np.ndarray, areas: np.ndarray, unseen: np.ndarray, candidate: np.ndarray, pool: np.ndarray
) -> np.ndarray:
    """Unseen faces in regions that border almost only on candidates and are not much larger than their pools."""
    region = components(adjacency, unseen)
    size = int(region.max(initial=-1)) + 1
    # Border edges of unseen regions, from the unseen face to the seen one.
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
