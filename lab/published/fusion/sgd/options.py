"""Options of the paper's optimiser: one for every choice of the published behaviour that is numerically fragile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from iif_core.numerics import laplace
from lab.published.fusion.hashgrid.levels import HashGridOptions


@dataclass(frozen=True)
class SgdOptions:
    """How to solve. The defaults are the safe choices; the published ones follow in brackets where they differ.

    Attributes:
        texture: `cells` = one row of ten raw outputs per cell; `hashgrid` = a function of the surface points (needs
            `FusionProblem.point`) [hashgrid].
        grid: shape of the hash grid; None = the paper's.
        batch: pixels per step, fewer if the problem has fewer.
        epochs: passes over the pixels if `iterations` is None.
        iterations: steps; None = as many as whole batches fit into `epochs` passes [None].
        learning_rate: of texture, affine maps and logits. lr_schedule: halved at 20, 40, 60, 80 % of the steps
            (`fraction`) or after 2, 4, 6, 8 of `epochs` equal parts of the steps (`epochs`) [epochs].
        temperature: of logits and errors at the start. anneal: factor on it, applied 81 times evenly over the steps
            (`fraction`, Eq. F.61) or every 100 steps (`steps`, Eq. F.17, whose last temperature depends on the size of the
            scene) [steps].
        temperature_floor: smallest temperature (docs/method/numerics.md#cold-temperatures) [0].
        data_weight, label_weight, regulariser: weights of the terms (Eq. F.16).
        scale_floor, scale_floor_kind: the texture's scale s becomes max(s, floor) (`hard`, no gradient below) or
            sqrt(s^2 + floor^2) (`smooth`, docs/method/numerics.md#laplace-scale-at-zero) [hard]. b_ref is always
            max(b_ref, floor).
        median_gradient: follow the derivative of b_ref, which reaches one arbitrary prediction
            (docs/method/numerics.md#median-subgradient) [True].
        clamp_gradient: gradient of corrected values outside [low, 1]: none (`dead`), or that which leads back inside
            (`inward`, docs/method/numerics.md#gradients-at-clamps) [dead]. The loss is the same.
        choice: `argmin` = after `choose_at` of the steps the prediction with the smallest mean L1 error over the segment is
            chosen per property, and the other steps fit texture and maps to it; `soft` = softmax to the end [soft].
        init: start of `cells`: mean and spread of all predictions of the cell (`mean`), or raw outputs 0, which are values
            of 0.5 (`paper`) [paper].
        jitter: draw points within the pixel if the problem has tangents, for `hashgrid` alone (Eq. F.60) [True].
        seed: of the order of the pixels, the jitter and the network.
        memory: bytes that the predictions may take; records: entries of the history.
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
    choice: str = "argmin"
    choose_at: float = 0.5
    init: str = "mean"
    jitter: bool = False
    seed: int = 0
    memory: int = 8 << 30
    records: int = 200


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


_SAFE_GRID = {"levels": 16, "log2_entries": 17}


def preset_grid(preset: str, levels: int | None = None, log2_entries: int | None = None) -> HashGridOptions:
    """Return the hash grid of a preset, 16 levels of 2^17 entries with `safe` and the published size with `paper`; sizes
    that are given replace the preset's."""
    sizes = {} if preset == "paper" else dict(_SAFE_GRID)
    sizes |= {name: x for name, x in (("levels", levels), ("log2_entries", log2_entries)) if x is not None}
    return HashGridOptions(**sizes)


def sgd_options(preset: str = "safe", **changes: Any) -> SgdOptions:
    """Return the options of a preset, `safe` or `paper` (the published behaviour), with changes.

    Preset `paper` does not reproduce rays that miss the mesh, coordinates in [-1, 1] and half precision.
    """
    return SgdOptions(**{**{"safe": {}, "paper": _PAPER}[preset], **changes})
