"""The bank of errors of the learned prior, which prior `simulated` draws as `errors: measured` (lab/docs/simulated.md#measured).

In rooms that were kept back from training, the network predicts as the product does, and its errors are coded, standardised given
the true value, and summed up as correlations of all predictions and channels by distance, in one view and between views. `fit`
finds a linear model of coregionalisation of normal scores whose errors have these correlations (Goulard and Voltz 1992).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import factorial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial.hermite_e import hermeval
from numpy.typing import NDArray
from scipy.special import ndtr

from iif_core.priors.features import mirrored
from iif_core.priors.hypotheses import combined
from iif_core.reflectance.material import PROPERTIES
from lab.prior import captures, evaluation
from lab.simulated.measured import CHANNELS, SCORES, ErrorBank, coded, normal_grid

SAMPLES = 16
"""K: the eight hypotheses of the network and of the mirrored photograph."""
BINS = (6, 5, 5, 5)
"""Bins of equal count for the true values of the first four channels; metallic has two, split at METAL."""
METAL = 0.5
LENGTHS = (0.04, 0.12, 0.4, 1.2, np.inf)
"""Correlation lengths in metres of the fields, a factor of three apart: from a few pixels of a photograph to the room."""
EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.6, 1.0, 1.7, 3.0)
"""Edges in metres of the classes of distance."""
RANK = 16
"""Fields of one length."""
ORDER = 12
"""Hermite polynomials of an error as a function of its normal score."""
PIXELS = 400
"""Pixels of a view that are taken."""
NEAR = 0.2
"""Distance in metres up to which all pairs are sought; beyond, random pairs are."""
PAIRS, FEWEST = 20_000, 50
"""Pairs of pixels in one class of distance of a room: at most, and at least to count."""
SWEEPS = 300


@dataclass(frozen=True)
class Sampled:
    """Errors at n pixels of one room.

    Attributes:
        view: (n,) which view a pixel is of. points: (n, 3) surface that it shows, in metres.
        truth: (n, C) coded truth. error: (n, K, C) coded prediction less truth.
    """

    view: NDArray
    points: NDArray
    truth: NDArray
    error: NDArray


def sample(capture: captures.Capture, weights: evaluation.Weights, seed: int) -> Sampled | None:
    """Predict all views of a generated room, and take the errors at random pixels; None where nothing has truth."""
    calibration = tuple(weights.recipe.get("scale_calibration", (1.0,) * len(PROPERTIES)))
    by_name = {view.name: view for view in capture.used}
    rows: list[tuple[NDArray, ...]] = []
    for case in evaluation.cases(capture, weights, capture.given):
        view = by_name[case.name]
        both = weights.heads(case.inputs), weights.heads(mirrored(case.inputs))[:, :, ::-1]
        maps = combined(np.concatenate(both)[..., :8], SAMPLES, calibration=calibration).maps
        counts = np.logical_and.reduce(list(case.masks.values()))
        rng = np.random.default_rng([seed, view.view_id])
        at = rng.permutation(np.flatnonzero(counts))[:PIXELS]
        true = np.concatenate([case.truth[name].reshape(*counts.shape, -1) for name in ("albedo", "roughness", "metallic")], -1)
        own = coded(true.reshape(-1, 5)[at])
        error = coded(maps.reshape(SAMPLES, -1, 5)[:, at]) - own
        points = capture.points(view, capture.gbuffer(view)[0]).reshape(-1, 3)[at]
        rows.append((np.full(len(at), view.view_id), points, own, np.moveaxis(error, 0, 1)))
    return Sampled(*(np.concatenate(part) for part in zip(*rows, strict=True))) if rows else None


def quantiles(rooms: list[Sampled]) -> tuple[NDArray, NDArray]:
    """Return the true values (C, B) and the errors (C, B, K, Q) at SCORES; channels of fewer bins repeat their last one."""
    truth, error = (np.concatenate([getattr(room, name) for room in rooms]) for name in ("truth", "error"))
    middles: list[list[float]] = []
    tables: list[list[NDArray]] = []
    for c in range(len(CHANNELS)):
        own = truth[:, c]
        edges = np.unique(np.quantile(own, np.linspace(0, 1, BINS[c] + 1)[1:-1])) if c < len(BINS) else np.array([METAL])
        number = np.digitize(own, edges)
        taken = [number == i for i in range(len(edges) + 1) if (number == i).any()]
        middles.append([float(own[use].mean()) for use in taken])
        tables.append([np.quantile(error[use][:, :, c], ndtr(SCORES), axis=0).T for use in taken])
    most = max(map(len, middles))
    padded = [[*own, *(own[-1] + 1e-3 * (1 + np.arange(most - len(own))))] for own in middles]
    return np.array(padded), np.stack([np.stack([*own, *[own[-1]] * (most - len(own))]) for own in tables])


def standardised(bank: ErrorBank, room: Sampled) -> NDArray:
    """Return the errors (n, K, C) less their mean, in standard deviations, both given the true value."""
    mean, deviation = bank.moments()
    out = np.empty(room.error.shape, np.float32)
    for c in range(len(CHANNELS)):
        low, share = bank.between(c, room.truth[:, c])
        above = np.minimum(low + 1, mean.shape[1] - 1)
        m, s = (a[c, low] + share[:, None] * (a[c, above] - a[c, low]) for a in (mean, deviation))
        out[..., c] = (room.error[..., c] - m) / np.maximum(s, 1e-6)
    return out


def of_scores(bank: ErrorBank, rooms: list[Sampled], correlation: NDArray) -> NDArray:
    """Return the correlations (..., P, P) of normal scores whose errors have these correlations (Nataf's transformation).

    An error is a rising function of its score: a sum of Hermite polynomials with coefficients a_n. Two errors of one channel are
    then correlated by sum_n a_n^2 r^n where their scores are by r. Of two channels, the coefficients are means over the truth.
    """
    z, weight = normal_grid()
    powers = np.arange(1, ORDER + 1)
    basis = np.stack([hermeval(z, np.eye(ORDER + 1)[n]) / np.sqrt(float(factorial(n))) for n in powers], 1) * weight[:, None]
    mean, deviation = bank.moments()
    error = (bank.at_scores(z) - mean[..., None]) / np.maximum(deviation, 1e-6)[..., None]
    coefficient = error @ basis  # (C, B, K, n)
    share = np.zeros(mean.shape[:2])
    for c in range(len(CHANNELS)):
        low, part = bank.between(c, np.concatenate([room.truth[:, c] for room in rooms]))
        share[c] = np.bincount(low, 1 - part, share.shape[1])
        share[c] += np.bincount(np.minimum(low + 1, share.shape[1] - 1), part, share.shape[1])
    share /= share.sum(1, keepdims=True)
    middle = np.einsum("cb,cbkn->cn", share, coefficient) / bank.samples
    square = np.einsum("cb,cbkn->cn", share, coefficient**2) / bank.samples
    grid = np.linspace(-1, 1, 401)
    blocks = correlation.reshape(*correlation.shape[:-2], bank.samples, len(CHANNELS), bank.samples, len(CHANNELS))
    out = np.empty_like(blocks)
    for c in range(len(CHANNELS)):
        for other in range(len(CHANNELS)):
            terms = square[c] / square[c].sum() if c == other else middle[c] * middle[other]
            rising = np.maximum.accumulate((terms * grid[:, None] ** powers).sum(1)) + 1e-9 * grid
            out[..., c, :, other] = np.interp(blocks[..., c, :, other], rising, grid)
    return out.reshape(correlation.shape)


@dataclass(frozen=True)
class Correlations:
    """Correlations of P variables by class of distance and by whether a pair of pixels lies in one view; rooms count alike.

    Attributes:
        mean: (1 + 2 J, P, P) symmetric: of a pixel with itself, then within a view, then between views; NaN = no pairs.
        shape: (1 + 2 J, L) mean of exp(-d^2 / (2 l^2)) over the pairs, for each of LENGTHS.
    """

    mean: NDArray
    shape: NDArray

    def of_channels(self) -> NDArray:
        """Return (2, 2, J, C) correlations of a channel: within a view or between views, of a sample with itself or others."""
        k = self.mean.shape[1] // len(CHANNELS)
        blocks = self.mean.reshape(-1, k, len(CHANNELS), k, len(CHANNELS))
        of_channel = np.einsum("rkclc->rckl", blocks)
        itself = np.einsum("rckk->rc", of_channel) / k
        others = (of_channel.sum((2, 3)) - k * itself) / max(k * (k - 1), 1)
        own = np.stack([itself, others])[:, 1:].reshape(2, 2, -1, len(CHANNELS))
        return np.moveaxis(own, 1, 0)


def correlations(rooms: Iterable[tuple[NDArray, NDArray, NDArray]], seed: int = 0) -> Correlations:
    """Sum up (values (n, P) of mean 0, points (n, 3), view (n,)) of rooms; both orders of a pair count.

    The variances of a class are those of its own pairs: pixels that lie close together show what is close to the camera, which
    has larger errors than the average.
    """
    classes = len(EDGES) - 1
    shape, count = np.zeros((1 + 2 * classes, len(LENGTHS))), np.zeros(1 + 2 * classes)
    product: Any = 0
    square: Any = 0
    for number, (values, points, view) in enumerate(rooms):
        products = np.zeros((len(count), values.shape[1], values.shape[1]))
        squares = np.zeros(products.shape[:2])
        i, j, distance = _pairs(points, np.random.default_rng([seed, number]))
        kind = 1 + np.digitize(distance, EDGES[1:]) + np.where(view[i] == view[j], 0, classes)
        kind[distance >= EDGES[-1]] = 0
        for row in range(len(count)):
            at = np.flatnonzero(kind == row)[:PAIRS] if row else np.arange(0)
            left, right = (values[i[at]], values[j[at]]) if row else (values, values)
            if len(left) < FEWEST:
                continue
            mean = left.T @ right / len(left)
            products[row] = (mean + mean.T) / 2
            squares[row] = ((left**2).mean(0) + (right**2).mean(0)) / 2
            shape[row] += np.exp(-0.5 * (distance[at, None] / np.array(LENGTHS)) ** 2).mean(0) if row else 1
            count[row] += 1
        product, square = product + products, square + squares
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.sqrt(square)
        return Correlations(product / (size[:, :, None] * size[:, None]), shape / count[:, None])


def _pairs(points: NDArray, rng: np.random.Generator) -> tuple[NDArray, NDArray, NDArray]:
    """Pairs of pixels in random order (i, j, distance): near ones, which are rare among random ones, and random ones."""
    from scipy.spatial import cKDTree

    near = rng.permutation(cKDTree(points).query_pairs(NEAR, output_type="ndarray"))[: 20 * PAIRS]
    far = rng.integers(0, len(points), (10 * PAIRS, 2))
    far = far[np.linalg.norm(points[far[:, 0]] - points[far[:, 1]], axis=1) >= NEAR]
    i, j = np.concatenate([near, far]).T
    return i, j, np.linalg.norm(points[i] - points[j], axis=1)


def coregionalisation(target: NDArray, shape: NDArray) -> NDArray:
    """Find positive semidefinite matrices B_l with the least squares of target_j - sum_l shape_jl B_l (Goulard and Voltz 1992).

    Args:
        target: (J, P, P) symmetric. shape: (J, L) correlations.

    Returns:
        (L, P, P).
    """
    found = np.zeros((shape.shape[1], *target.shape[1:]))
    rest = target.copy()
    for _ in range(SWEEPS):
        for number, own in enumerate(shape.T):
            rest += own[:, None, None] * found[number]
            values, vectors = np.linalg.eigh(np.tensordot(own, rest, 1) / (own**2).sum())
            found[number] = (vectors * np.maximum(values, 0)) @ vectors.T
            rest -= own[:, None, None] * found[number]
    return found


def _loadings(matrix: NDArray) -> NDArray:
    """(P, R) whose product with itself is nearest to a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return vectors[:, ::-1][:, :RANK] * np.sqrt(np.maximum(values[::-1][:RANK], 0))


def fit(rooms: list[Sampled], facts: dict[str, Any]) -> ErrorBank:
    """Make the bank of the errors of rooms.

    First the part that views share is fitted to the correlations between views, then the part of each view to what those within a
    view have in addition. Every variable is scaled to variance 1, so that the errors have exactly the measured quantiles.
    """
    truth, table = quantiles(rooms)
    n, none = len(LENGTHS), np.zeros((0, 0))
    bank = ErrorBank(truth, table, np.array(LENGTHS), none, none, none, none, facts)
    values = ((standardised(bank, room).reshape(len(room.view), -1), room.points, room.view) for room in rooms)
    found = correlations(values)
    known = np.isfinite(found.shape[:, 0])
    scores = np.where(known[:, None, None], of_scores(bank, rooms, found.mean), np.nan)
    between = known & (np.arange(len(known)) >= (len(known) + 1) // 2)
    within = known & ~between
    shared = coregionalisation(scores[between], found.shape[between])
    left = scores[within] - np.tensordot(found.shape[within], shared, 1)
    itself = np.eye(within.sum())[:, :1]
    own = coregionalisation(left, np.concatenate([found.shape[within], itself], 1))
    loadings = np.stack([_loadings(matrix) for matrix in (*shared, *own)])
    loadings /= np.sqrt((loadings**2).sum((0, 2)))[:, None]
    return ErrorBank(truth, table, bank.lengths, loadings[:n], loadings[n:-1], loadings[-1], found.of_channels(), facts)


def measure(files: list[Path], weights: evaluation.Weights) -> ErrorBank:
    """Make the bank from files of generated rooms (`lab.prior.captures`)."""
    rooms, seeds = [], []
    for path in files:
        seed = int(path.stem)
        found = sample(captures.load(path), weights, seed)
        if found is not None:
            rooms.append(found)
            seeds.append(seed)
    pixels = sum(len(room.view) for room in rooms)
    return fit(rooms, {"rooms": seeds, "pixels": pixels, "weights": weights.recipe.get("sha256", "")})
