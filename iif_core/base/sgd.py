"""The paper's optimiser: stochastic gradient descent on texture, corrections and selection together (METHOD 2.3).

The twin of the direct solver: it reads the same problem, its result is described the same way, and
`reference_loss.reference_loss` judges both. The loss of a batch of pixels is

    L = mean KL(Laplace(mu_ref, b_ref) || Laplace(mu, b)) + label loss + 100 identity regulariser     (2.3.4 - 2.3.8)

with mu_ref = sum_k softmax_k(z / tau) clamp(T_k v_k), b_ref the lower median over k of |mu_ref - clamp(T_k v_k)|, and one
Adam over texture, T and z. On the CPU, loss and gradient are closed forms in one compiled pass (sgd_kernels.py); the
torch backend leaves them to automatic differentiation, runs on any device and is the check of the former.

Every choice where the published behaviour is fragile is an option of its own (METHOD 5); `sgd_options("paper")` are the
published ones, `sgd_options("safe")` = `SgdOptions()` the others.

Reproducible: same problem, options and seed give the same bytes on the CPU, for any number of threads (numba backend)
or for a fixed number of torch threads (torch backend); on CUDA gradients of the texture are added in no fixed order.
The order of the predictions matters to rounding alone.

Memory: all predictions (in half precision if they come so), since a batch draws from every view; four textures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .. import laplace
from ..errors import InputError
from ..hashgrid import HashGridOptions, HashGridTexture
from .kernels import IDENTITY, as_floats, as_words
from .problem import LOWEST, BaseProblem, Dropped, object_means, usable_pixels
from .selection import selection_weights

if TYPE_CHECKING:
    import torch

_PROPERTY_OF_CHANNEL = [0, 0, 0, 1, 2]
_FULL_ANNEALS = 81  # multiplications of the paper's largest scene, 8080 steps
_HALVINGS = 4
_COLDEST = 1e-30  # of the temperature, so that 1 / tau is a float32
_CHUNK = 4096  # pixels of a task; fixed, though results do not depend on it

_CHOICES: dict[str, tuple] = {
    "texture": ("cells", "hashgrid"),
    "lr_schedule": ("fraction", "epochs"),
    "anneal_schedule": ("fraction", "steps"),
    "scale_floor_kind": ("smooth", "hard"),
    "clamp_gradient": ("inward", "dead"),
    "logits": ("scaled", "direct"),
    "choice": ("argmin", "soft"),
    "init": ("mean", "paper"),
}


@dataclass(frozen=True)
class SgdOptions:
    """How to solve; defaults are the safe choices, in brackets the published ones.

    Attributes:
        texture: `cells` = one row of ten raw outputs a cell; `hashgrid` = iif_core.hashgrid at the surface points (needs
            problem.point) [hashgrid].
        grid: shape of the hash grid; None = the paper's.
        batch: pixels a step (fewer when the problem has fewer).
        iterations: steps; None = `epochs` passes over the pixels, as many as whole batches fit [None]. A number of
            epochs means little on small scenes (10 epochs of 24 views of 256 x 256 are 240 steps); fix the steps.
        learning_rate: of texture, T and z. lr_schedule: halved at 20, 40, 60, 80 % of the steps (`fraction`) or after
            2, 4, 6, 8 epochs (`epochs`) [epochs].
        temperature: at the start, of z and of the errors. anneal: its factor, applied 81 times evenly over the steps
            (`fraction`, what the paper's largest scene gets) or after step 1, 101, 201, ... (`steps`: then the last
            temperature depends on the size of the scene) [steps].
        temperature_floor: smallest temperature, H4 [0].
        label_weight, regulariser, data_weight: weights of the terms.
        scale_floor, scale_floor_kind: the texture's scale s becomes max(s, floor) (`hard`: no gradient below) or
            sqrt(s^2 + floor^2) (`smooth`, H1) [hard]. b_ref is max(., floor) always.
        median_gradient: gradient through b_ref, which reaches one arbitrary prediction, H3 [True].
        clamp_gradient: of corrected values outside [low, 1]: none (`dead`), or what leads back inside (`inward`, H13)
            [dead]. The loss is the same.
        logits: alpha = softmax(z / tau) (`scaled`), or softmax(z) with tau in the errors alone (`direct`, H5) [scaled].
        choice: `argmin` = the prediction with the least mean L1 error over the segment is chosen, per property, after
            `choose_at` of the steps, and the rest of them fits texture and T to that; `soft` = alpha to the end [soft].
        init: of `cells`: mean and spread of all predictions of the cell (`mean`), or raw outputs 0, that is 0.5
            (`paper`) [paper].
        jitter: points are drawn within the pixel, where the problem has tangents; `hashgrid` alone, H11 [True].
        weighted: pixels count by problem.weight instead of 1 each [False].
        seed: of the order of pixels, the jitter, and the network.
        memory: bytes the predictions may take.
        records: entries of the history.
    """

    texture: str = "cells"
    grid: HashGridOptions | None = None
    batch: int = 65536
    epochs: int = 10
    iterations: int | None = 3000
    learning_rate: float = 1e-2
    lr_schedule: str = "fraction"
    temperature: float = 1.0
    anneal: float = 0.85
    anneal_schedule: str = "fraction"
    temperature_floor: float = 1e-3
    data_weight: float = 1.0
    label_weight: float = 1.0
    regulariser: float = 100.0
    scale_floor: float = laplace.SCALE_FLOOR
    scale_floor_kind: str = "smooth"
    median_gradient: bool = False
    clamp_gradient: str = "inward"
    logits: str = "scaled"
    choice: str = "argmin"
    choose_at: float = 0.5
    init: str = "mean"
    jitter: bool = False
    weighted: bool = False
    seed: int = 0
    memory: int = 8 << 30
    records: int = 200

    def __post_init__(self) -> None:
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                raise InputError(f"base sgd: {name} {getattr(self, name)!r}; allowed: {', '.join(allowed)}")
        for name in ("batch", "epochs", "records", "memory"):
            if getattr(self, name) < 1:
                raise InputError(f"base sgd: {name} {getattr(self, name)}; at least 1")
        if self.iterations is not None and self.iterations < 1:
            raise InputError(f"base sgd: iterations {self.iterations}; at least 1, or None for {self.epochs} epochs")
        for name in ("learning_rate", "temperature", "scale_floor"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"base sgd: {name} {getattr(self, name)}; a positive number is needed")
        for name in ("temperature_floor", "data_weight", "label_weight", "regulariser"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"base sgd: {name} {getattr(self, name)}; 0 or a positive number is needed")
        if not 0 < self.anneal <= 1:
            raise InputError(f"base sgd: anneal {self.anneal}; above 0, at most 1")
        if not 0 <= self.choose_at <= 1:
            raise InputError(f"base sgd: choose_at {self.choose_at}; a share of the steps, 0 to 1")
        if self.texture == "hashgrid" and self.grid is not None and self.grid.outputs != 10:
            raise InputError(f"base sgd: a hash grid of {self.grid.outputs} outputs; 10 are needed (5 locations, 5 scales)")


_PAPER: dict[str, Any] = {
    "texture": "hashgrid",
    "iterations": None,
    "lr_schedule": "epochs",
    "anneal_schedule": "steps",
    "temperature_floor": 0.0,
    "scale_floor_kind": "hard",
    "median_gradient": True,
    "clamp_gradient": "dead",
    "choice": "soft",
    "init": "paper",
    "jitter": True,
}


def sgd_options(preset: str = "safe", **changes: Any) -> SgdOptions:
    """Options of a preset, `safe` or `paper` (the published behaviour), with changes.

    Not reproduced of the paper: rays that miss the mesh (there are no such pixels), coordinates in [-1, 1], half precision.
    """
    presets: dict[str, dict[str, Any]] = {"safe": {}, "paper": _PAPER}
    if preset not in presets:
        raise InputError(f"base sgd: preset {preset!r}; allowed: {', '.join(presets)}")
    return SgdOptions(**{**presets[preset], **changes})


@dataclass(frozen=True)
class SgdFit:
    """What the optimiser found.

    Attributes:
        value, scale: (n_cells, 5) float32 location and Laplace scale (the learnt one); a hash grid is read at the mean
            point of each cell. Cells nobody saw: their object's mean, and a scale as of the least sure tenth.
        corrections: (S, K, 16) float32, packed: albedo 3 x 4 (row = output), roughness 2, metallic 2 (gain, bias).
        alpha: (S, K, 3) float32 selection weights; 0 where the segment has no usable pixel.
        log_alpha, temperature: (S, K, 3) float32 log softmax and the temperature of the last step, for the label loss.
        error: (S, K, 3) float32 mean L1 error of each corrected prediction against the texture, at the end.
        observations, views: (n_cells,) int32 pixels and views that saw the cell.
        dropped: predictions that were not used.
        history: step; data, label, regulariser (without weights), label_part (with its weight), total: means over the
            steps since the last entry; label is 0 once the selection is kept, and for K = 1; temperature,
            learning_rate, entropy (nats), gain (mean of trace A / 3, METHOD H14).
        at_pixels: view -> (location, scale) of the texture at its pixels, (N, 5) float32 each; without meaning where a
            pixel is not used.
    """

    value: NDArray
    scale: NDArray
    corrections: NDArray
    alpha: NDArray
    log_alpha: NDArray
    temperature: float
    error: NDArray
    observations: NDArray
    views: NDArray
    dropped: list[Dropped]
    history: list[dict[str, float]]
    at_pixels: Callable[[int], tuple[NDArray, NDArray]] = field(repr=False)

    @property
    def affine_albedo(self) -> NDArray:
        """(S, K, 3, 4)."""
        return self.corrections[..., :12].reshape(*self.corrections.shape[:2], 3, 4)

    @property
    def affine_roughness(self) -> NDArray:
        """(S, K, 2) = (gain, bias)."""
        return self.corrections[..., 12:14]

    @property
    def affine_metallic(self) -> NDArray:
        """(S, K, 2) = (gain, bias)."""
        return self.corrections[..., 14:]

    @property
    def affine(self) -> NDArray:
        """(S, K, 6, 5): [albedo, roughness, metallic, 1] @ affine = corrected values."""
        out = np.zeros((*self.corrections.shape[:2], 6, 5), np.float32)
        out[..., [0, 1, 2, 5], :3] = self.affine_albedo.swapaxes(-1, -2)
        out[..., [3, 5], 3] = self.affine_roughness
        out[..., [4, 5], 4] = self.affine_metallic
        return out

    @property
    def weight(self) -> NDArray:
        """Selection weights by the name that BaseResult gives them."""
        return self.alpha


def converged(history: list[dict[str, float]], tolerance: float = 0.01) -> bool:
    """Whether the loss is flat: over the last fifth of the history it changes by less than `tolerance`, relatively.

    Compares the means of the first and the last third of that fifth, of data + 100 regulariser: the label loss goes with
    1 / temperature and never settles while that falls. Fewer than 15 entries do not tell: False.
    """
    if len(history) < 15:
        return False
    last = np.array([h["total"] - h["label_part"] for h in history[-max(3, len(history) // 5) :]])
    third = len(last) // 3
    before, after = last[:third].mean(), last[-third:].mean()
    return bool(abs(after - before) <= tolerance * max(abs(before), 1e-12))


# ------------------------------------------------------------------------------------------------------------- pixels


@dataclass(frozen=True)
class _Pool:
    """All usable pixels, view by view, in segment order within a view."""

    values: NDArray  # (P, K, 5) words
    cell: NDArray  # (P,) int32
    segment: NDArray  # (P,) int32
    weight: NDArray  # (P,) float32
    coordinates: NDArray | None  # (P, 3) float32 in [0, 1]
    tangent: NDArray | None  # (P, 2, 3) float32, of the coordinates
    box: tuple[float, float]
    usable: NDArray  # (S, K) bool
    observations: NDArray
    views: NDArray
    dropped: list[Dropped]

    def __len__(self) -> int:
        return len(self.cell)


def _of_view(source: Any, view: int) -> NDArray:
    return np.asarray(source(view) if callable(source) else source[view], np.float32)


def _gather(problem: BaseProblem, options: SgdOptions) -> _Pool:
    """Reads every view once. Raises InputError on shapes, ids, memory, missing points."""
    spatial = options.texture == "hashgrid"
    jitter = spatial and options.jitter and problem.tangent is not None
    if spatial and problem.point is None:
        raise InputError("base sgd: the hash grid needs the surface points of the pixels (BaseProblem.point), there are none")
    observations, views = (np.zeros(problem.n_cells, np.int32) for _ in range(2))
    parts: dict[str, list[NDArray]] = {name: [] for name in ("values", "cell", "segment", "weight", "point", "tangent")}
    dropped: list[Dropped] = []
    usable, view_of_segment = None, np.full(problem.n_segments, -1)
    size = 0
    for view in range(len(problem.cell_of_pixel)):
        maps = problem.view(view)
        if usable is None:
            usable = np.zeros((problem.n_segments, len(maps)), bool)
        if len(maps) != usable.shape[1]:
            raise InputError(
                f"view {view} has {len(maps)} predictions, view 0 has {usable.shape[1]}; give every view the same number"
            )
        found = usable_pixels(problem, view, maps)
        dropped += found.dropped
        segments = np.unique(found.segment)
        if (view_of_segment[segments] >= 0).any():
            segment = segments[np.argmax(view_of_segment[segments] >= 0)]
            raise InputError(f"segment {segment} has pixels in two views; a segment is one object in one view")
        view_of_segment[segments] = view
        usable[segments] = found.usable
        words = as_words(maps)
        size += len(found.pixel) * words.shape[0] * 5 * words.itemsize
        if size > options.memory:
            raise InputError(
                f"base sgd: the predictions of {view + 1} of {len(problem.cell_of_pixel)} views take {size >> 20} MiB, allowed "
                f"are {options.memory >> 20}; raise `memory`, use smaller images or half precision, or the direct solver"
            )
        values = np.ascontiguousarray(words[:, found.pixel].swapaxes(0, 1))
        values[:, ~found.usable] = 0
        parts["values"].append(values)
        parts["cell"].append(found.cell.astype(np.int32))
        parts["segment"].append(found.segment.astype(np.int32))
        parts["weight"].append(found.weight.astype(np.float32))
        if spatial:
            parts["point"].append(_of_view(problem.point, view).reshape(-1, 3)[found.pixel])
        if jitter:
            parts["tangent"].append(_of_view(problem.tangent, view).reshape(-1, 2, 3)[found.pixel])
        observations += np.bincount(found.cell, minlength=problem.n_cells).astype(np.int32)
        views[np.unique(found.cell)] += 1
    if not size:
        raise InputError("base sgd: no pixel has a cell, a segment, weight and finite predictions; check the problem")
    pool = {name: np.concatenate(parts.pop(name)) for name in list(parts) if parts[name]}
    coordinates, tangent, box = None, None, (0.0, 1.0)
    if spatial:
        point = pool["point"]
        if not np.isfinite(point).all():
            raise InputError("base sgd: some surface points of used pixels are not finite; set their cell to -1")
        low, high = float(point.min()), float(point.max())
        pad = max(0.01 * (high - low), 1e-6)  # METHOD 2.0: a cube, padded by 1 %
        box = (low - pad, high + pad)
        coordinates = _coordinates(point, box)
        tangent = pool["tangent"] / np.float32(box[1] - box[0]) if jitter else None
    return _Pool(
        _half_in_range(pool["values"]),
        pool["cell"],
        pool["segment"],
        pool["weight"],
        coordinates,
        tangent,
        box,
        usable,
        observations,
        views,
        dropped,
    )


def _half_in_range(values: NDArray) -> NDArray:
    """Half bits as they are if all are in [0, 1] (what the kernel reads), else float32."""
    if values.dtype == np.uint16:
        values[values == 0x8000] = 0  # minus zero
    if values.dtype == np.uint16 and values.max(initial=0) > 0x3C00:
        return as_floats(values)
    return values


def _coordinates(point: NDArray, box: tuple[float, float]) -> NDArray:
    return ((point - np.float32(box[0])) / np.float32(box[1] - box[0])).astype(np.float32)


def _batches(n: int, batch: int, rng: np.random.Generator) -> Iterator[NDArray]:
    """Batches of a fresh permutation an epoch, the last partial one left out; sorted, which sorts them by segment."""
    while True:
        order = rng.permutation(n).astype(np.int32)
        for start in range(0, n - batch + 1, batch):
            yield np.sort(order[start : start + batch])


def _runs(segment: NDArray) -> tuple[NDArray, NDArray]:
    """(start (R + 1,), segment (R,)) of the runs of equal segments."""
    start = np.flatnonzero(np.r_[True, segment[1:] != segment[:-1]])
    return np.append(start, len(segment)), segment[start]


# ---------------------------------------------------------------------------------------------------------- schedules


def _temperature(options: SgdOptions, step: int, steps: int) -> float:
    if options.anneal_schedule == "steps":
        times = -(-step // 100)
    else:
        times = step * _FULL_ANNEALS // steps
    return max(options.temperature * options.anneal**times, options.temperature_floor, _COLDEST)


def _learning_rate(options: SgdOptions, step: int, steps: int, steps_per_epoch: int) -> float:
    if options.lr_schedule == "epochs":
        times = step // (2 * steps_per_epoch)
    else:
        times = step * (_HALVINGS + 1) // steps
    return options.learning_rate * 0.5 ** min(times, _HALVINGS)


# ------------------------------------------------------------------------------------------------------------ textures


def _activated(raw: NDArray, options: SgdOptions) -> tuple[NDArray, NDArray]:
    """Location and Laplace scale (N, 5) float32 of raw outputs (N, 10) (METHOD 2.3.5)."""
    from .sgd_kernels import LOCATION, SCALE

    sigmoid = 0.5 + 0.5 * np.tanh(0.5 * np.asarray(raw, np.float64))
    value = LOWEST + (1 - LOWEST) * sigmoid[:, LOCATION]
    scale = sigmoid[:, SCALE]
    if options.scale_floor_kind == "smooth":
        scale = np.sqrt(scale**2 + options.scale_floor**2)
    else:
        scale = np.maximum(scale, options.scale_floor)
    return value.astype(np.float32), scale.astype(np.float32)


def _start(pool: _Pool, n_cells: int, options: SgdOptions) -> NDArray:
    """Raw outputs (n_cells, 10) float32 to start from."""
    from .sgd_kernels import LOCATION, SCALE

    raw = np.zeros((n_cells, 10), np.float32)
    if options.init == "paper":
        return raw
    total, square = np.zeros((n_cells, 5)), np.zeros((n_cells, 5))
    for low in range(0, len(pool), _CHUNK * 16):
        rows = slice(low, low + _CHUNK * 16)
        v = np.clip(as_floats(pool.values[rows]), LOWEST, 1)
        use = pool.usable[pool.segment[rows]]
        v, count = v * use[..., None], use.sum(1)[:, None]
        np.add.at(total, pool.cell[rows], v.sum(1) / count)
        np.add.at(square, pool.cell[rows], (v * v).sum(1) / count)
    seen = pool.observations > 0
    count = np.maximum(pool.observations, 1)[:, None]
    mean = total / count
    spread = np.sqrt(np.maximum(square / count - mean**2, 0) / 2)  # of a Laplace distribution: variance 2 b^2
    inside = np.clip((mean - LOWEST) / (1 - LOWEST), 0.005, 0.995)
    spread = np.clip(spread, 2 * options.scale_floor, 0.5)
    raw[:, LOCATION] = np.log(inside / (1 - inside))
    raw[:, SCALE] = np.log(spread / (1 - spread))
    raw[~seen] = 0
    return raw


class _Adam:
    """Adam of a float32 array (torch.optim.Adam's defaults, dense), in the kernel of the hash grid."""

    def __init__(self, parameter: NDArray):
        from ..hashgrid_kernels import SPAN

        self.parameter = parameter.reshape(-1)
        self.gradient, self.first, self.second = (np.zeros_like(self.parameter) for _ in range(3))
        self.span = SPAN
        self.live = np.zeros(-(-self.parameter.size // SPAN), bool)
        self.steps = 0

    def step(self, lr: float, run: Callable = lambda task, arguments: [task(a) for a in arguments]) -> None:
        """One update; zeroes the gradient. `run` shares pieces out: elements are independent."""
        from ..hashgrid_kernels import adam

        self.steps += 1
        beta1, beta2 = 0.9, 0.999
        rate, root = lr / (1 - beta1**self.steps), 1 / math.sqrt(1 - beta2**self.steps)
        numbers = [np.float32(x) for x in (beta1, beta2, rate, root, 1e-8)]
        piece = 4096

        def update(low: int) -> None:
            rows, spans = slice(low * self.span, (low + piece) * self.span), slice(low, low + piece)
            adam(self.parameter[rows], self.first[rows], self.second[rows], self.gradient[rows], self.live[spans], *numbers)

        run(update, range(0, len(self.live), piece))


# ------------------------------------------------------------------------------------------------------------- engines


@dataclass(frozen=True)
class _Step:
    """What a step needs besides the parameters."""

    pixels: NDArray  # (N,) sorted rows of the pool
    coordinates: NDArray | None  # (N, 3)
    temperature: float
    learning_rate: float


_NAMES = ("data", "label", "regulariser", "entropy", "gain")


class _Numba:
    """CPU engine: closed-form gradients. `alpha` fixed once `fix` was called."""

    def __init__(self, pool: _Pool, options: SgdOptions, n_cells: int, threads: int):
        from . import sgd_kernels

        self.kernels, self.pool, self.options = sgd_kernels, pool, options
        self.threads = ThreadPoolExecutor(threads) if threads > 1 else None
        s, k = pool.usable.shape
        self.affine = np.tile(IDENTITY, (s, k, 1))
        self.z = np.zeros((s, k, 3), np.float32)
        self.fixed: NDArray | None = None
        self.networks = sgd_kernels.selection_networks(k)
        self.adam_affine, self.adam_z = _Adam(self.affine), _Adam(self.z)
        self.d_alpha, self.votes = np.zeros((s, k, 3), np.float32), np.zeros((s, k, 3), np.float32)
        self.grid = HashGridTexture(options.grid, options.seed, "cpu", threads) if options.texture == "hashgrid" else None
        if self.grid is None:
            self.table = _start(pool, n_cells, options)
            self.adam_table = _Adam(self.table)

    def close(self) -> None:
        if self.threads is not None:
            self.threads.shutdown()

    def run(self, task: Callable[[Any], None], arguments: Iterable) -> None:
        if self.threads is None:
            for argument in arguments:
                task(argument)
        else:
            list(self.threads.map(task, arguments))

    def weights(self, temperature: float) -> tuple[NDArray, NDArray]:
        """alpha, log alpha (S, K, 3) float32."""
        if self.fixed is not None:
            return self.fixed, np.log(self.fixed, out=np.zeros_like(self.fixed), where=self.fixed > 0)
        divisor = temperature if self.options.logits == "scaled" else 1.0
        return _softmax(self.z, divisor, self.pool.usable)

    def losses(self, step: _Step, raw: NDArray, share: NDArray, error: NDArray) -> tuple[NDArray, NDArray]:
        """Gradients into the Adams and d_alpha, votes; returns d_raw and the sums (SUMS,)."""
        pool, options = self.pool, self.options
        start, segment = _runs(pool.segment[step.pixels])
        alpha, log_alpha = self.weights(step.temperature)
        self.d_alpha[segment], self.votes[segment] = 0, 0
        d_raw = np.empty_like(raw)
        sums = np.zeros((len(segment), self.kernels.SUMS))
        numbers = np.array([step.temperature, options.scale_floor, options.data_weight, options.regulariser], np.float32)
        flags = np.array([options.scale_floor_kind == "smooth", options.median_gradient, options.clamp_gradient == "inward"])
        gradient = self.adam_affine.gradient.reshape(self.affine.shape)
        edges = np.unique(np.searchsorted(start, np.arange(0, len(step.pixels) + _CHUNK, _CHUNK)).clip(0, len(segment)))

        def work(piece: tuple[int, int]) -> None:
            self.kernels.batch_loss(
                *(*piece, start, segment, pool.values, step.pixels, share, raw, self.affine, alpha, log_alpha),
                *(pool.usable, *self.networks, numbers, flags),
                *(d_raw, gradient, self.d_alpha, self.votes, error, sums),
            )

        self.run(work, list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)))
        if self.fixed is None and pool.usable.shape[1] > 1:
            divisor = step.temperature if options.logits == "scaled" else 1.0
            slope = _logit_slope(alpha[segment], self.d_alpha[segment], self.votes[segment], options.label_weight, divisor)
            self.adam_z.gradient.reshape(self.z.shape)[segment] = slope
        else:
            sums[:, 1] = 0  # a kept selection has no label loss
        return d_raw, sums.sum(0)

    def step(self, step: _Step) -> NDArray:
        """One update of everything; returns the sums (SUMS,)."""
        share = _share(self.pool, step.pixels, self.options)
        error = np.zeros((*self.pool.usable.shape, 3))
        rows, graph = self.pool.cell[step.pixels], None
        if self.grid is None:
            raw = self.table[rows]
        else:
            import torch

            graph = self.grid(torch.from_numpy(step.coordinates))
            raw = graph.detach().numpy()
        d_raw, sums = self.losses(step, raw, share, error)
        if np.isfinite(sums).all():
            if graph is None:
                self.kernels.add_rows(self.adam_table.gradient.reshape(self.table.shape), rows, d_raw)
                self.adam_table.step(step.learning_rate, self.run)
            else:
                import torch

                graph.backward(torch.from_numpy(d_raw))
                self.grid.step(step.learning_rate)
            self.adam_affine.step(step.learning_rate, self.run)
            if self.fixed is None:
                self.adam_z.step(step.learning_rate)
        return sums

    def errors(self, temperature: float) -> NDArray:
        """(S, K, 3) mean L1 error of every corrected prediction against the texture, over all pixels."""
        total = np.zeros((*self.pool.usable.shape, 3))
        for low in range(0, len(self.pool), self.options.batch):
            pixels = np.arange(low, min(low + self.options.batch, len(self.pool)), dtype=np.int32)
            raw = self.raw(pixels)
            self.losses(_Step(pixels, None, temperature, 0.0), raw, np.ones(len(pixels), np.float32), total)
        self.adam_affine.gradient[:] = 0
        self.adam_z.gradient[:] = 0
        return total

    def raw(self, pixels: NDArray) -> NDArray:
        """Raw outputs at pixels of the pool, without jitter."""
        if self.grid is None:
            return self.table[self.pool.cell[pixels]]
        return self.at(self.pool.coordinates[pixels])

    def at(self, coordinates: NDArray) -> NDArray:
        """Raw outputs of the hash grid."""
        import torch

        return self.grid.evaluate(torch.from_numpy(coordinates)).numpy()

    def cells(self) -> NDArray:
        return self.table

    def fix(self, alpha: NDArray) -> None:
        self.fixed = np.ascontiguousarray(alpha, np.float32)

    def state(self) -> NDArray:
        return self.affine


def _softmax(z: NDArray, divisor: float, usable: NDArray) -> tuple[NDArray, NDArray]:
    """Softmax of z / divisor over the usable k and its logarithm, (S, K, 3) float32; 0 and 0 where not usable."""
    use = usable[..., None]
    lowest = np.where(use, z, -np.inf).max(1, keepdims=True)
    exponent = np.where(use, z - np.where(np.isfinite(lowest), lowest, 0), 0).astype(np.float64) / divisor
    power = np.exp(exponent) * use
    total = power.sum(1, keepdims=True)
    total[total == 0] = 1
    log = np.where(use, exponent - np.log(total), 0)
    return (power / total).astype(np.float32), log.astype(np.float32)


def _logit_slope(alpha: NDArray, d_alpha: NDArray, votes: NDArray, label_weight: float, divisor: float) -> NDArray:
    """Slope of the loss with respect to z, (S, K, 3), of alpha = softmax_k(z / divisor).

    The data term comes through alpha, d_alpha its slope; the label loss -(label_weight / 3) sum votes log alpha directly.
    """
    slope = alpha * (d_alpha - (alpha * d_alpha).sum(1, keepdims=True))
    slope += (alpha * votes.sum(1, keepdims=True) - votes) * alpha.dtype.type(label_weight / 3)
    return slope / alpha.dtype.type(divisor)


def _share(pool: _Pool, pixels: NDArray, options: SgdOptions) -> NDArray:
    """How much each pixel of a batch counts, sum 1."""
    if not options.weighted:
        return np.full(len(pixels), 1 / len(pixels), np.float32)
    weight = pool.weight[pixels]
    return weight / weight.sum()


class _Torch:
    """Any device: the same loss left to automatic differentiation."""

    def __init__(self, pool: _Pool, options: SgdOptions, n_cells: int, threads: int, device: str):
        import torch

        self.torch, self.pool, self.options, self.device = torch, pool, options, torch.device(device)
        s, k = pool.usable.shape
        values = pool.values.view(np.float16) if pool.values.dtype == np.uint16 else pool.values
        self.values = self.tensor(values)
        self.segment, self.cell = self.tensor(pool.segment.astype(np.int64)), self.tensor(pool.cell.astype(np.int64))
        self.usable, self.weight = self.tensor(pool.usable), self.tensor(pool.weight)
        self.affine = self.tensor(np.tile(IDENTITY, (s, k, 1))).requires_grad_()
        self.z = torch.zeros((s, k, 3), device=self.device, requires_grad=True)
        self.fixed = None
        self.grid, self.table = None, None
        if options.texture == "hashgrid":
            self.grid = HashGridTexture(options.grid, options.seed, str(device), threads)
            parameters = [self.affine, self.z]
        else:
            self.table = self.tensor(_start(pool, n_cells, options)).requires_grad_()
            parameters = [self.table, self.affine, self.z]
        self.optimiser = torch.optim.Adam(parameters, lr=options.learning_rate)

    def tensor(self, array: NDArray) -> torch.Tensor:
        return self.torch.from_numpy(np.ascontiguousarray(array)).to(self.device)

    def close(self) -> None:
        pass

    def losses(self, pixels: torch.Tensor, raw: torch.Tensor, temperature: float) -> dict[str, torch.Tensor]:
        segment = self.segment[pixels]
        share = self.weight[pixels] if self.options.weighted else self.torch.ones_like(self.weight[pixels])
        divisor = temperature if self.options.logits == "scaled" else 1.0
        found = torch_losses(
            raw,
            self.values[pixels].to(self.torch.float32),
            self.affine,
            self.z,
            segment,
            self.usable,
            share / share.sum(),
            temperature,
            divisor,
            self.options,
            self.fixed,
        )
        if self.fixed is not None:
            found["label"] = self.torch.zeros_like(found["label"])  # a kept selection has no label loss
        return found

    def step(self, step: _Step) -> NDArray:
        pixels = self.tensor(step.pixels.astype(np.int64))
        raw = self.grid(self.tensor(step.coordinates)) if self.table is None else self.table[self.cell[pixels]]
        found = self.losses(pixels, raw, step.temperature)
        o = self.options
        loss = o.data_weight * found["data"] + o.regulariser * found["regulariser"] + o.label_weight * found["label"]
        sums = self.torch.stack([found[name].detach() for name in _NAMES]).cpu().numpy().astype(np.float64)
        if np.isfinite(sums).all():
            self.optimiser.zero_grad(set_to_none=False)
            loss.backward()
            self.optimiser.param_groups[0]["lr"] = step.learning_rate
            self.optimiser.step()
            if self.grid is not None:
                self.grid.step(step.learning_rate)
        return sums

    def errors(self, temperature: float) -> NDArray:
        total = np.zeros((*self.pool.usable.shape, 3))
        with self.torch.no_grad():
            for low in range(0, len(self.pool), self.options.batch):
                rows = np.arange(low, min(low + self.options.batch, len(self.pool)))
                found = self.losses(self.tensor(rows), self.tensor(self.raw(rows)), temperature)["error"]
                np.add.at(total, self.pool.segment[rows], found.cpu().numpy())
        return total

    def raw(self, pixels: NDArray) -> NDArray:
        if self.table is None:
            return self.at(self.pool.coordinates[pixels])
        return self.table.detach()[self.cell[self.tensor(pixels.astype(np.int64))]].cpu().numpy()

    def at(self, coordinates: NDArray) -> NDArray:
        return self.grid.evaluate(self.tensor(coordinates)).cpu().numpy()

    def cells(self) -> NDArray:
        return self.table.detach().cpu().numpy()

    def weights(self, temperature: float) -> tuple[NDArray, NDArray]:
        if self.fixed is not None:
            alpha = self.fixed.cpu().numpy()
            return alpha, np.log(alpha, out=np.zeros_like(alpha), where=alpha > 0)
        divisor = temperature if self.options.logits == "scaled" else 1.0
        return _softmax(self.z.detach().cpu().numpy(), divisor, self.pool.usable)

    def fix(self, alpha: NDArray) -> None:
        self.fixed = self.tensor(np.asarray(alpha, np.float32))

    def state(self) -> NDArray:
        return self.affine.detach().cpu().numpy()


def torch_losses(
    raw: torch.Tensor,
    values: torch.Tensor,
    affine: torch.Tensor,
    z: torch.Tensor,
    segment: torch.Tensor,
    usable: torch.Tensor,
    share: torch.Tensor,
    temperature: float,
    divisor: float,
    options: SgdOptions,
    fixed: torch.Tensor | None = None,
) -> dict[str, torch.Tensor]:
    """The terms of the loss of a batch in torch operations, any real type and device; differentiable.

    Args:
        raw: (N, 10) raw outputs of the texture. values: (N, K, 5). affine: (S, K, 16). z: (S, K, 3).
        segment: (N,) int64. usable: (S, K) bool. share: (N,), sum 1. divisor: of z. fixed: (S, K, 3) alpha, no logits.

    Returns:
        data, label, regulariser (without its weight), entropy, gain: scalars; error (N, K, 3) L1, without a graph.
    """
    import torch

    from .sgd_kernels import LOCATION, SCALE

    low = torch.as_tensor(LOWEST, device=raw.device).to(raw.dtype)
    floor = options.scale_floor
    use, t = usable[segment], affine[segment]
    n_used = use.sum(1)
    sigmoid = raw.sigmoid()
    mu = low + (1 - low) * sigmoid[:, LOCATION]
    b = sigmoid[:, SCALE]
    b = (b * b + floor**2).sqrt() if options.scale_floor_kind == "smooth" else b.clamp_min(floor)

    albedo = t[..., :12].unflatten(-1, (3, 4))
    corrected = torch.cat(
        [
            (albedo[..., :3] * values[..., None, :3]).sum(-1) + albedo[..., 3],
            t[..., 12:13] * values[..., 3:4] + t[..., 13:14],
            t[..., 14:15] * values[..., 4:] + t[..., 15:],
        ],
        -1,
    )
    corrected = _clamped(corrected, low, options.clamp_gradient)

    if fixed is None:
        y = (z - z.masked_fill(~usable[..., None], -torch.inf).amax(1, keepdim=True).clamp_min(-1e30).detach()) / divisor
        log_alpha = y.masked_fill(~usable[..., None], -torch.inf).log_softmax(1).masked_fill(~usable[..., None], 0)
        alpha = log_alpha.exp() * usable[..., None]
    else:
        alpha = fixed.to(raw.dtype)
        log_alpha = torch.where(alpha > 0, alpha, 1.0).log()
    alpha_n = alpha[segment]
    mixed = (alpha_n[..., _PROPERTY_OF_CHANNEL] * corrected).sum(1)
    spread = (mixed[:, None] - corrected).abs()
    ranked = torch.where(use[..., None], spread.detach(), torch.inf).sort(dim=1).values
    median = ranked.gather(1, ((n_used - 1).clamp_min(0) // 2)[:, None, None].expand(-1, 1, 5))
    index = torch.arange(usable.shape[1], device=raw.device)[None, :, None]
    is_median = (spread.detach() == median) & use[..., None]
    first = torch.where(is_median, index, usable.shape[1] - 1).amin(1, keepdim=True)  # of those that are equal
    b_ref = spread.gather(1, first)[:, 0].clamp_min(floor)
    if not options.median_gradient:
        b_ref = b_ref.detach()
    d = (mixed - mu).abs()
    kl = (b / b_ref).log() + (d + b_ref * (-d / b_ref).exp()) / b - 1
    data = (share * kl.mean(1)).sum()

    with torch.no_grad():
        off = (corrected - mu[:, None]).abs()
        error = torch.stack([off[..., :3].mean(-1), off[..., 3], off[..., 4]], -1)
        nearest = torch.where(use[..., None], error, torch.inf).amin(1, keepdim=True)
        q = ((nearest - error) / temperature).masked_fill(~use[..., None], -torch.inf).softmax(1)
    label = -(share[:, None, None] * q * torch.where(q > 0, log_alpha[segment], 0)).sum() / 3

    a, identity = albedo[..., :3], torch.eye(3, dtype=raw.dtype, device=raw.device)
    penalty = ((a - identity) ** 2).sum((-1, -2)) + (albedo[..., 3] ** 2).sum(-1)
    penalty = penalty + ((a @ a.mT - identity) ** 2).sum((-1, -2))
    penalty = penalty + ((t[..., 12:] - torch.tensor([1.0, 0.0, 1.0, 0.0], device=raw.device)) ** 2).sum(-1)
    regulariser = (share * (penalty * use).sum(1) / n_used).sum()

    with torch.no_grad():
        entropy = -(share * (alpha * log_alpha).sum((1, 2))[segment]).sum() / 3
        gain = (share * (alpha_n[..., 0] * (t[..., 0] + t[..., 5] + t[..., 10])).sum(1)).sum() / 3
        error = error * use[..., None]
    return {"data": data, "label": label, "regulariser": regulariser, "entropy": entropy, "gain": gain, "error": error}


def _clamped(x: torch.Tensor, low: torch.Tensor, gradient: str) -> torch.Tensor:
    """x within [low, 1]; `gradient`: as in SgdOptions.clamp_gradient."""
    import torch

    clamped = torch.maximum(torch.minimum(x, torch.ones_like(x)), low.expand_as(x))
    outside = x.detach() - clamped.detach()
    dead = torch.where(outside == 0, x, clamped.detach())
    if gradient == "dead" or not x.requires_grad:
        return dead
    inward = clamped.detach() + (x - x.detach())
    inward.register_hook(lambda slope: torch.where((outside == 0) | (outside * slope > 0), slope, 0))
    return inward


# -------------------------------------------------------------------------------------------------------------- solver


def solve_base_sgd(
    problem: BaseProblem,
    options: SgdOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    threads: int = 2,
    device: str = "cpu",
    weight: NDArray | None = None,
    backend: str | None = None,
) -> SgdFit:
    """Texture, corrections and selection of a problem by the paper's optimiser.

    `progress(done, total)` counts steps. `weight` (S, K, 3): selection weights to keep instead of learning them, for
    comparing solvers at the same selection. `backend`: "numba" (CPU), "torch", or None: numba on the CPU, else torch.

    Raises:
        InputError: shapes that do not match, ids out of range, a segment in two views, no usable pixel, too much memory,
            a hash grid without surface points, a loss that is not finite.
    """
    options = options or SgdOptions()
    on_cpu = str(device).startswith("cpu")
    backend = backend or ("numba" if on_cpu else "torch")
    if backend not in ("numba", "torch") or (backend == "numba" and not on_cpu):
        raise InputError(f"base sgd: backend {backend!r} on device {device}; numba runs on the cpu, torch anywhere")
    if threads < 1:
        raise InputError(f"base sgd: {threads} threads; at least 1")
    pool = _gather(problem, options)
    n_segments, k = pool.usable.shape
    if weight is not None and np.shape(weight) != (n_segments, k, 3):
        raise InputError(f"base sgd: weight has shape {np.shape(weight)}; needed is {(n_segments, k, 3)}")
    batch = min(options.batch, len(pool))
    per_epoch = max(1, len(pool) // batch)
    steps = options.iterations or options.epochs * per_epoch
    if backend == "numba":
        engine: _Numba | _Torch = _Numba(pool, options, problem.n_cells, threads)
    else:
        engine = _Torch(pool, options, problem.n_cells, threads, device)
    try:
        return _solve(problem, options, pool, engine, steps, batch, per_epoch, weight, progress)
    finally:
        engine.close()


def _solve(
    problem: BaseProblem,
    options: SgdOptions,
    pool: _Pool,
    engine: _Numba | _Torch,
    steps: int,
    batch: int,
    per_epoch: int,
    weight: NDArray | None,
    progress: Callable[[int, int], None] | None,
) -> SgdFit:
    rng = np.random.default_rng(options.seed)
    batches = _batches(len(pool), batch, rng)
    single = pool.usable.shape[1] == 1
    if weight is not None or single:
        engine.fix(weight if weight is not None else pool.usable[..., None] * np.ones(3))
    choose = options.choice == "argmin" and weight is None and not single
    choose_at = round(options.choose_at * steps)
    history: list[dict[str, float]] = []
    every = max(1, steps // options.records)
    sums, since = np.zeros(len(_NAMES)), 0
    for step in range(steps):
        temperature = _temperature(options, step, steps)
        if choose and step == choose_at:
            engine.fix(_chosen(engine.errors(temperature), pool))
        lr = _learning_rate(options, step, steps, per_epoch)
        pixels = next(batches)
        coordinates = None
        if pool.coordinates is not None:
            coordinates = pool.coordinates[pixels]
            if pool.tangent is not None:
                offset = rng.random((len(pixels), 2, 1), np.float32) - np.float32(0.5)
                coordinates = coordinates + (offset * pool.tangent[pixels]).sum(1)
        found = engine.step(_Step(pixels, coordinates, temperature, lr))
        if not np.isfinite(found).all():
            terms = ", ".join(f"{name} {x:.3g}" for name, x in zip(_NAMES, found, strict=True))
            raise InputError(f"base sgd: the loss is not finite at step {step} ({terms}); lower learning_rate or regulariser")
        sums, since = sums + found, since + 1
        if since == every or step == steps - 1:
            history.append(_entry(step + 1, sums / since, options, temperature, lr))
            sums, since = np.zeros(len(_NAMES)), 0
            if progress is not None:
                progress(step + 1, steps)
    temperature = _temperature(options, steps - 1, steps)
    total = engine.errors(temperature)
    if choose and choose_at >= steps:
        engine.fix(_chosen(total, pool))
    return _fit(problem, options, pool, engine, total, temperature, history)


def _chosen(error: NDArray, pool: _Pool) -> NDArray:
    """(S, K, 3) weights of the least error; equal ones share, so that the order of the predictions does not matter."""
    use = np.broadcast_to(pool.usable[:, None, :], (len(error), 3, error.shape[1]))
    count = np.maximum(np.bincount(pool.segment, minlength=len(error)), 1)
    return selection_weights((error / count[:, None, None]).swapaxes(1, 2), 0.0, use).swapaxes(1, 2)


def _entry(step: int, means: NDArray, options: SgdOptions, temperature: float, lr: float) -> dict[str, float]:
    data, label, regulariser, entropy, gain = (float(x) for x in means)
    label_part = options.label_weight * label
    return {
        "step": float(step),
        "data": data,
        "label": label,
        "regulariser": regulariser,
        "label_part": label_part,
        "total": options.data_weight * data + label_part + options.regulariser * regulariser,
        "temperature": temperature,
        "learning_rate": lr,
        "entropy": entropy,
        "gain": gain,
    }


def _fit(
    problem: BaseProblem,
    options: SgdOptions,
    pool: _Pool,
    engine: _Numba | _Torch,
    total: NDArray,
    temperature: float,
    history: list[dict[str, float]],
) -> SgdFit:
    n_cells, seen = problem.n_cells, pool.observations > 0
    if pool.coordinates is None:
        raw = engine.cells()
    else:
        centre = np.stack([np.bincount(pool.cell, pool.coordinates[:, a], n_cells) for a in range(3)], 1)
        centre /= np.maximum(pool.observations, 1)[:, None]
        raw = engine.at(centre.astype(np.float32))
    value, scale = _activated(raw, options)
    object_value, _ = object_means(value, problem.object_of_cell, pool.observations)
    value[~seen] = object_value[problem.object_of_cell[~seen]]
    scale[~seen] = np.quantile(scale[seen], 0.9, axis=0)
    alpha, log_alpha = engine.weights(temperature)
    count = np.bincount(pool.segment, minlength=problem.n_segments)[:, None, None]

    def at_pixels(view: int) -> tuple[NDArray, NDArray]:
        if pool.coordinates is None:
            cell = np.maximum(np.ravel(problem.cell_of_pixel[view]), 0)
            return value[cell], scale[cell]
        point = _of_view(problem.point, view).reshape(-1, 3)
        point = np.where(np.isfinite(point), point, np.float32(pool.box[0]))
        return _activated(engine.at(_coordinates(point, pool.box)), options)

    return SgdFit(
        value=value,
        scale=scale,
        corrections=engine.state().copy(),
        alpha=np.where(count > 0, alpha, 0).astype(np.float32),
        log_alpha=log_alpha,
        temperature=temperature,
        error=(total / np.maximum(count, 1)).astype(np.float32),
        observations=pool.observations,
        views=pool.views,
        dropped=pool.dropped,
        history=history,
        at_pixels=at_pixels,
    )
