"""Array namespaces: one set of elementwise functions for NumPy, Dr.Jit and torch.

`NUMPY`, `DRJIT` and `TORCH` are attributes of this module; each library is imported when its namespace is first used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Namespace:
    """Elementwise functions of one array library. Python scalars may be mixed with arrays and do not change their dtype."""

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


def _namespace(library: Any, **renamed: Callable) -> Namespace:
    """Collect the functions that `library` offers under the same names; `renamed` gives those it calls differently."""
    names = [entry.name for entry in fields(Namespace) if entry.name not in ("name", "pi", *renamed)]
    return Namespace(library.__name__, **{name: getattr(library, name) for name in names}, **renamed)


def _numpy() -> Namespace:
    return _namespace(np, acos=np.arccos, atan2=np.arctan2)


def _drjit() -> Namespace:
    import drjit as dr

    return _namespace(dr, where=dr.select)


def _torch() -> Namespace:
    import torch

    def extremum(of_tensors, clamp_with):
        def apply(a, b):
            if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
                return of_tensors(a, b)
            return clamp_with(a, b) if isinstance(a, torch.Tensor) else clamp_with(b, a)

        return apply

    return _namespace(
        torch,
        maximum=extremum(torch.maximum, lambda tensor, scalar: torch.clamp(tensor, min=scalar)),
        minimum=extremum(torch.minimum, lambda tensor, scalar: torch.clamp(tensor, max=scalar)),
    )


_MAKERS = {"NUMPY": _numpy, "DRJIT": _drjit, "TORCH": _torch}


def __getattr__(name: str) -> Namespace:
    if name not in _MAKERS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    namespace = _MAKERS[name]()
    globals()[name] = namespace
    return namespace
