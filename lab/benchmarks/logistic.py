"""Logistic regression over rooms with truth: the numbers of odds, their errors, and whether the probabilities hold elsewhere."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

Array = np.ndarray

FOLDS, DRAWS = 7, 100
_RIDGE = 0.01  # keeps the numbers finite where both answers are apart
CLAIMS = (0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)
"""Limits of the classes of claimed probability."""


def fitted(columns: Array, truth: Array) -> Array:
    """Return the constant and the numbers (k + 1,) of the columns (n, k) for truths (n,) bool; every row counts alike."""
    with_constant = np.column_stack([np.ones(len(truth)), columns])
    sign = np.where(truth, 1.0, -1.0)

    def loss(numbers: Array) -> tuple[float, Array]:
        margin = sign * (with_constant @ numbers)
        wrong = np.exp(-np.logaddexp(0.0, margin))  # probability of the other answer
        pull = _RIDGE * np.r_[0.0, numbers[1:]]
        return np.logaddexp(0.0, -margin).sum() + 0.5 * pull @ numbers, pull - with_constant.T @ (sign * wrong)

    return np.asarray(minimize(loss, np.zeros(with_constant.shape[1]), jac=True, method="L-BFGS-B").x)


def log_odds(columns: Array, numbers: Array) -> Array:
    """Return the logarithm of the odds (n,) of columns (n, k)."""
    return numbers[0] + columns @ numbers[1:]


def by_others(columns: Array, truth: Array, room: Array, rng: np.random.Generator) -> Array:
    """Return the logarithm of the odds of each row by numbers that other rooms (n,) have given."""
    rooms = np.unique(room)
    fold = rng.permutation(len(rooms)) % FOLDS
    out = np.zeros(len(room))
    for k in range(FOLDS):
        own = np.isin(room, rooms[fold == k])
        if own.any():
            out[own] = log_odds(columns[own], fitted(columns[~own], truth[~own]))
    return out


def errors(columns: Array, truth: Array, room: Array, rng: np.random.Generator) -> Array:
    """Return the standard errors (k + 1,) of the numbers: rooms drawn with replacement."""
    rooms = np.unique(room)
    of_room = [np.flatnonzero(room == one) for one in rooms]
    drawn = (np.concatenate([of_room[k] for k in rng.integers(0, len(rooms), len(rooms))]) for _ in range(DRAWS))
    return np.std([fitted(columns[which], truth[which]) for which in drawn], axis=0)


def told(names: Sequence[str], columns: Array, truth: Array, room: Array, present: Sequence[float], others: Array) -> list[str]:
    """Return what a study prints: the numbers with their errors next to the present ones, and how often claims hold.

    Args:
        names: of the constant and the columns; present: numbers of the product.
        others: (n,) logarithm of the odds by other rooms (`by_others`).
    """
    numbers, deviation = fitted(columns, truth), errors(columns, truth, room, np.random.default_rng(1))
    lines = [
        f"{name:24} {new:6.2f} +- {error:.2f}   present {old:6.2f}"
        for name, new, error, old in zip(names, numbers, deviation, present, strict=True)
    ]
    claimed = 1.0 / (1.0 + np.exp(-others))
    for low, high in zip(CLAIMS, CLAIMS[1:], strict=False):
        own = (claimed >= low) & ((claimed < high) | (high == 1.0))
        if own.any():
            share = f"claimed {claimed[own].mean():.2f}, are {truth[own].mean():.2f}"
            lines.append(f"claimed {low:.2f} to {high:.2f}: {own.sum()}, {share}")
    return lines
