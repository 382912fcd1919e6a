"""Records of arrays with one row for each of many things."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from iif_core.numerics.rows import Rows


@dataclass(frozen=True, kw_only=True)
class Things(Rows):
    WHOLE: ClassVar[tuple[str, ...]] = ("levels",)

    number: np.ndarray
    halves: tuple[np.ndarray, ...]
    levels: np.ndarray
    name: str = ""
    unknown: np.ndarray | None = None


def _things(first, count):
    number = np.arange(first, first + count)
    return Things(number=number, halves=(number + 0.5, number[:, None] * np.ones(2)), levels=np.arange(9), name=f"from {first}")


@pytest.mark.parametrize("choice", [np.array([3, 1]), np.arange(5) % 2 == 1, slice(1, 4, 2)])
def test_some_rows_keep_what_belongs_to_all(choice):
    things = _things(10, 5)
    some = things.take(choice)
    np.testing.assert_array_equal(some.number, things.number[choice])
    for part, whole in zip(some.halves, things.halves, strict=True):
        np.testing.assert_array_equal(part, whole[choice])
    assert some.levels is things.levels and some.name == "from 10" and some.unknown is None


def test_rows_are_joined_in_order():
    joined = Things.joined([_things(0, 2), _things(5, 1), _things(7, 0)])
    assert joined.number.tolist() == [0, 1, 5] and joined.halves[0].tolist() == [0.5, 1.5, 5.5]
    assert joined.halves[1].shape == (3, 2) and len(joined.levels) == 9 and joined.name == "from 0" and joined.unknown is None
