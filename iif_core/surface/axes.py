"""Turns by quarter circles about the axes, which is how the frames of programs differ, and their names."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from iif_core.errors import InputError

LETTERS = "xyz"
AS_IS = "x y z"


def turn_of(text: str) -> np.ndarray:
    """Return the rotation that a text of three axes names: the new x, y and z, each as an axis of the old frame.

    Args:
        text: such as `x -z y`: the new x is the old x, the new y is the old -z, the new z is the old y.

    Returns:
        (3, 3) float64 `new_from_old`, a rotation of determinant 1.

    Raises:
        InputError: not three axes, an axis twice, or a mirror image.

    >>> turn_of("z x y") @ [1.0, 2.0, 3.0]
    array([3., 1., 2.])
    """
    parts = text.replace(",", " ").split()
    axes = [part.removeprefix("-") for part in parts]
    if sorted(axes) != list(LETTERS):
        raise InputError(f"{text!r} does not name each of x, y and z once; needed: three axes, such as `x -z y`")
    turn = np.zeros((3, 3))
    for row, (part, axis) in enumerate(zip(parts, axes, strict=True)):
        turn[row, LETTERS.index(axis)] = -1.0 if part.startswith("-") else 1.0
    if np.linalg.det(turn) < 0:
        raise InputError(f"{text!r} is a mirror image, which no turn makes; change one sign or swap two axes")
    return turn


def name_of(turn: np.ndarray) -> str:
    """Return the text that `turn_of` reads, of such a rotation (3, 3)."""
    column = np.abs(turn).argmax(1)
    return " ".join(("-" if turn[row, at] < 0 else "") + LETTERS[at] for row, at in enumerate(column))


def _every() -> tuple[str, ...]:
    """Return the names of the 24 rotations that map axes to axes; the first leaves all as it is."""
    found = []
    for axes, signs in product(permutations(LETTERS), product(("", "-"), repeat=3)):
        text = " ".join(sign + axis for sign, axis in zip(signs, axes, strict=True))
        try:
            turn_of(text)
        except InputError:
            continue
        found.append(text)
    return tuple(found)


TURNS = _every()
"""Names of the 24 rotations that map axes to axes."""
