"""The problem, the options and the result that every solver of the material fit shares (Eq. M.1, R.14).

The sixteen numbers of an object are ordered as in `iif_core.reflectance.material`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np

from iif_core.camera.response import Response
from iif_core.errors import InputError
from iif_core.fitting.predictions import PredictionErrors
from iif_core.numerics.rows import Rows

SHARED_LIGHT_ERROR = 0.12
"""Error of the light that all pixels of an object share, as a logarithm, and that no variation within the object shows, where the
misfit of the light is not known. It is added where the prior states its errors."""


@dataclass(frozen=True, kw_only=True)
class FitProblem(Rows):
    """Pixels of the fit; n pixels, J levels, h = 1 or 2 independent halves of the cache.

    Attributes:
        object_id: (n,) int in [0, n_objects); -1 is left out.
        n_objects: O.
        base: (n, 5) linear albedo, roughness, metallic of the base texture.
        diffuse: h arrays (n, 3), D of Eq. M.1; s0, s1: h arrays (n, J, 3), S0 and S1 at the levels.
        levels: (J,) roughness of the levels, increasing.
        value: (n, 3) sensor value f(e L); HDR: linear radiance.
        exposure: (n,) e.
        saturated: (n, 3) bool: `value` is a lower bound.
        cluster: (n,) int, pixels of an object with the same number share errors (see `clusters.patches`); None: 64 runs of the
            pixels of an object in their given order.
        scatter: (O,) of the logarithm of the brightness of each object over its predictions
            (`object_levels.prediction_scatter`); None: not known.
        given: (O, 2) roughness and metallic of objects that are known and not fitted, NaN = fitted; None: all are fitted. Only
            the direct solver knows them.
    """

    WHOLE: ClassVar[tuple[str, ...]] = ("levels", "scatter", "given")

    object_id: np.ndarray
    n_objects: int
    base: np.ndarray
    diffuse: tuple[np.ndarray, ...]
    s0: tuple[np.ndarray, ...]
    s1: tuple[np.ndarray, ...]
    levels: np.ndarray
    value: np.ndarray
    exposure: np.ndarray
    saturated: np.ndarray
    cluster: np.ndarray | None = None
    scatter: np.ndarray | None = None
    given: np.ndarray | None = None

    def __post_init__(self) -> None:
        n, j = len(self.object_id), len(self.levels)
        shapes = {"base": (n, 5), "value": (n, 3), "exposure": (n,), "saturated": (n, 3)}
        if self.given is not None:
            shapes["given"] = (self.n_objects, 2)
        if self.cluster is not None:
            shapes["cluster"] = (n,)
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"fit: {name} has shape {getattr(self, name).shape}, needed {shape}")
        if not 1 <= len(self.diffuse) <= 2 or not len(self.diffuse) == len(self.s0) == len(self.s1):
            raise InputError(f"fit: {len(self.diffuse)} halves of the cache, needed 1 or 2")
        for d, s0, s1 in zip(self.diffuse, self.s0, self.s1, strict=True):
            if d.shape != (n, 3) or s0.shape != (n, j, 3) or s1.shape != (n, j, 3):
                raise InputError(f"fit: shading of shapes {d.shape}, {s0.shape}, {s1.shape}, needed {(n, 3)}, {(n, j, 3)}")
        if j < 2 or np.any(np.diff(self.levels) <= 0):
            raise InputError("fit: needs at least two increasing roughness levels")


@dataclass(frozen=True)
class FitOptions:
    """How to fit.

    Attributes:
        iterations: largest number of Gauss-Newton steps of each descent.
        tolerance: a descent has converged when the objective is expected to fall, or fell in three steps, by less than this share
            of its size.
        robust_width: Cauchy width c of the residual in sensor units (Eq. M.7).
        min_pixels: objects with fewer usable pixels have no numbers of their own.
        free_response: fit the response parameters too.
        response_prior: mean (P,) and precision (P, P) of the response parameters, row by row, from their calibration; None: the
            start, with precision 1.
        response_ridge: weight lambda of that prior for each pixel (Eq. M.14). 1e-5 is the square of a residual of 0.05 over 250
            independent errors; errors of the shading are common to an object in a view, so the pixels are not independent.
        roughness_weight, metallic_weight: weights of |r - 1| and |m| in the mean squared error, 1e-3 and 5e-3 in the paper's loss
            (Eq. M.45).
        population: draw each object towards what the objects of the scene have in common (empirical Bayes).
        ridge: without population and selection, weight for each pixel of a prior at the identity.
        select: choose between dielectric and metal, and the local minimum of the roughness, by their evidence; otherwise start at
            the identity, with metallic free where its predicted mean exceeds `metallic_prior`.
        metals: with `select`, whether an object may be a metal.
        lobes: whether the photographs can show roughness and metal. Without specular lobes, roughness is the base roughness, or
            `MATTE_ROUGHNESS` where the base is smoother, and nothing is metal.
        metallic_prior: see `select`.
        base_tells_levels: the base is a second witness of the brightness of objects, next to the photographs.
        prediction_errors: how the predictions err that the base was made of; None: not known, and learnt from the scene.
        light_error: of the light on an object as a whole, as a logarithm; it counts where `prediction_errors` are known.
        texture_sigma: standard deviation of the albedo above which a direction of the texture counts.
        brightest: largest albedo in the fit. It exceeds 1 because in light that is a little too dim a white wall would otherwise
            be explained by a gloss that it does not have. Published albedos lie within [0, 1].
        threads: number of threads; the result does not depend on it.
    """

    iterations: int = 60
    tolerance: float = 1e-6
    robust_width: float = 0.1
    min_pixels: int = 20
    free_response: bool = True
    response_prior: tuple[np.ndarray, np.ndarray] | None = None
    response_ridge: float = 1e-5
    roughness_weight: float = 0.0
    metallic_weight: float = 0.0
    population: bool = True
    ridge: float = 2e-3
    select: bool = True
    metals: bool = True
    lobes: bool = True
    metallic_prior: float = 0.25
    base_tells_levels: bool = True
    prediction_errors: PredictionErrors | None = None
    light_error: float = SHARED_LIGHT_ERROR
    texture_sigma: float = 2.0 / 255.0
    brightest: float = 1.25
    threads: int = 1


@dataclass(frozen=True)
class Kinds:
    """What the evidence leaves open of each object: its kind, and what would go with another one.

    Attributes:
        probability: (O, 3) posterior of the rows of `selection.KINDS`.
        brightness: (O, 3) logarithm of the brightness of the albedo fitted to each kind, over that of the chosen one.
        roughness, deviation: (O, 3) posterior mean and standard deviation given each kind.
        seen: (O,) 1 - (variance of the roughness given the chosen kind) / (the same without the photographs), at least 0.
        witnesses: (O, 3) what speaks for a metal (`selection.metal_log_odds`); 0 where the prior does not state its errors.
    """

    probability: np.ndarray
    brightness: np.ndarray
    roughness: np.ndarray
    deviation: np.ndarray
    seen: np.ndarray
    witnesses: np.ndarray

    @classmethod
    def unknown(cls, n_objects: int) -> Kinds:
        """Return that nothing is known of any object."""
        return cls(*np.zeros((4, n_objects, 3)), np.zeros(n_objects), np.zeros((n_objects, 3)))

    def among(self, members: np.ndarray, n_objects: int) -> Kinds:
        """Return the same for all objects, of which these are the `members`; nothing is known of the others."""
        out = Kinds.unknown(n_objects)
        for f in fields(self):
            getattr(out, f.name)[members] = getattr(self, f.name)
        return out


@dataclass(frozen=True, kw_only=True)
class FitResult:
    """Result of a solver.

    Attributes:
        affine: (O, 16) float64 numbers of the objects.
        covariance: (O, 16, 16) of these numbers (Eq. M.38), from the direct solver with the error of the light on each object;
            0 for numbers that were not fitted.
        free: (O, 16) bool, which numbers were fitted.
        pixels: (O,) int, usable pixels.
        residual: (O,) root mean square of f(e L) - I over unsaturated channels, in sensor units (HDR: in units of the curve of
            Eq. M.3); 0 without pixels.
        model: O strings, e.g. `gain+bias, roughness` or `identity (12 pixels)`.
        response: the fitted response.
        light_scale: factor on the light that goes with the albedos (1 unless a gauge was applied).
        history: objective after each step of the last descent, never rising.
        converged: whether the last descent met `FitOptions.tolerance`.
        response_covariance: (P, P) of the response parameters, channel by channel.
        iterations: steps of the last descent; reason: why it ended.
        facts: further numbers for `affines.json`.
        light_gain: (O,) factor by which the light on each object is believed to be brighter than computed (Eq. M.36); None: 1.
        kinds: what the selection left open; None: nothing was selected.
    """

    affine: np.ndarray
    covariance: np.ndarray
    free: np.ndarray
    pixels: np.ndarray
    residual: np.ndarray
    model: list[str]
    response: Response
    light_scale: float
    history: list[float]
    converged: bool
    response_covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    iterations: int = 0
    reason: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    light_gain: np.ndarray | None = None
    kinds: Kinds | None = None


def albedo_uncertainty(
    affine: np.ndarray, covariance: np.ndarray, object_id: np.ndarray, base: np.ndarray, base_deviation: np.ndarray
) -> np.ndarray:
    """Propagate the covariances of the fit and of the base texture to the fitted albedo.

    Args:
        affine: (O, 16) numbers; covariance: (O, 16, 16) of the numbers.
        object_id: (n,) int, -1 = no fit; base: (n, 5); base_deviation: (n, 3) standard deviation of the base albedo.

    Returns:
        (n,) float64 standard deviation, mean over the channels; at most 0.5, because no distribution on [0, 1] has a larger one.
    """
    known = object_id >= 0
    o = np.where(known, object_id, 0)
    # (b, 1) of each pixel: channel c of the albedo is one . theta_c, theta_c the channel's row of [A | b].
    one = np.concatenate([np.asarray(base, np.float64)[:, :3], np.ones((len(base), 1))], 1)
    variance = np.asarray(base_deviation, np.float64) ** 2
    if len(affine):
        spread = variance.copy()
        for c in range(3):
            rows = slice(4 * c, 4 * c + 4)
            # First order in both errors, taken as independent: (b, 1)' Cov(theta_c) (b, 1) from the numbers, and A_c carries the
            # variances of the base. Its channels count as uncorrelated.
            fit = np.einsum("ni,nij,nj->n", one, covariance[:, rows, rows][o], one)
            through = (affine[:, 4 * c : 4 * c + 3][o] ** 2 * spread).sum(1)
            variance[:, c] = np.where(known, np.maximum(fit, 0) + through, spread[:, c])
    return np.minimum(np.sqrt(variance), 0.5).mean(1)
