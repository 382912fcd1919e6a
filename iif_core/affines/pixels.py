"""The pixels of a fit, sorted for the compiled loops, and the objective with its Gauss-Newton system."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from iif_core.affines import kernels
from iif_core.affines.problem import PARAMETERS, FitOptions, FitProblem
from iif_core.affines.tone import Tone, make_tone
from iif_core.response import Response

BOX = 0.05  # weight of the squared distance to the allowed range
_RUNS = 64  # clusters of an object when the caller names none


@dataclass
class Pixels:
    """Sorted by (object, cluster); n pixels, C clusters.

    Attributes:
        index: (n,) place in the problem; obj: (n,); base: (n, 5); shading: (n, halves, 1 + 2 J, 3) diffuse, s0, s1;
        levels: (J,); target: (n, 3) in units of the tone; exposure: (n,); saturated: (n, 3); trust: (n, 3) weights;
        starts: (C + 1,) first pixel of each cluster; first: (O + 1,) first cluster of each object.
    """

    index: np.ndarray
    obj: np.ndarray
    base: np.ndarray
    shading: np.ndarray
    levels: np.ndarray
    target: np.ndarray
    exposure: np.ndarray
    saturated: np.ndarray
    trust: np.ndarray
    starts: np.ndarray
    first: np.ndarray

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

    def take(self, index: np.ndarray) -> Pixels:
        """A subset; `index` increasing. Every cluster stays, perhaps empty."""
        return replace(
            self,
            index=self.index[index],
            obj=self.obj[index],
            base=self.base[index],
            shading=self.shading[index],
            target=self.target[index],
            exposure=self.exposure[index],
            saturated=self.saturated[index],
            trust=self.trust[index],
            starts=np.searchsorted(index, self.starts),
        )

    def only(self, objects: np.ndarray) -> Pixels:
        """The pixels of some objects (increasing), which are numbered anew."""
        counts = np.diff(self.first)[objects]
        clusters = np.concatenate([np.arange(self.first[o], self.first[o + 1]) for o in objects] or [np.zeros(0, np.int64)])
        sizes = np.diff(self.starts)[clusters]
        number = np.full(self.n_objects, -1)
        number[objects] = np.arange(len(objects))
        index = np.flatnonzero(number[self.obj] >= 0)
        part = self.take(index)
        return replace(
            part,
            obj=number[part.obj],
            starts=np.r_[0, np.cumsum(sizes)].astype(np.int64),
            first=np.r_[0, np.cumsum(counts)].astype(np.int64),
        )

    def sum_by_object(self, values: np.ndarray) -> np.ndarray:
        return np.bincount(self.obj, values, self.n_objects)


@dataclass
class Terms:
    """Objective per object, and its Gauss-Newton system when asked for; P response parameters.

    Attributes:
        cost: (O,); data: (O,) the data term alone; size: (O,) sum of the moduli of its terms.
        h: (O, 16 + P, 16 + P); scores: (C, 16 + P) gradient of each cluster; shown: (n, halves, 3) e L.
    """

    cost: np.ndarray
    data: np.ndarray
    size: np.ndarray
    h: np.ndarray
    scores: np.ndarray
    shown: np.ndarray

    def copy(self) -> Terms:
        """With arrays of its own."""
        return Terms(**{name: value.copy() for name, value in self.__dict__.items()})

    def gradient(self, first: np.ndarray) -> np.ndarray:
        """(O, 16 + P)."""
        summed = np.concatenate([np.zeros((1, self.scores.shape[1])), np.cumsum(self.scores, 0)])
        return summed[first[1:]] - summed[first[:-1]]


def prepare(problem: FitProblem, response: Response) -> tuple[Pixels, Tone]:
    """Usable pixels: finite, lit, and of an object. Pixels that get next to no light have all leverage and no information
    (METHOD H59)."""
    ids = np.asarray(problem.object_id)
    use = np.isfinite(problem.base).all(1) & np.isfinite(problem.value).all(1)
    use &= np.isfinite(problem.exposure) & (problem.exposure > 1e-6) & (ids >= 0) & (ids < problem.n_objects)
    for d, s0, s1 in zip(problem.diffuse, problem.s0, problem.s1, strict=True):
        use &= np.isfinite(d).all(1) & np.isfinite(s0).all((1, 2)) & np.isfinite(s1).all((1, 2))
    with np.errstate(invalid="ignore", over="ignore"):
        brightness = np.mean([d.sum(1, dtype=np.float64) for d in problem.diffuse], 0) * problem.exposure
    if use.any():
        use &= brightness > 1e-3 * np.median(brightness[use])
    index = np.flatnonzero(use)
    cluster = problem.cluster[index] if problem.cluster is not None else _runs(ids[index])
    order = np.lexsort((cluster, ids[index]))
    index, cluster = index[order], cluster[order]
    obj = ids[index].astype(np.int64)
    fresh = np.flatnonzero(np.r_[True, (np.diff(obj) != 0) | (np.diff(cluster) != 0)]) if len(index) else np.zeros(0, np.int64)
    starts = np.r_[fresh, len(index)].astype(np.int64)
    first = np.searchsorted(obj[fresh], np.arange(problem.n_objects + 1)).astype(np.int64)
    tone = make_tone(response, problem.value[index])
    kind = np.result_type(*(np.asarray(a).dtype for a in (problem.value, problem.diffuse[0], problem.s0[0], problem.s1[0])))
    kind = np.float32 if kind == np.float32 else np.float64
    levels = np.ascontiguousarray(problem.levels, np.float64)
    shading = np.empty((len(index), len(problem.diffuse), 1 + 2 * len(levels), 3), kind)
    for half, (d, s0, s1) in enumerate(zip(problem.diffuse, problem.s0, problem.s1, strict=True)):
        shading[:, half, 0] = d[index]
        shading[:, half, 1 : 1 + len(levels)] = s0[index]
        shading[:, half, 1 + len(levels) :] = s1[index]
    pixels = Pixels(
        index,
        obj,
        np.ascontiguousarray(problem.base[index], kind),
        shading,
        levels,
        np.ascontiguousarray(tone.value(problem.value[index]), kind),
        np.ascontiguousarray(problem.exposure[index], np.float64),
        np.ascontiguousarray(problem.saturated[index]),
        np.ones((len(index), 3), kind),
        starts,
        first,
    )
    return pixels, tone


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


def evaluate(px: Pixels, affine: np.ndarray, tone: Tone, opt: FitOptions, jacobian: bool) -> Terms:
    """Objective at `affine` (O, 16), with its system if `jacobian`."""
    return _run(px, affine, tone, opt, 1 if jacobian else 0)[0]


def residuals(px: Pixels, affine: np.ndarray, tone: Tone, opt: FitOptions) -> np.ndarray:
    """f(e L) - I of each half, (n, halves, 3) float64; 0 where a bound is met."""
    return _run(px, affine, tone, opt, 2)[1]


def revise(terms: Terms, px: Pixels, affine: np.ndarray, tone: Tone, opt: FitOptions, objects: np.ndarray) -> None:
    """Put the system of some objects (increasing) at `affine` (O, 16) in place of what `terms` has."""
    breaks = np.flatnonzero(np.diff(objects) > 1) + 1
    runs = [(int(run[0]), int(run[-1]) + 1) for run in np.split(objects, breaks) if len(run)]
    for low, high in runs:
        terms.h[low:high] = 0.0
        terms.scores[px.first[low] : px.first[high]] = 0.0
    _fill(terms, np.zeros((0, px.shading.shape[1], 3)), px, affine, tone, opt, 1, runs)


def restore(terms: Terms, before: Terms, px: Pixels, objects: np.ndarray) -> None:
    """Put what `before` has of some objects, (O,) bool, in place of what `terms` has."""
    if not objects.any():
        return
    clusters, pixels = np.repeat(objects, np.diff(px.first)), np.repeat(objects, px.counts)
    rows = {"cost": objects, "data": objects, "size": objects, "h": objects, "scores": clusters, "shown": pixels}
    for name, which in rows.items():
        getattr(terms, name)[which] = getattr(before, name)[which]


def other_tone(terms: Terms, px: Pixels, tone: Tone, opt: FitOptions) -> np.ndarray:
    """(O,) objective of `terms`, which have a system, with another response."""
    data = np.zeros(px.n_objects)
    curve, ends, _ = tone.tables()
    offsets = px.offsets

    def work(part: tuple[int, int]) -> None:
        given = (px.target, px.saturated, px.trust, terms.shown, offsets, tone.knee, tone.gain, curve, ends)
        kernels.toned(*given, opt.robust_width, *part, data)

    _in_threads(work, _parts(px, opt.threads), opt.threads)
    return terms.cost - terms.data + data


def _run(px: Pixels, affine: np.ndarray, tone: Tone, opt: FitOptions, want: int) -> tuple[Terms, np.ndarray]:
    n_objects, width, halves = px.n_objects, PARAMETERS + tone.size, px.shading.shape[1]
    cost, data, size = (np.zeros(n_objects) for _ in range(3))
    h = np.zeros((n_objects if want == 1 else 0, width, width))
    scores = np.zeros((len(px.starts) - 1 if want == 1 else 0, width))
    shown = np.zeros((len(px.obj) if want == 1 else 0, halves, 3))
    errors = np.zeros((len(px.obj) if want == 2 else 0, halves, 3))
    terms = Terms(cost, data, size, h, scores, shown)
    _fill(terms, errors, px, affine, tone, opt, want, _parts(px, opt.threads))
    return terms, errors


def _fill(
    terms: Terms,
    errors: np.ndarray,
    px: Pixels,
    affine: np.ndarray,
    tone: Tone,
    opt: FitOptions,
    want: int,
    parts: list[tuple[int, int]],
) -> None:
    """The kernel over ranges of objects; systems are added to what is there."""
    affine = np.ascontiguousarray(affine, np.float64)
    curve, ends, by_params = tone.tables()

    def work(bounds: tuple[int, int]) -> None:
        kernels.sums(
            px.base,
            px.shading,
            px.levels,
            px.target,
            px.exposure,
            px.saturated,
            px.trust,
            px.starts,
            px.first,
            affine,
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
            bounds[0],
            bounds[1],
            want,
            terms.cost,
            terms.data,
            terms.size,
            terms.h,
            terms.scores,
            errors,
            terms.shown,
        )

    _in_threads(work, parts, opt.threads)


def _in_threads(work: Callable[[tuple[int, int]], None], parts: list[tuple[int, int]], threads: int) -> None:
    if threads > 1 and len(parts) > 1:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, parts))
    else:
        for part in parts:
            work(part)


def _parts(px: Pixels, threads: int) -> list[tuple[int, int]]:
    """Ranges of objects with about as many pixels each."""
    wanted = np.linspace(0, len(px.obj), max(threads, 1) + 1)[1:-1]
    cuts = np.unique(np.r_[0, np.searchsorted(px.offsets, wanted), px.n_objects])
    return list(zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True))
