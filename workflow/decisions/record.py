"""The record of a decision, as `plan.yaml` shows it."""

from __future__ import annotations

from typing import Any

import numpy as np

Decision = dict[str, Any]


def decision(component: str, included: bool, measure: str, value: float, threshold: float, reason: str) -> Decision:
    """Return `{component, included, measure, value, threshold, reason}` in plain Python values; a value that is not
    finite is 0."""
    finite = float(value) if np.isfinite(value) else 0.0
    return {
        "component": component,
        "included": bool(included),
        "measure": measure,
        "value": round(finite, 6),
        "threshold": float(threshold),
        "reason": reason,
    }
