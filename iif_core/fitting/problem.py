"""What is fitted and to what: the problem, the options and the result that every solver shares (METHOD 2.8, 7b).

The order of the sixteen numbers of an object: A and b row by row [A00 A01 A02 b0 A10 ...], then (g_r, h_r), then
(g_m, h_m); a = A a~ + b, r = g_r r~ + h_r, m = g_m m~ + h_m.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from iif_core.camera.response import Response
from iif_core.errors import InputError
from iif_core.reflectance.brdf import R_MIN

PARAMETERS = 16

IDENTITY = np.r_[np.eye(3, 4).ravel(), 1.0, 0.0, 1.0, 0.0]
GAINS = np.array([0, 5, 10])
BIASES = np.array([3, 7, 11])
CROSS = np.array([1, 2, 4, 6, 8, 9])
ROUGHNESS = np.array([12, 13])
METALLIC = np.array([14, 15])
MATTE = np.array([0.0, 1.0, 0.0, 0.0])
"""The last four numbers of a matte object."""
LOW = np.array([0.0, 0.0, 0.0, R_MIN, 0.0])
SOLVERS = ("direct", "sgd", "adam")


@dataclass(frozen=True)
class FitProblem:
    """Pixels of the fit; n pixels, J levels, h = 1 or 2 independent halves of the cache.

    Attributes:
        object_id: (n,) int in [0, n_objects); -1 is left out.
        n_objects: O.
        base: (n, 5) albedo, roughness, metallic of the base texture.
        diffuse: h arrays (n, 3); s0, s1: h arrays (n, J, 3), shading of METHOD 2.7.
        levels: (J,) roughness of the levels, increasing.
        value: (n, 3) sensor value f(e L).
        exposure: (n,) e.
        saturated: (n, 3) bool: `value` is a lower bound.
        cluster: (n,) int, pixels of an object with the same number share errors (see `patches`); None = 64 runs of an object's
            pixels as they come.
    """

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

    def __post_init__(self) -> None:
        n, j = len(self.object_id), len(self.levels)
        shapes = {"base": (n, 5), "value": (n, 3), "exposure": (n,), "saturated": (n, 3)}
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

    def take(self, index: np.ndarray | slice) -> FitProblem:
        """Some of the pixels."""
        changed: dict[str, Any] = {}
        for name, value in self.__dict__.items():
            if name in ("n_objects", "levels") or value is None:
                continue
            changed[name] = tuple(part[index] for part in value) if isinstance(value, tuple) else value[index]
        return replace(self, **changed)

    def merged(self) -> FitProblem:
        """The same with the mean of the halves as the only one: what the paper's loss sees."""
        if len(self.diffuse) == 1:
            return self
        means = {
            name: (0.5 * (getattr(self, name)[0] + getattr(self, name)[1]),)  # keeps the type of the cache
            for name in ("diffuse", "s0", "s1")
        }
        return replace(self, **means)


