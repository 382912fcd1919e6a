"""Options of the paper's optimiser: every fragile choice of the published behaviour has its own (METHOD 5)."""

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
    """How to solve; defaults are the safe choices, in brackets the published ones.

    Attributes:
        texture: `cells` = one row of ten raw outputs a cell; `hashgrid` = iif_core.fusion.hashgrid at the surface points (needs
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
