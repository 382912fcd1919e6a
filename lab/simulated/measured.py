"""Errors of the learned prior as they were measured, drawn again for any scene (lab/docs/simulated.md#measured).

A bank holds what is needed to draw them: quantiles of the errors given the true value, and a linear model of coregionalisation of
their normal scores over distance, samples, quantities and views. `python -m lab.prior residuals` makes it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from lab.simulated.fields import Field, pixel_normal, tag

BANK = Path(__file__).with_name("measured_errors.npz")
"""The bank of the prior that ships."""
CHANNELS = ("log albedo", "hue R/G", "hue B/G", "roughness", "metallic")
DARKEST = 0.01
"""Albedo from which logarithms are taken, as the learned prior does."""
SCORES = np.linspace(-3, 3, 25)
"""Normal scores of the quantiles."""


@dataclass(frozen=True)
class ErrorBank:
    """Errors of K predictions in C = 5 channels (`coded`): P = K C variables, the first C of which are of the first prediction.

    Attributes:
        truth: (C, B) ascending true values for which there are quantiles; between them they are interpolated.
        quantiles: (C, B, K, Q) errors (prediction - truth) at `SCORES`.
        lengths: (L,) correlation lengths in metres of the fields; infinity = one value for the scene.
        shared: (L, P, R) loadings of the fields that all views share. own: (L, P, R) of those that each view has for itself.
        pixel: (P, R) loadings of noise that each pixel has for itself.
        correlation: (2, 2, J, C) as it was measured, of errors standardised given the true value, by class of distance: within a
            view or between views, of a sample with itself or with others. Nothing is drawn from it.
        facts: how the bank was made.
    """

    truth: NDArray
    quantiles: NDArray
    lengths: NDArray
    shared: NDArray
    own: NDArray
    pixel: NDArray
    correlation: NDArray
    facts: dict[str, Any]

    @property
    def samples(self) -> int:
        """K, the largest number of predictions."""
        return self.quantiles.shape[2]

    def moments(self) -> tuple[NDArray, NDArray]:
        """Return mean and standard deviation (C, B, K) of the errors at `truth`: those of `quantiles` under normal scores."""
        z, weight = normal_grid()
        values = self.at_scores(z)
        mean = values @ weight
        return mean, np.sqrt((values - mean[..., None]) ** 2 @ weight)

    def at_scores(self, z: NDArray) -> NDArray:
        """Return the errors (C, B, K, n) at `truth` that have the normal scores z (n,)."""
        return np.apply_along_axis(lambda q: np.interp(z, SCORES, q), -1, self.quantiles)

    def save(self, path: Path) -> None:
        """Write the bank in half precision."""
        arrays = {f.name: np.asarray(getattr(self, f.name), np.float16) for f in fields(self) if f.name != "facts"}
        np.savez_compressed(path, **arrays, facts=np.array(json.dumps(self.facts)))

    def scores(self, points: NDArray, view: int, seed: int) -> NDArray:
        """Draw the normal scores (n, K, C) float32 of the errors at points (n, 3) in metres that a view shows (Eq. P.32)."""
        variables, rank = self.pixel.shape
        component = np.arange(rank)
        total = pixel_normal((len(points), rank), seed, tag("measured/pixel"), view) @ self.pixel.T
        for number, length in enumerate(self.lengths):
            field = Field(points, float(length), seed, tag("measured/waves"), number)
            total += field(seed, tag("measured/shared"), number, component) @ self.shared[number].T
            total += field(seed, tag("measured/own"), number, view, component) @ self.own[number].T
        return total.reshape(len(points), variables // len(CHANNELS), len(CHANNELS))

    def errors(self, truth: NDArray, scores: NDArray) -> NDArray:
        """Return the errors (n, K, C) that have these normal scores where the coded truth is (n, C) (Eq. P.31)."""
        at = (np.clip(scores, SCORES[0], SCORES[-1]) - SCORES[0]) / (SCORES[1] - SCORES[0])
        low = np.minimum(at.astype(int), len(SCORES) - 2)
        k = np.arange(scores.shape[1])
        out = np.empty(scores.shape, np.float32)
        for c, table in enumerate(self.quantiles):
            bin_, share = self.between(c, truth[:, c])
            above = np.minimum(bin_ + 1, table.shape[0] - 1)
            q = low[..., c]
            inner = at[..., c] - q
            near, far = ((1 - inner) * table[b[:, None], k, q] + inner * table[b[:, None], k, q + 1] for b in (bin_, above))
            out[..., c] = near + share[:, None] * (far - near)
        return out

    def between(self, channel: int, truth: NDArray) -> tuple[NDArray, NDArray]:
        """Return for true values (n,) the row of the quantiles below, and how far they lie towards the next one, 0 to 1."""
        nodes = self.truth[channel]
        at = np.interp(truth, nodes, np.arange(len(nodes)))
        low = np.minimum(at.astype(int), max(len(nodes) - 2, 0))
        return low, at - low


def normal_grid() -> tuple[NDArray, NDArray]:
    """Return normal scores (401,) and the probability that each stands for."""
    from scipy.special import ndtr

    z = np.linspace(-4, 4, 401)
    edges = ndtr((z[1:] + z[:-1]) / 2)
    return z, np.diff(edges, prepend=0, append=1)


@lru_cache(1)
def bank(path: Path = BANK) -> ErrorBank:
    """Read a bank; raises InputError if the file is missing."""
    if not path.is_file():
        raise InputError(f"{path} is missing: the measured errors of the prior; `python -m lab.prior residuals` makes it")
    with np.load(path) as file:
        arrays = {f.name: file[f.name].astype(np.float32) for f in fields(ErrorBank) if f.name != "facts"}
        return ErrorBank(**arrays, facts=json.loads(str(file["facts"])))


def draw_predictions(
    truth: NDArray, points: NDArray, samples: int, view: int, seed: int, strength: float = 1.0, errors: ErrorBank | None = None
) -> NDArray:
    """Draw K predictions of a view with the measured errors of the learned prior.

    Args:
        truth: (H, W, 5) linear albedo, perceptual roughness, metallic.
        points: (H, W, 3) surface in metres; not finite = none.
        samples: K, at most those of the bank.
        view, seed: any integers; equal ones give equal errors.
        strength: factor on the errors, 0 to 4.
        errors: the bank; None = that of the prior that ships.

    Returns:
        (K, H, W, 5) float32 in [0, 1].

    Raises:
        InputError: too many samples, shapes that do not match, truth that is not finite.
    """
    errors = errors or bank()
    shape = np.shape(truth)[:-1]
    if not 1 <= samples <= errors.samples or not 0 <= strength <= 4:
        raise InputError(
            f"simulated prior, measured errors: samples {samples} (1 to {errors.samples}), strength {strength} (between 0 and 4)"
        )
    if np.shape(truth)[-1:] != (5,) or np.shape(points) != (*shape, 3) or not np.isfinite(truth).all():
        raise InputError(
            f"simulated prior, measured errors: truth {np.shape(truth)} is not finite, or not at points {np.shape(points)}"
        )
    flat = np.reshape(truth, (-1, 5)).astype(np.float32)
    if strength == 0 or not flat.size:
        return np.repeat(np.clip(flat, 0, 1).reshape(1, *shape, 5), samples, 0)
    own = coded(flat)
    drawn = errors.errors(own, errors.scores(np.reshape(points, (-1, 3)), view, seed)[:, :samples])
    made = decoded(own[:, None] + np.float32(strength) * drawn)
    return np.moveaxis(made, 1, 0).reshape(samples, *shape, 5)


def coded(materials: NDArray) -> NDArray:
    """Turn (..., 5) linear albedo, roughness and metallic into mean log albedo, log R/G, log B/G, roughness and metallic."""
    log = np.log(np.maximum(materials[..., :3], DARKEST))
    hues = log[..., [0, 2]] - log[..., 1:2]
    return np.concatenate([log.mean(-1, keepdims=True), hues, materials[..., 3:]], -1)


def decoded(values: NDArray) -> NDArray:
    """Invert `coded`, and clamp to [0, 1]."""
    green = values[..., :1] - values[..., 1:3].sum(-1, keepdims=True) / 3
    log = np.concatenate([green + values[..., 1:2], green, green + values[..., 2:3]], -1)
    return np.clip(np.concatenate([np.exp(np.minimum(log, 0)), values[..., 3:]], -1), 0, 1, dtype=np.float32)