@dataclass(frozen=True)
class FitOptions:
    """How to fit.

    Attributes:
        iterations: most Gauss-Newton steps of each descent; a descent ends when the step would move nothing (see
            `tolerance`).
        tolerance: converged when the objective is expected to fall, or fell in three steps, by less than this share: far
            below what moves a number by its standard error.
        robust_width: Cauchy width of the residual in sensor units.
        min_pixels: objects with fewer keep the population's gain and nothing else of their own.
        free_response: fit the response parameters too.
        response_prior: mean (P,) and precision (P, P) of the response parameters, row by row, from their calibration.
            None: the start, and precision one.
        response_ridge: weight of that prior per pixel. 1e-5 is a residual of 0.05 squared over 250 independent errors:
            those of the shading go together over an object in a view, so pixels are no measure of what is known.
            RMS of the curve before and after the joint fit, worst channel, in per cent of the range: built-in kitchen 0.47
            and 0.59, Country Kitchen 0.60 and 0.62; with precision one instead of the calibration's 4.6 and 8.7.
        roughness_weight, metallic_weight: of |r - 1| and |m| in the mean squared error, as in the paper's loss (1e-3, 5e-3
            there); 0 here, because the population decides (`population`).
        population: pull each object towards what the well-determined objects of the scene have in common, as strongly as
            they agree (empirical Bayes); otherwise `ridge` pulls to the identity.
        ridge: pull to the identity per pixel, without `population`.
        select: choose dielectric or metal and the valley of the roughness by their evidence; otherwise descend from the
            identity with metalness free where it was predicted above `metallic_prior`.
        metallic_prior: see `select`.
        matte: no gloss at all: roughness 1 and no metal, not fitted.
        texture_sigma: standard deviation (albedo) above which a direction of the texture is real (2 / 255).
        brightest: largest albedo in the fit, above 1 because the light is not known that well: a white wall in light that is a
            little too dim could show what it shows only by a gloss that it does not have. Albedos are published within [0, 1].
        threads: of the compiled loops; the result does not depend on it.
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
    metallic_prior: float = 0.25
    matte: bool = False
    texture_sigma: float = 2.0 / 255.0
    brightest: float = 1.25
    threads: int = 1


@dataclass(frozen=True)
class FitResult:
    """Result of a solver.

    Attributes:
        affine: (O, 16) float64.
        covariance: (O, 16, 16): sandwich over clusters of pixels that share errors, with the spread of the population where
            an object leans on it, and with the error of the response; 0 for fixed numbers.
        free: (O, 16) bool, which numbers were fitted.
        pixels: (O,) int, pixels in the fit.
        residual: (O,) root mean square of f(e L) - I in sensor units over unsaturated channels (HDR: in units of the
            logarithmic tone curve of the fit); 0 without pixels.
        model: O strings, e.g. `gain+bias, roughness`; `identity (12 pixels)`.
        response: the fitted response; response_covariance: (P, P) of its parameters, channel by channel.
        light_scale: light must be multiplied by this to go with the albedos (1 unless a gauge was set).
        history: objective after each step of the last descent, never rising.
        converged: the last descent met `FitOptions.tolerance`.
        iterations: steps of the last descent.
        reason: why the last descent ended.
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


def raw_values(affine: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Affine without clamping: affine (n, 16), base (n, 5) -> (n, 5)."""
    a = np.einsum("nci,ni->nc", affine[:, :12].reshape(-1, 3, 4)[:, :, :3], base[:, :3]) + affine[:, BIASES]
    r = affine[:, 12] * base[:, 3] + affine[:, 13]
    m = affine[:, 14] * base[:, 4] + affine[:, 15]
    return np.concatenate([a, r[:, None], m[:, None]], 1)


def apply_affines(affine: np.ndarray, object_id: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Materials of base values: (n, 5) float64, albedo and metallic clamped to [0, 1], roughness to [0.02, 1].

    Args:
        affine: (O, 16); object_id: (n,), -1 keeps the base (clamped); base: (n, 5).
    """
    own = np.broadcast_to(IDENTITY, (len(base), PARAMETERS))
    if len(affine):
        own = np.where((object_id >= 0)[:, None], affine[object_id], IDENTITY)
    return np.clip(raw_values(own, np.asarray(base, np.float64)), LOW, 1.0)


def albedo_uncertainty(
    affine: np.ndarray, covariance: np.ndarray, object_id: np.ndarray, base: np.ndarray, base_deviation: np.ndarray
) -> np.ndarray:
    """Standard deviation of the fitted albedo, mean over the channels: (n,) float64.

    Adds the fit's covariance at the base colour and the base's own standard deviation through A.

    Args:
        affine: (O, 16); covariance: (O, 16, 16); object_id: (n,), -1 = no fit; base: (n, 5); base_deviation: (n, 3).
    """
    known = object_id >= 0
    o = np.where(known, object_id, 0)
    one = np.concatenate([np.asarray(base, np.float64)[:, :3], np.ones((len(base), 1))], 1)
    variance = np.asarray(base_deviation, np.float64) ** 2
    if len(affine):
        spread = variance.copy()
        for c in range(3):
            rows = slice(4 * c, 4 * c + 4)
            fit = np.einsum("ni,nij,nj->n", one, covariance[:, rows, rows][o], one)
            through = (affine[:, 4 * c : 4 * c + 3][o] ** 2 * spread).sum(1)
            variance[:, c] = np.where(known, np.maximum(fit, 0) + through, spread[:, c])
    return np.sqrt(variance).mean(1)
