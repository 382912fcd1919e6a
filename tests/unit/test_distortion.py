"""Lens distortion: known values, inversion, a picture with a closed form, and directions that must not be visible."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iif_core.camera.distortion import Distortion, Pinhole, distort, pinhole_inside, undistort, undistort_image
from iif_core.errors import InputError

BARREL = Distortion("radial_tangential", (-0.28, 0.07, -0.004, 0.0), (6e-4, -3e-4))
PINCUSHION = Distortion("radial_tangential", (0.15, 0.02, 0.0, 0.0))
FISHEYE = Distortion("fisheye", (-0.0293, -0.0056, 0.0016, -0.00034))


def by_hand(lens, x, y):
    """The formulas of the OpenCV documentation, one point, plain Python."""
    r = math.hypot(x, y)
    k1, k2, k3, k4 = lens.k
    p1, p2 = lens.p
    if lens.kind == "fisheye":
        t = math.atan(r)
        t_d = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8)
        return (x * t_d / r, y * t_d / r) if r else (0.0, 0.0)
    c = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    return x * c + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2), y * c + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION, FISHEYE])
def test_formula(lens):
    points = np.array([[0.0, 0.0], [0.3, -0.2], [-0.5, 0.4], [1e-9, 0.0], [0.0, 0.7]])
    got, ok = distort(lens, points)
    np.testing.assert_allclose(got, [by_hand(lens, *p) for p in points], rtol=1e-13, atol=1e-18)
    assert ok.all()


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION, FISHEYE])
def test_there_and_back(lens):
    grid = np.stack(np.meshgrid(np.linspace(-0.9, 0.9, 31), np.linspace(-0.7, 0.7, 29)), -1)
    back, found = undistort(lens, distort(lens, grid)[0])
    assert found.all()
    np.testing.assert_allclose(back, grid, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["radial_tangential", "fisheye"]),
    st.lists(st.floats(-0.5, 0.5), min_size=4, max_size=4),
    st.lists(st.floats(-0.01, 0.01), min_size=2, max_size=2),
    st.floats(0, 2),
    st.floats(0, 2 * math.pi),
)
def test_undistort_finds_or_refuses(kind, k, p, radius, angle):
    lens = Distortion(kind, (*k[:3], k[3] if kind == "fisheye" else 0.0), tuple(p) if kind != "fisheye" else (0.0, 0.0))
    target = np.array([radius * math.cos(angle), radius * math.sin(angle)])
    point, found = undistort(lens, target)
    assert np.isfinite(point).all()
    if found:
        np.testing.assert_allclose(distort(lens, point)[0], target, atol=1e-8 * (1 + radius))
        assert np.hypot(*point) < lens.turning_radius


def test_turning_radius():
    # r (1 - r^2 / 3) has slope 1 - r^2: it turns back at r = 1 and reaches 2/3 there.
    lens = Distortion("radial_tangential", (-1 / 3, 0, 0, 0))
    assert lens.turning_radius == pytest.approx(1.0)
    assert not distort(lens, [1.2, 0.0])[1]
    assert undistort(lens, [0.6, 0.0])[1] and not undistort(lens, [0.7, 0.0])[1]
    assert Distortion("fisheye").turning_radius == math.inf
    # Equidistant: r_d = atan r stays below pi / 2.
    np.testing.assert_allclose(undistort(Distortion("fisheye"), [1.0, 0.0])[0], [math.tan(1.0), 0.0], rtol=1e-12)
    assert not undistort(Distortion("fisheye"), [1.6, 0.0])[1]


def test_pinhole_of_a_pinhole_is_itself():
    source = Pinhole(100.0, 110.0, 33.2, 20.7, 64, 48)
    nothing = Distortion("radial_tangential")
    assert nothing.is_identity and not Distortion("fisheye").is_identity
    target = pinhole_inside(nothing, source)
    assert (target.width, target.height) == (64, 48)
    assert (target.cx, target.cy) == (pytest.approx(33.2), pytest.approx(20.7))
    image = np.random.default_rng(0).random((48, 64, 3)).astype(np.float32)
    got, seen = undistort_image(image, nothing, source, target)
    assert seen.all()
    np.testing.assert_allclose(got, image, atol=1e-5)


def smooth(x, y):
    return np.stack([0.5 + 0.3 * np.sin(3 * x), 0.5 + 0.3 * np.cos(2 * y), 0.5 + 0.2 * x * y], -1).astype(np.float32)


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION, FISHEYE])
def test_picture_of_a_known_scene(lens):
    # A function of the direction, photographed through the lens, must come out as that function through the pinhole.
    source = Pinhole(150.0, 155.0, 102.0, 73.5, 200, 150)
    u, v = np.meshgrid((np.arange(200) + 0.5 - source.cx) / source.fx, (np.arange(150) + 0.5 - source.cy) / source.fy)
    direction, found = undistort(lens, np.stack([u, v], -1))
    photograph = np.where(found[..., None], smooth(direction[..., 0], direction[..., 1]), 0)
    target = pinhole_inside(lens, source)
    got, seen = undistort_image(photograph, lens, source, target, found)
    x, y = np.meshgrid(
        (np.arange(target.width) + 0.5 - target.cx) / target.fx,
        (np.arange(target.height) + 0.5 - target.cy) / target.fy,
    )
    assert (target.fx, target.fy) == (source.fx, source.fy)
    assert seen.mean() > 0.99  # the rectangle lies inside the photograph
    inner = (slice(2, -2), slice(2, -2))  # the outer half pixel is repeated, not extrapolated
    error = np.abs(got - smooth(x, y))[inner][seen[inner]]
    assert error.max() < 2e-3
    wrong = np.abs(got[:, ::-1] - smooth(x, y))[inner].max()
    assert wrong > 0.05


def test_barrel_covers_more_and_pincushion_less():
    source = Pinhole(150.0, 150.0, 100.0, 75.0, 200, 150)
    assert pinhole_inside(Distortion("radial_tangential", (-0.2, 0, 0, 0)), source).width > 200
    assert pinhole_inside(PINCUSHION, source).width < 200


def test_wide_fisheye_is_cut_at_sixty_degrees():
    source = Pinhole(60.0, 60.0, 100.0, 100.0, 200, 200)  # 95 degrees to each side
    target = pinhole_inside(Distortion("fisheye"), source)
    assert target.width == target.height == int(2 * 60 * math.tan(math.radians(60)))


def test_invalid_pixels_spread_to_what_they_touch_and_ids_are_not_mixed():
    source = Pinhole(100.0, 100.0, 20.0, 15.0, 40, 30)
    shifted = Pinhole(100.0, 100.0, 19.5, 15.0, 39, 30)  # half a pixel to the right
    valid = np.ones((30, 40), bool)
    valid[10, 20] = False
    image = np.ones((30, 40), np.float32)
    image[~valid] = np.nan
    got, seen = undistort_image(image, Distortion("radial_tangential"), source, shifted, valid)
    assert np.argwhere(~seen).tolist() == [[10, 19], [10, 20]]
    assert np.isfinite(got).all() and (got[seen] == 1).all()
    ids = np.where(np.arange(40)[None, :] < 20, 7, 4000000000).astype(np.uint32).repeat(30, 0).reshape(30, 40)
    got, _ = undistort_image(ids, Distortion("radial_tangential"), source, shifted, nearest=True)
    assert got.dtype == np.uint32 and set(np.unique(got)) <= {7, 4000000000}


def test_directions_beyond_the_turning_point_are_not_seen():
    lens = Distortion("radial_tangential", (-1 / 3, 0, 0, 0))
    source = Pinhole(100.0, 100.0, 60.0, 60.0, 120, 120)
    wide = Pinhole(100.0, 100.0, 160.0, 160.0, 320, 320)  # looks far past r = 1, where the lens maps back inside
    _, seen = undistort_image(np.ones((120, 120), np.float32), lens, source, wide)
    x = (np.arange(320) + 0.5 - 160) / 100
    r = np.hypot(*np.meshgrid(x, x))
    assert not seen[r > 1].any() and seen[r < 0.6].all()


@pytest.mark.parametrize("tilt", [(0.02, 0.0), (0.0, 0.02)])
def test_a_lens_that_is_tilted_about_one_axis_alone_is_undone(tilt):
    lens = Distortion("radial_tangential", (-0.1, 0, 0, 0), tilt)
    points = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.4, 0.4, 5)), -1)
    straight, inside = undistort(lens, points)
    assert inside.all()
    np.testing.assert_allclose(distort(lens, straight)[0], points, atol=1e-9)


def test_one_pixel_and_bad_coefficients():
    one = Pinhole(1.0, 1.0, 0.5, 0.5, 1, 1)
    got, seen = undistort_image(np.full((1, 1, 3), 0.25, np.float32), Distortion("radial_tangential"), one, one)
    assert seen.all() and (got == 0.25).all()
    for make in (
        lambda: Distortion("equidistant"),
        lambda: Distortion("fisheye", (math.nan, 0, 0, 0)),
        lambda: Distortion("radial_tangential", (0, 0, 0, 0.1)),
        lambda: Distortion("fisheye", p=(0.1, 0)),
        lambda: undistort_image(np.zeros((2, 2)), BARREL, one, one),
    ):
        with pytest.raises(InputError):
            make()
