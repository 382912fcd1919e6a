"""Options of the fusion: what is fused, and how the direct solver solves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from numpy.typing import NDArray

from iif_core.numerics import laplace


@dataclass(frozen=True)
class CellOptions:
    """How predictions are put on surface cells.

    Attributes:
        predictions: only the first so many of each view; None = all.
        cell_edge: edge of a cell in m; None = `cell_footprints` median pixel footprints.
        border_weight: weight of pixels next to another object: real predictions bleed across borders.
        footprint_power: pixels weigh (median footprint / own footprint) to this power, which prefers near and frontal views.
    """

    predictions: int | None = None
    cell_edge: float | None = None
    cell_footprints: float = 0.4
    border_weight: float = 0.1
    footprint_power: float = 0.0


@dataclass(frozen=True)
class FusionOptions:
    """How the direct solver solves.

    Attributes:
        sweeps: number of alternations.
        temperature, anneal, final_temperature: selection temperature of the first sweep in units of the segment's
            median error, factor on it per sweep, and its lower end (Eq. F.29). A final temperature above 0 averages
            predictions that are nearly as good as the best one; 0 takes the best one alone.
        ridge: strength of the ridge towards the identity map, relative to the segment's weight; it grows for segments
            of fewer than `ridge_pixels` pixels (Eq. F.26).
        clip_share, clip_pixels: predicted albedo of exactly 0 or 1 is left out of the fit of the albedo map where it
            makes up at most this share of the segment and at least so many pixels remain.
        scale_floor: smallest Laplace scale.
        single_view_weight: weight in the fit of the maps of cells that one viewpoint sees (Eq. F.24); must not be 0.
        seams: close seams between the parts of an object (needs `FusionProblem.neighbours`).
        memory: bytes of predictions that stay in memory between sweeps.
        spill: puts an array where it takes no memory, such as into a mapped file, and returns it from there; it gets the
            predictions of the views beyond `memory`. None = these views are read again every time.
    """

    sweeps: int = 9
    temperature: float = 1.0
    anneal: float = 0.6
    ridge: float = 0.01
    ridge_pixels: float = 30.0
    clip_share: float = 0.5
    clip_pixels: int = 50
    scale_floor: float = laplace.SCALE_FLOOR
    memory: int = 1 << 30
    spill: Callable[[NDArray], NDArray] | None = None
    final_temperature: float = 0.1
    seams: bool = True
    single_view_weight: float = 0.01
