"""Options of the paper's optimiser: one for every choice of the published behaviour that is numerically fragile."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from iif_core.errors import InputError
from iif_core.fusion.hashgrid.levels import HashGridOptions
from iif_core.numerics import laplace

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
    """How to solve. The defaults are the safe choices; the published ones follow in brackets where they differ.

    Attributes:
        texture: `cells` = one row of ten raw outputs per cell; `hashgrid` = a function of the surface points (needs
            `FusionProblem.point`) [hashgrid].
        grid: shape of the hash grid; None = the paper's.
        batch: pixels per step, fewer if the problem has fewer.
        epochs: passes over the pixels if `iterations` is None.
        iterations: steps; None = as many as whole batches fit into `epochs` passes [None].
        learning_rate: of texture, affine maps and logits. lr_schedule: halved at 20, 40, 60, 80 % of the steps
            (`fraction`) or after 2, 4, 6, 8 epochs (`epochs`) [epochs].
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
        logits: alpha = softmax(z / tau) (`scaled`), or softmax(z) with tau in the errors alone (`direct`,
            docs/method/numerics.md#logits-divided-by-a-temperature).
        choice: `argmin` = after `choose_at` of the steps the prediction with the smallest mean L1 error over the segment is
            chosen per property, and the other steps fit texture and maps to it; `soft` = softmax to the end [soft].
        init: start of `cells`: mean and spread of all predictions of the cell (`mean`), or raw outputs 0, which are values
            of 0.5 (`paper`) [paper].
        jitter: draw points within the pixel if the problem has tangents, for `hashgrid` alone (Eq. F.60) [True].
        weighted: pixels count by `FusionProblem.weight` instead of 1 each.
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

    Raises:
        InputError: an unknown preset or a value that is not allowed.
    """
    presets: dict[str, dict[str, Any]] = {"safe": {}, "paper": _PAPER}
    if preset not in presets:
        raise InputError(f"base sgd: preset {preset!r}; allowed: {', '.join(presets)}")
    return SgdOptions(**{**presets[preset], **changes})
