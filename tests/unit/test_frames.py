"""Orthonormal frames around directions."""

import numpy as np
import pytest

from iif_core.numerics.frames import SEAM, dominant_side, tangent_frame
from iif_core.numerics.xp import NUMPY


def _frame(n):
    return (np.stack(axis, -1) for axis in tangent_frame(NUMPY, *np.moveaxis(n, -1, 0)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_frames_are_orthonormal_and_right_handed(dtype):
    rng = np.random.default_rng(0)
    n = rng.normal(size=(5000, 3))
    special = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0], [0.6, 0.8, 0], [np.sqrt(1 - SEAM**2), 0, SEAM]]
    n = np.concatenate([n / np.linalg.norm(n, axis=1, keepdims=True), np.array(special, float)]).astype(dtype)
    t, b = _frame(n)
    assert t.dtype == b.dtype == dtype
    eps = 20 * np.finfo(dtype).eps
    for inner in ((t * t).sum(1) - 1, (b * b).sum(1) - 1, (t * b).sum(1), (t * n).sum(1), (b * n).sum(1)):
        assert np.abs(inner).max() < eps
    assert np.abs(np.cross(t, b) - n).max() < eps


def test_rounding_of_a_horizontal_normal_does_not_turn_the_frame():
    n = np.array([[0.6, 0.8, 1e-8], [0.6, 0.8, -1e-8], [-1, 0, 1e-8], [-1, 0, -1e-8]])
    t, b = _frame(n)
    assert np.abs(t[0] - t[1]).max() < 1e-7 and np.abs(b[2] - b[3]).max() < 1e-7


def test_sides_of_a_box():
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    assert dominant_side(axes).tolist() == [0, 2, 4, 1, 3, 5]
    assert dominant_side(1e-30 * axes.astype(np.float32)).tolist() == [0, 2, 4, 1, 3, 5]
    rng = np.random.default_rng(0)
    n = rng.standard_normal((1000, 3))
    assert (dominant_side(n) == dominant_side(7 * n)).all()
    assert (dominant_side(n) // 2 == dominant_side(-n) // 2).all() and (dominant_side(n) != dominant_side(-n)).all()


def test_rounding_of_a_slanted_normal_does_not_turn_its_side():
    """Normals at 45 degrees, and along the diagonals of a cube, each component moved by a few spacings."""
    signs = np.array([[1, 1, 0], [1, -1, 0], [-1, 0, 1], [0, 1, 1], [1, 1, 1], [-1, 1, -1]], np.float32)
    normals = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    rng = np.random.default_rng(1)
    for _ in range(200):
        moved = normals * (1 + rng.integers(-4, 5, normals.shape) * np.finfo(np.float32).eps)
        assert (dominant_side(moved.astype(np.float32)) == dominant_side(normals)).all()
