"""Distinct rows of tables of numbers, against NumPy's slower form."""

import numpy as np
import pytest

from iif_core.numerics.arrays import unique_rows

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    "rows",
    [
        RNG.integers(-3, 3, (500, 2)),
        RNG.integers(0, 2, (500, 3)).astype(np.float32) - 0.5,
        np.array([[0.0, 1.0], [-0.0, 1.0], [0.0, -1.0]]),
        np.array([[np.inf, 1.0], [-np.inf, 1.0], [np.inf, 1.0], [1e-310, 1.0]]),
        np.zeros((1, 4), np.int64),
        np.zeros((0, 2)),
    ],
)
def test_distinct_rows_are_those_of_numpy(rows):
    unique, inverse = unique_rows(rows)
    expected, place = np.unique(rows, axis=0, return_inverse=True)
    np.testing.assert_array_equal(unique, expected)
    np.testing.assert_array_equal(inverse, place.ravel())
    np.testing.assert_array_equal(unique[inverse], rows)
