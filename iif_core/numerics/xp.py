"""One namespace for three array libraries, so that a formula is written once and tested across all of them.

`NUMPY`, `DRJIT` and `TORCH` offer the same few elementwise functions; the two heavy ones are imported when
first asked for. Comparisons and arithmetic are the operators of the arrays themselves.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Namespace:
    """Elementwise functions of one array library; Python scalars are allowed beside arrays and never widen
    them."""

    name: str
    sqrt: Callable[[Any], Any]
    exp: Callable[[Any], Any]
    log: Callable[[Any], Any]
    abs: Callable[[Any], Any]
    sin: Callable[[Any], Any]
    cos: Callable[[Any], Any]
    floor: Callable[[Any], Any]
    maximum: Callable[[Any, Any], Any]
    minimum: Callable[[Any, Any], Any]
    where: Callable[[Any, Any, Any], Any]
    acos: Callable[[Any], Any]
    atan2: Callable[[Any, Any], Any]
    pi: float = math.pi


def _numpy() -> Namespace:
    return Namespace(
        "numpy",
        np.sqrt,
        np.exp,
        np.log,
        np.abs,
        np.sin,
        np.cos,
        np.floor,
        np.maximum,
        np.minimum,
        np.where,
        np.arccos,
        np.arctan2,
    )


def _drjit() -> Namespace:
    import drjit as dr

    return Namespace(
        "drjit",
        dr.sqrt,
        dr.exp,
        dr.log,
        dr.abs,
        dr.sin,
        dr.cos,
        dr.floor,
        dr.maximum,
        dr.minimum,
        dr.select,
        dr.acos,
        dr.atan2,
    )


def _torch() -> Namespace:
    import torch

    def extremum(of_tensors, clamp_with):
        def apply(a, b):
            if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
                return of_tensors(a, b)
            return clamp_with(a, b) if isinstance(a, torch.Tensor) else clamp_with(b, a)

        return apply

    return Namespace(
        "torch",
        torch.sqrt,
        torch.exp,
        torch.log,
        torch.abs,
        torch.sin,
        torch.cos,
        torch.floor,
        extremum(torch.maximum, lambda tensor, scalar: torch.clamp(tensor, min=scalar)),
        extremum(torch.minimum, lambda tensor, scalar: torch.clamp(tensor, max=scalar)),
        torch.where,
        torch.acos,
        torch.atan2,
    )


_MAKERS = {"NUMPY": _numpy, "DRJIT": _drjit, "TORCH": _torch}


def __getattr__(name: str) -> Namespace:
    if name not in _MAKERS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    namespace = _MAKERS[name]()
    globals()[name] = namespace
    return namespace
