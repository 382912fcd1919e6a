"""Cameras: projection inverts the pixel rays, and the axes are those of OpenCV."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iif_core.camera import pinhole
from tests.errors import refused

coordinate = st.floats(-50, 50)
triple = st.tuples(coordinate, coordinate, coordinate)


@settings(max_examples=60, deadline=None)
@given(origin=triple, target=triple, up=triple, depth=st.floats(0.1, 20))
def test_point_on_pixel_ray_projects_to_the_pixel_centre(origin, target, up, depth):
    if np.linalg.norm(np.subtract(origin, target)) < 1e-3:
        return
    pose = pinhole.look_at(origin, target, up)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    d = pinhole.pixel_directions(50, 60, 3.2, 2.1, 7, 5, pose)
    assert d.shape == (5, 7, 3) and d.dtype == np.float32
    u, v, z = pinhole.project(pose[:3, 3] + depth * d.astype(np.float64), 50, 60, 3.2, 2.1, pose)
    columns, rows = np.meshgrid(np.arange(7) + 0.5, np.arange(5) + 0.5)
    np.testing.assert_allclose(u, columns, atol=1e-3)
    np.testing.assert_allclose(v, rows, atol=1e-3)
    np.testing.assert_allclose(z, depth, rtol=1e-5)


def test_axes_x_right_y_down_z_forward():
    pose = pinhole.look_at((0, 0, 0), (0, 0, -5), (0, 1, 0))
    np.testing.assert_allclose(pose[:3, :3], [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-12)
    u, v, z = pinhole.project([[1, 2, -4]], 100, 100, 50, 50, pose)
    assert (u[0], v[0], z[0]) == pytest.approx((75, 0, 4))  # right of the centre, above it


def test_target_is_in_the_centre_and_up_is_up():
    pose = pinhole.look_at((1, 2, 3), (4, -1, 2), (0, 0, 1))
    u, v, _ = pinhole.project([[4, -1, 2], [4, -1, 2.5]], 80, 80, 32, 24, pose)
    assert (u[0], v[0]) == pytest.approx((32, 24))
    assert u[1] == pytest.approx(32) and v[1] < 24


def test_derivatives_are_pixel_steps():
    pose = pinhole.look_at((0, 1, 2), (3, 4, 1), (0, 0, 1))
    d = pinhole.pixel_directions(50, 70, 4, 4, 8, 8, pose)
    du, dv = pinhole.direction_derivatives(50, 70, pose)
    np.testing.assert_allclose(d[3, 5] - d[3, 4], du, atol=1e-6)
    np.testing.assert_allclose(d[4, 4] - d[3, 4], dv, atol=1e-6)


def test_behind_the_camera_is_nan_and_bad_input_is_named():
    pose = pinhole.look_at((0, 0, 0), (0, 0, 1), (0, -1, 0))
    u, v, z = pinhole.project([[0, 0, -1], [0, 0, 1]], 10, 10, 5, 5, pose)
    assert np.isnan([u[0], v[0]]).all() and z[0] == -1 and u[1] == 5
    assert np.isfinite(pinhole.look_at((0, 0, 0), (0, 0, 1), (0, 0, 1))).all()
    with refused("look_at", "[1.0, 1.0, 1.0]"):
        pinhole.look_at((1, 1, 1), (1, 1, 1), (0, 0, 1))
    with refused("4x4", "fx=0", "fy=1"):
        pinhole.pixel_directions(0, 1, 0, 0, 4, 4, np.eye(4))
    with refused("world_from_camera", "(4, 4)"):
        pinhole.pixel_directions(1, 1, 0, 0, 4, 4, np.full((4, 4), np.nan))
    assert pinhole.pixel_directions(1, 1, 0.5, 0.5, 1, 1, np.eye(4)).tolist() == [[[0.0, 0.0, 1.0]]]
