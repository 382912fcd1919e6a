"""The pixels of a fit, sorted for the compiled loops, and the objective with its Gauss-Newton system."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting import kernels
from iif_core.fitting.problem import FitOptions, FitProblem
from iif_core.fitting.tone import Tone, make_tone
from iif_core.reflectance.material import NUMBERS

RANGE_WEIGHT = 0.05
"""Weight of the squared distance to the allowed range (Eq. M.11)."""
_DEFAULT_CLUSTERS = 64
"""Clusters of an object if the problem names none."""
_CLUSTERS_AT_ONCE = 1000
"""Clusters whose systems are held in memory at once."""
_OF_EACH_PIXEL = ("index", "obj", "base", "diffuse", "lobes", "target", "exposure", "saturated", "trust")


@dataclass(kw_only=True)
class Pixels:
    """Usable pixels, sorted by (object, cluster); n pixels, C clusters.

    Attributes:
        index: (n,) place in the problem.
        usable: (O,) usable pixels of each object, including those left out because of the limit on their number.
        others: see `kernels.PixelArrays`.
    """

    index: np.ndarray
    obj: np.ndarray
    base: np.ndarray
    diffuse: np.ndarray
    lobes: np.ndarray
    levels: np.ndarray
    target: np.ndarray
    exposure: np.ndarray
    saturated: np.ndarray
    trust: np.ndarray
    starts: np.ndarray
    first: np.ndarray
    usable: np.ndarray

    @property
    def n_objects(self) -> int:
        return len(self.first) - 1

    @property
    def offsets(self) -> np.ndarray:
        """First pixel of each object, (O + 1,)."""
        return self.starts[self.first]

    @property
    def counts(self) -> np.ndarray:
        return np.diff(self.offsets)

    @property
    def arrays(self) -> kernels.PixelArrays:
        """The pixels as the compiled loops take them."""
        return kernels.PixelArrays(*(getattr(self, name) for name in kernels.PixelArrays._fields))

    def take(self, index: np.ndarray | slice) -> Pixels:
        """Return a subset; `index` increases. Every cluster stays, possibly empty."""
        begin, end = (index.start, index.stop) if isinstance(index, slice) else (0, 0)
        # The new first pixel of a cluster is the number of chosen pixels before its old one.
        starts = np.clip(self.starts, begin, end) - begin if end else np.searchsorted(index, self.starts)
        return replace(self, starts=starts, **{name: getattr(self, name)[index] for name in _OF_EACH_PIXEL})

    def only(self, objects: np.ndarray) -> Pixels:
        """Return the pixels of some objects (increasing), which are numbered anew."""
        counts = np.diff(self.first)[objects]
        # Only clusters of these objects remain, and their pixels follow one another again: sizes give the new starts.
        clusters = np.concatenate([np.arange(self.first[o], self.first[o + 1]) for o in objects] or [np.zeros(0, np.int64)])
        sizes = np.diff(self.starts)[clusters]
        number = np.full(self.n_objects, -1)
        number[objects] = np.arange(len(objects))
        index = np.flatnonzero(number[self.obj] >= 0)
        run = len(index) and index[-1] - index[0] == len(index) - 1
        part = self.take(slice(index[0], index[-1] + 1) if run else index)  # consecutive pixels need no copy
        return replace(
            part,
            obj=number[part.obj],
            starts=np.r_[0, np.cumsum(sizes)].astype(np.int64),
            first=np.r_[0, np.cumsum(counts)].astype(np.int64),
            usable=self.usable[objects],
        )

    def unsaturated(self) -> np.ndarray:
        """Return the number of pixels of each object that are unsaturated in some channel, (O,)."""
        return np.bincount(self.obj, (~self.saturated).any(1), self.n_objects)

    def sum_by_object(self, values: np.ndarray) -> np.ndarray:
        """Return the sum of values (n,) over the pixels of each object, (O,)."""
        return np.bincount(self.obj, values, self.n_objects)


@dataclass
class Terms:
    """Objective of each object, and its Gauss-Newton system if wanted; P response parameters.

    Attributes:
        cost: (O,); data: (O,) the data term alone; size: (O,) sum of the moduli of its terms.
        h: (O, 16 + P, 16 + P); g: (O, 16 + P); scores: (C, 16 + P) gradient of each cluster, if wanted. Rows of numbers that the
            system is not wanted for hold the distance to the allowed range alone.
    """

    cost: np.ndarray
    data: np.ndarray
    size: np.ndarray
    h: np.ndarray
    g: np.ndarray
    scores: np.ndarray

    def update(self, other: Terms, objects: np.ndarray) -> None:
        """Copy objective and system of some objects from `other`; the gradients of clusters stay."""
        for name in ("cost", "data", "size", "h", "g"):
            getattr(self, name)[objects] = getattr(other, name)[objects]


def _finite(problem: FitProblem) -> np.ndarray:
    """Which pixels are finite, exposed, and of an object, (n,) bool."""
    ids = np.asarray(problem.object_id)
    use = np.isfinite(problem.base).all(1) & np.isfinite(problem.value).all(1)
    use &= np.isfinite(problem.exposure) & (problem.exposure > 0) & (ids >= 0) & (ids < problem.n_objects)
    for d, s0, s1 in zip(problem.diffuse, problem.s0, problem.s1, strict=True):
        use &= np.isfinite(d).all(1) & np.isfinite(s0).all((1, 2)) & np.isfinite(s1).all((1, 2))
    return use


def _brightness(problem: FitProblem) -> np.ndarray:
    with np.errstate(invalid="ignore", over="ignore"):
        return np.mean([d.sum(1, dtype=np.float64) for d in problem.diffuse], 0) * problem.exposure


def prepare_pixels(
    problem: FitProblem,
    response: Response,
    fewest: int = 0,
    most: int | None = None,
    of_all: tuple[float, Tone] | None = None,
) -> tuple[Pixels, Tone]:
    """Select and sort the usable pixels: finite, lit, and of an object.

    Pixels that receive almost no light are left out (docs/method/numerics.md#pixels-without-light).

    Args:
        problem: pixels with base values and cached shading; response: start of the fit.
        fewest: objects with fewer usable pixels are left out; most: largest number of pixels of an object, spread evenly over its
            clusters; None: all.
        of_all: light below which pixels are left out, and curve, where these pixels are a part of more; None: those
            of these pixels.

    Returns:
        The pixels, and the curve that residuals are measured in.
    """
    # -------- which pixels --------
    ids, use = np.asarray(problem.object_id), _finite(problem)
    brightness = _brightness(problem)
    if use.any():
        use &= brightness > (1e-3 * np.median(brightness[use]) if of_all is None else of_all[0])
    # Objects are counted before the limit `most`: the count is what decides whether an object is fitted.
    usable = np.bincount(ids[use], minlength=problem.n_objects)
    use &= (usable >= fewest)[np.where(use, ids, 0)] if len(usable) else False

    # -------- their order: by object, then by cluster --------
    index = np.flatnonzero(use)
    cluster = problem.cluster[index] if problem.cluster is not None else _equal_runs(ids[index])
    order = np.lexsort((cluster, ids[index]))
    index, cluster = index[order], cluster[order]
    if most is not None:
        first = np.searchsorted(ids[index], np.arange(problem.n_objects + 1))
        some = choose_evenly(ids[index].astype(np.int64), first, most)
        index, cluster = index[some], cluster[some]
    obj = ids[index].astype(np.int64)
    # A cluster begins where object or cluster changes. `starts` has its pixels, `first` the clusters of each object.
    fresh = np.flatnonzero(np.r_[True, (np.diff(obj) != 0) | (np.diff(cluster) != 0)]) if len(index) else np.zeros(0, np.int64)
    starts = np.r_[fresh, len(index)].astype(np.int64)
    first = np.searchsorted(obj[fresh], np.arange(problem.n_objects + 1)).astype(np.int64)

    # -------- the arrays of the compiled loops --------
    tone = make_tone(response, problem.value[index]) if of_all is None else of_all[1]
    kind = np.result_type(*(np.asarray(a).dtype for a in (problem.value, problem.diffuse[0], problem.s0[0], problem.s1[0])))
    # float32 if all of the cache is: half the memory of by far the largest arrays.
    kind = np.float32 if kind == np.float32 else np.float64
    levels = np.ascontiguousarray(problem.levels, np.float64)
    diffuse = np.empty((len(index), len(problem.diffuse), 3), kind)
    lobes = np.empty((len(index), len(levels), 2, len(problem.diffuse), 2, 3), kind)
    for half, (d, *pair) in enumerate(zip(problem.diffuse, problem.s0, problem.s1, strict=True)):
        diffuse[:, half] = d[index]
        for at, lobe in enumerate(pair):
            # Values and slopes lie together, because the interpolation reads both at two neighbouring levels.
            lobes[:, :, 0, half, at] = own = np.ascontiguousarray(lobe[index], kind)
            kernels.slopes(own, levels, lobes[:, :, 1, half, at])
    lobes = lobes.reshape(*lobes.shape[:3], 6 * len(problem.diffuse))
    pixels = Pixels(
        index=index,
        obj=obj,
        base=np.ascontiguousarray(problem.base[index], kind),
        diffuse=diffuse,
        lobes=lobes,
        levels=levels,
        target=np.ascontiguousarray(tone.value(problem.value[index]), kind),
        exposure=np.ascontiguousarray(problem.exposure[index], np.float64),
        saturated=np.ascontiguousarray(problem.saturated[index]),
        trust=np.ones((len(index), 3), kind),
        starts=starts,
        first=first,
        usable=usable,
    )
    return pixels, tone


def choose_evenly(obj: np.ndarray, offsets: np.ndarray, most: int) -> np.ndarray:
    """Return the places of at most `most` pixels of each object, in equal strides: obj (n,) sorted, offsets (O + 1,) first pixel
    of each object."""
    # The pixels of an object are sorted by cluster, so equal strides spread them evenly over its clusters.
    place, stride = np.arange(len(obj)) - offsets[obj], np.maximum(1, -(-np.diff(offsets) // most))
    return np.flatnonzero(place % stride[obj] == 0)


def _equal_runs(ids: np.ndarray) -> np.ndarray:
    """Number up to `_DEFAULT_CLUSTERS` equal runs of the pixels of each object, in their given order."""
    order = np.argsort(ids, kind="stable")
    ordered = ids[order]
    begin = np.flatnonzero(np.r_[True, np.diff(ordered) != 0]) if len(ids) else np.zeros(0, np.int64)
    count = np.diff(np.r_[begin, len(ids)])
    place = np.arange(len(ids)) - np.repeat(begin, count)
    out = np.empty(len(ids), np.int64)
    out[order] = place * _DEFAULT_CLUSTERS // np.repeat(np.maximum(count, _DEFAULT_CLUSTERS), count)
    return out


def evaluate(
    px: Pixels,
    affine: np.ndarray,
    tone: Tone,
    opt: FitOptions,
    system: bool,
    free: np.ndarray | None = None,
    objects: np.ndarray | None = None,
    scores: bool = False,
) -> Terms:
    """Evaluate the objective without the priors (Eq. M.7, M.11).

    Args:
        px: pixels; affine: (O, 16) numbers of the objects; tone: curve with the current response; opt: loss and limits.
        system: also sum the Gauss-Newton system (Eq. M.8); scores: and the gradient of each cluster.
        free: (O, 16) bool, the numbers that the system is wanted for; None: all.
        objects: indices of the objects to evaluate, increasing; the others have zeros; None: all.

    Returns:
        Sums in float64; they do not depend on `opt.threads`.
    """
    return _run(px, affine, tone, opt, (2 if scores else 1) if system else 0, free, objects)[0]


def evaluate_clusters(
    px: Pixels, affine: np.ndarray, tone: Tone, opt: FitOptions
) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Evaluate gradient and Gauss-Newton system of every cluster by itself, some objects at a time.

    Args:
        px: pixels; affine: (O, 16) numbers of the objects; tone: curve with the current response; opt: loss and limits.

    Yields:
        A slice of the clusters, their gradients (c, 16 + P) and their systems (c, 16 + P, 16 + P).
    """
    low = 0
    while low < px.n_objects:
        # As many objects as have at most that many clusters together, and at least one.
        high = max(low + 1, int(np.searchsorted(px.first, px.first[low] + _CLUSTERS_AT_ONCE, side="right")) - 1)
        some = px.only(np.arange(low, high))
        count = len(some.starts) - 1
        # Every cluster poses as an object with one cluster, so that `evaluate` returns a system for it.
        each = np.repeat(np.arange(count), np.diff(some.starts))
        own = np.repeat(affine[low:high], np.diff(some.first), 0)
        terms = evaluate(replace(some, obj=each, first=np.arange(count + 1)), own, tone, opt, True)
        yield slice(px.first[low], px.first[high]), terms.g, terms.h
        low = high


def residuals(px: Pixels, affine: np.ndarray, tone: Tone, opt: FitOptions) -> np.ndarray:
    """Return the residuals f(e L) - I (Eq. M.6).

    Args:
        px: pixels; affine: (O, 16); tone: curve with the current response; opt: limits.

    Returns:
        (n, halves, 3) float64 in units of the curve; 0 where a saturated value is exceeded.
    """
    return _run(px, affine, tone, opt, 3, None, None)[1]


def _run(
    px: Pixels,
    affine: np.ndarray,
    tone: Tone,
    opt: FitOptions,
    want: int,
    free: np.ndarray | None,
    objects: np.ndarray | None,
) -> tuple[Terms, np.ndarray]:
    n_objects, width, halves = px.n_objects, NUMBERS + tone.size, px.diffuse.shape[1]
    # Arrays that are not wanted stay empty; the compiled loop does not touch them.
    system = n_objects if want in (1, 2) else 0
    terms = Terms(
        *(np.zeros(n_objects) for _ in range(3)),
        np.zeros((system, width, width)),
        np.zeros((system, width)),
        np.zeros((len(px.starts) - 1 if want == 2 else 0, width)),
    )
    errors = np.zeros((len(px.obj) if want == 3 else 0, halves, 3))
    affine = np.ascontiguousarray(affine, np.float64)
    free = np.ones((n_objects, NUMBERS), bool) if free is None else np.ascontiguousarray(free)
    out = kernels.Sums(terms.cost, terms.data, terms.size, terms.h, terms.g, terms.scores, errors)
    penalties = penalties_of(opt)

    def work(part: np.ndarray) -> None:
        kernels.sums(px.arrays, tone.tables, penalties, affine, free, part, want, out)

    run_in_threads(work, px, np.arange(n_objects) if objects is None else objects, opt.threads)
    return terms, errors


def penalties_of(opt: FitOptions) -> kernels.Penalties:
    """Loss and limits of the objective as the compiled loops take them."""
    return kernels.Penalties(opt.robust_width, opt.brightest, RANGE_WEIGHT, opt.roughness_weight, opt.metallic_weight)


def run_in_threads(work: Callable[[np.ndarray], None], px: Pixels, objects: np.ndarray, threads: int) -> None:
    """Call a function on consecutive parts of the objects, in threads.

    Args:
        work: called with each part; px: pixels, by whose number the parts are made equal.
        objects: increasing indices; threads: number of parts.
    """
    done = np.cumsum(px.counts[objects])
    if threads < 2 or len(objects) < 2:
        work(objects)
        return
    # Parts of about equal numbers of pixels: an object belongs to the part that holds its middle pixel. It is never split, so its
    # sums have one order whatever the number of threads.
    cuts = np.searchsorted(done - px.counts[objects] / 2, np.linspace(0, done[-1], threads + 1)[1:-1])
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, np.split(objects, cuts)))
