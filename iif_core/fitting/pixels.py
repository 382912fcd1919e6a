"""The pixels of a fit, sorted for the compiled loops, and the objective with its Gauss-Newton system."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting import kernels
from iif_core.fitting.problem import PARAMETERS, FitOptions, FitProblem
from iif_core.fitting.tone import Tone, make_tone

BOX = 0.05  # weight of the squared distance to the allowed range
_RUNS = 64  # clusters of an object when the caller names none


@dataclass
class Pixels:
    """Sorted by (object, cluster); n pixels, C clusters.

    Attributes:
        index: (n,) place in the problem; obj: (n,); base: (n, 5); diffuse: (n, halves, 3); lobes: (n, J, 2, halves x 2 x 3) value
            and slope in r of s0 and s1 at the levels; levels: (J,); target: (n, 3) in units of the tone; exposure: (n,);
            saturated: (n, 3); trust: (n, 3) weights;
        starts: (C + 1,) first pixel of each cluster; first: (O + 1,) first cluster of each object; usable: (O,) pixels of each
            object, also those that were left out for their number.
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
        """(O + 1,) first pixel of each object."""
        return self.starts[self.first]

    @property
    def counts(self) -> np.ndarray:
        return np.diff(self.offsets)

    def take(self, index: np.ndarray | slice) -> Pixels:
        """A subset; `index` increasing. Every cluster stays, perhaps empty."""
        begin, end = (index.start, index.stop) if isinstance(index, slice) else (0, 0)
        starts = np.clip(self.starts, begin, end) - begin if end else np.searchsorted(index, self.starts)
        return replace(
            self,
            index=self.index[index],
            obj=self.obj[index],
            base=self.base[index],
            diffuse=self.diffuse[index],
            lobes=self.lobes[index],
            target=self.target[index],
            exposure=self.exposure[index],
            saturated=self.saturated[index],
            trust=self.trust[index],
            starts=starts,
        )

    def only(self, objects: np.ndarray) -> Pixels:
        """The pixels of some objects (increasing), which are numbered anew."""
        counts = np.diff(self.first)[objects]
        clusters = np.concatenate([np.arange(self.first[o], self.first[o + 1]) for o in objects] or [np.zeros(0, np.int64)])
        sizes = np.diff(self.starts)[clusters]
        number = np.full(self.n_objects, -1)
        number[objects] = np.arange(len(objects))
        index = np.flatnonzero(number[self.obj] >= 0)
        run = len(index) and index[-1] - index[0] == len(index) - 1
        part = self.take(slice(index[0], index[-1] + 1) if run else index)  # without a copy where they come in a row
        return replace(
            part,
            obj=number[part.obj],
            starts=np.r_[0, np.cumsum(sizes)].astype(np.int64),
            first=np.r_[0, np.cumsum(counts)].astype(np.int64),
            usable=self.usable[objects],
        )

    def sum_by_object(self, values: np.ndarray) -> np.ndarray:
        return np.bincount(self.obj, values, self.n_objects)


@dataclass
class Terms:
    """Objective per object, and its Gauss-Newton system when asked for; P response parameters.

    Attributes:
        cost: (O,); data: (O,) the data term alone; size: (O,) sum of the moduli of its terms.
        h: (O, 16 + P, 16 + P); g: (O, 16 + P); scores: (C, 16 + P) gradient of each cluster, when asked for. What belongs to
            numbers that the system is not wanted for is 0, but for the distance to the allowed range.
    """

    cost: np.ndarray
    data: np.ndarray
    size: np.ndarray
    h: np.ndarray
    g: np.ndarray
    scores: np.ndarray

    def put(self, other: Terms, objects: np.ndarray) -> None:
        """Take over the objective and system of some objects; gradients of clusters are not."""
        for name in ("cost", "data", "size", "h", "g"):
            getattr(self, name)[objects] = getattr(other, name)[objects]


