"""How the direct solver is to solve."""

from __future__ import annotations

from dataclasses import dataclass

from iif_core.errors import InputError
from iif_core.numerics import laplace

VARIANTS = ("full", "uniform", "texel_mean", "object_mean")
OBJECTIVES = ("least_squares", "distribution")


@dataclass(frozen=True)
class BaseOptions:
    """How to solve.

    Attributes:
        variant: `full`; `uniform` = corrections, but all predictions alike (no selection); `texel_mean` = mean of all
            predictions a cell; `object_mean` = mean of all predictions an object.
        sweeps: alternations.
        temperature, anneal, final_temperature: selection temperature of the first sweep, in units of the segment's
            median error, its factor per sweep, and where it stops. At the default 0.1 a prediction whose error exceeds
            the best by a tenth of the median has 1/e of its weight: averaging near-ties is worth 0.7-1.4 dB over
            the single best one (0).
        ridge: pull of T to identity, times the segment's weight in the fit; more for segments below `ridge_pixels` pixels.
        robust: cells take the M-estimate of the Laplace divergence instead of the mean.
        clip_share, clip_pixels: predicted albedo at exactly 0 or 1 is left out of the fit of T where at most this
            share of the segment is, and at least so many pixels remain.
        scale_floor: smallest Laplace scale.
        objective: `least_squares`, or `distribution`: afterwards `polish` sweeps on the paper's loss, hard selection.
        alone: weight in the fit of T of cells that one viewpoint sees (1 - 1/n + this for n viewpoints); must not be 0.
        seams: close seams between parts of an object (needs `BaseProblem.neighbours`).
        memory: bytes of predictions that may stay in memory between sweeps; the others are read again.
    """

    variant: str = "full"
    sweeps: int = 9
    temperature: float = 1.0
    anneal: float = 0.6
    ridge: float = 0.01
    ridge_pixels: float = 30.0
    robust: bool = False
    clip_share: float = 0.5
    clip_pixels: int = 50
    scale_floor: float = laplace.SCALE_FLOOR
    memory: int = 1 << 30
    final_temperature: float = 0.1
    objective: str = "least_squares"
    polish: int = 20
    seams: bool = True
    alone: float = 0.01

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise InputError(f"base variant {self.variant!r}; allowed: {', '.join(VARIANTS)}")
        if self.objective not in OBJECTIVES:
            raise InputError(f"base objective {self.objective!r}; allowed: {', '.join(OBJECTIVES)}")
        if self.final_temperature < 0 or self.temperature < self.final_temperature or self.polish < 1:
            raise InputError(
                f"base options: temperature {self.temperature} must not be below final_temperature {self.final_temperature}"
                f" (>= 0), polish {self.polish} must be >= 1"
            )
        if self.sweeps < 1 or not self.ridge > 0 or not 0 < self.anneal < 1 or not self.alone > 0:
            raise InputError(
                f"base options: sweeps {self.sweeps} (>= 1), ridge {self.ridge} (> 0), anneal {self.anneal} (between 0 and 1),"
                f" alone {self.alone} (> 0)"
            )