def prepare(problem: FitProblem, response: Response, fewest: int = 0, most: int | None = None) -> tuple[Pixels, Tone]:
    """Usable pixels: finite, lit, and of an object; of objects with at least `fewest`; at most `most` of each, evenly spread over
    its clusters. Pixels that get next to no light have all leverage and no information (METHOD H59)."""
    ids = np.asarray(problem.object_id)
    use = np.isfinite(problem.base).all(1) & np.isfinite(problem.value).all(1)
    use &= np.isfinite(problem.exposure) & (problem.exposure > 1e-6) & (ids >= 0) & (ids < problem.n_objects)
    for d, s0, s1 in zip(problem.diffuse, problem.s0, problem.s1, strict=True):
        use &= np.isfinite(d).all(1) & np.isfinite(s0).all((1, 2)) & np.isfinite(s1).all((1, 2))
    with np.errstate(invalid="ignore", over="ignore"):
        brightness = np.mean([d.sum(1, dtype=np.float64) for d in problem.diffuse], 0) * problem.exposure
    if use.any():
        use &= brightness > 1e-3 * np.median(brightness[use])
    usable = np.bincount(ids[use], minlength=problem.n_objects)
    use &= (usable >= fewest)[np.where(use, ids, 0)] if len(usable) else False
    index = np.flatnonzero(use)
    cluster = problem.cluster[index] if problem.cluster is not None else _runs(ids[index])
    order = np.lexsort((cluster, ids[index]))
    index, cluster = index[order], cluster[order]
    if most is not None:
        first = np.searchsorted(ids[index], np.arange(problem.n_objects + 1))
        some = evenly(ids[index].astype(np.int64), first, most)
        index, cluster = index[some], cluster[some]
    obj = ids[index].astype(np.int64)
    fresh = np.flatnonzero(np.r_[True, (np.diff(obj) != 0) | (np.diff(cluster) != 0)]) if len(index) else np.zeros(0, np.int64)
    starts = np.r_[fresh, len(index)].astype(np.int64)
    first = np.searchsorted(obj[fresh], np.arange(problem.n_objects + 1)).astype(np.int64)
    tone = make_tone(response, problem.value[index])
    kind = np.result_type(*(np.asarray(a).dtype for a in (problem.value, problem.diffuse[0], problem.s0[0], problem.s1[0])))
    kind = np.float32 if kind == np.float32 else np.float64
    levels = np.ascontiguousarray(problem.levels, np.float64)
    diffuse = np.empty((len(index), len(problem.diffuse), 3), kind)
    lobes = np.empty((len(index), len(levels), 2, len(problem.diffuse), 2, 3), kind)
    for half, (d, *pair) in enumerate(zip(problem.diffuse, problem.s0, problem.s1, strict=True)):
        diffuse[:, half] = d[index]
        for at, lobe in enumerate(pair):
            lobes[:, :, 0, half, at] = own = np.ascontiguousarray(lobe[index], kind)
            kernels.slopes(own, levels, lobes[:, :, 1, half, at])
    lobes = lobes.reshape(*lobes.shape[:3], 6 * len(problem.diffuse))
    pixels = Pixels(
        index,
        obj,
        np.ascontiguousarray(problem.base[index], kind),
        diffuse,
        lobes,
        levels,
        np.ascontiguousarray(tone.value(problem.value[index]), kind),
        np.ascontiguousarray(problem.exposure[index], np.float64),
        np.ascontiguousarray(problem.saturated[index]),
        np.ones((len(index), 3), kind),
        starts,
        first,
        usable,
    )
    return pixels, tone


def evenly(obj: np.ndarray, offsets: np.ndarray, most: int) -> np.ndarray:
    """Places of at most so many of the pixels of each object, in equal strides: obj (n,) sorted, offsets (O + 1,) first pixel of
    each."""
    place, stride = np.arange(len(obj)) - offsets[obj], np.maximum(1, -(-np.diff(offsets) // most))
    return np.flatnonzero(place % stride[obj] == 0)


def _runs(ids: np.ndarray) -> np.ndarray:
    """Up to `_RUNS` equal runs of each object's pixels, in the order in which they come."""
    order = np.argsort(ids, kind="stable")
    ordered = ids[order]
    begin = np.flatnonzero(np.r_[True, np.diff(ordered) != 0]) if len(ids) else np.zeros(0, np.int64)
    count = np.diff(np.r_[begin, len(ids)])
    place = np.arange(len(ids)) - np.repeat(begin, count)
    out = np.empty(len(ids), np.int64)
    out[order] = place * _RUNS // np.repeat(np.maximum(count, _RUNS), count)
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
    """Objective at `affine` (O, 16).

    Args:
        system: with its Gauss-Newton system; free: (O, 16) bool, the numbers that it is wanted for (None: all); objects: the only
            ones that are looked at (None: all), the others have zeros; scores: with the gradients of the clusters.
    """
    return _run(px, affine, tone, opt, (2 if scores else 1) if system else 0, free, objects)[0]


def residuals(px: Pixels, affine: np.ndarray, tone: Tone, opt: FitOptions) -> np.ndarray:
    """f(e L) - I of each half, (n, halves, 3) float64; 0 where a bound is met."""
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
    n_objects, width, halves = px.n_objects, PARAMETERS + tone.size, px.diffuse.shape[1]
    system = n_objects if want in (1, 2) else 0
    terms = Terms(
        *(np.zeros(n_objects) for _ in range(3)),
        np.zeros((system, width, width)),
        np.zeros((system, width)),
        np.zeros((len(px.starts) - 1 if want == 2 else 0, width)),
    )
    errors = np.zeros((len(px.obj) if want == 3 else 0, halves, 3))
    affine = np.ascontiguousarray(affine, np.float64)
    free = np.ones((n_objects, PARAMETERS), bool) if free is None else np.ascontiguousarray(free)
    curve, ends, by_params = tone.tables

    def work(part: np.ndarray) -> None:
        kernels.sums(
            px.base,
            px.diffuse,
            px.lobes,
            px.levels,
            px.target,
            px.exposure,
            px.saturated,
            px.trust,
            px.starts,
            px.first,
            affine,
            free,
            tone.knee,
            tone.gain,
            curve,
            ends,
            by_params,
            tone.per_channel,
            opt.robust_width,
            opt.roughness_weight,
            opt.metallic_weight,
            opt.brightest,
            BOX,
            part,
            want,
            terms.cost,
            terms.data,
            terms.size,
            terms.h,
            terms.g,
            terms.scores,
            errors,
        )

    in_threads(work, px, np.arange(n_objects) if objects is None else objects, opt.threads)
    return terms, errors


def in_threads(work: Callable[[np.ndarray], None], px: Pixels, objects: np.ndarray, threads: int) -> None:
    """`work` on runs of `objects` (increasing) with about as many pixels each."""
    done = np.cumsum(px.counts[objects])
    if threads < 2 or len(objects) < 2:
        work(objects)
        return
    cuts = np.searchsorted(done, np.linspace(0, done[-1], threads + 1)[1:-1])
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, np.split(objects, cuts)))
