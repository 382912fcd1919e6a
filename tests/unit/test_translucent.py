"""Surface that lets light through: in the tracer, and how it is recognised."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iif_core.light.emission.translucent import OPEN_RATIO, is_brighter_where_open
from tests.errors import refused
from tests.unit.transport_rooms import ROOM_MATERIALS, Room, quad

SHARE = 0.35


def sheets(T, share, levels=(0.0, 1.0, 2.0)):
    """Horizontal squares of 20 m; the upper ones let `share` of the rays through."""
    parts = [quad((-10, -10, z), (20, 0, 0), (0, 20, 0)) for z in levels]
    vertices, faces = np.concatenate([v for v, _ in parts]), np.concatenate([f + 4 * i for i, (_, f) in enumerate(parts)])
    passes = np.repeat([0.0] + [share] * (len(levels) - 1), 2)
    return T.build_geometry(vertices, faces, np.repeat(np.arange(len(levels)), 2), passes)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_share_of_rays_that_pass(T, share):
    rng = np.random.default_rng(0)
    count = 200_000
    origin = np.column_stack([rng.uniform(-3, 3, (count, 2)), np.full(count, 2.5)])
    direction = np.column_stack([rng.normal(0, 0.3, (count, 2)), np.full(count, -1.0)])
    face, distance = T.trace(sheets(T, share), origin, direction)
    for sheet, expected in ((2, 1 - share), (1, share * (1 - share)), (0, share**2)):
        met = face // 2 == sheet
        error = np.sqrt(expected * (1 - expected) / count)
        assert abs(met.mean() - expected) < 5 * error
        np.testing.assert_allclose(distance[met], 2.5 - sheet, rtol=1e-5)  # of the whole way, in lengths of the direction


def test_neighbouring_rays_pass_independently(T):
    """A regular grid of rays from one point, as a camera has them: the hash must not draw patterns."""
    x, y = np.meshgrid(np.linspace(-1, 1, 256), np.linspace(-1, 1, 256))
    face, _ = T.trace(sheets(T, 0.5, (0.0, 1.0)), (0, 0, 2.5), np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3))
    passed = (face < 2).reshape(256, 256) - 0.5
    for shift in ((0, 1), (1, 0), (1, 1), (0, 2), (5, 3)):
        both = (passed[shift[0] :, shift[1] :] * passed[: 256 - shift[0], : 256 - shift[1]]).mean() / 0.25
        assert abs(both) < 5 / 256  # standard error 1/256


def test_radiance_behind_black_sheets(T):
    """Nothing shines but the sky: through n black sheets a share^n of it is seen."""
    geometry = sheets(T, SHARE, (-1.0, 0.0, 1.0, 2.0))
    black = T.FaceMaterials(np.tile(np.float32([0, 0, 0, 1, 1]), (8, 1)))
    emitters = T.Emitters(geometry, np.zeros((8, 3)), environment=(3.0, 2.0, 1.0))
    origin = np.tile([[0.1, 0.2, -0.5], [0.1, 0.2, 0.5], [0.1, 0.2, 1.5], [0.1, 0.2, 2.5]], (4096, 1))
    up = np.tile([0.05, 0.02, 1.0], (len(origin), 1)) + np.random.default_rng(1).normal(0, 0.05, (len(origin), 3)) * [1, 1, 0]
    found = T.render(T.Scene(geometry, black, emitters), origin, up, T.PathOptions(16, 4, 7)).reshape(-1, 4, 3).mean(0)
    expected = SHARE ** np.array([3, 2, 1, 0])[:, None] * np.array([3.0, 2.0, 1.0])
    np.testing.assert_allclose(found, expected, rtol=5 * np.sqrt(1 / SHARE**3 / 4096 / 16))


def covered(T, share):
    """The furnished room with its ceiling light behind a black sheet: geometry, materials, that light, groups of all lights."""
    room = Room(T)
    vertices, faces = quad((1.2, 0.7, 2.4), (0, 1.4, 0), (1.6, 0, 0))
    everything = np.concatenate([room.vertices, vertices]), np.concatenate([room.faces, faces + len(room.vertices)])
    passes = np.append(np.zeros(len(room.faces)), [share, share])
    geometry = T.build_geometry(*everything, np.append(room.ids, [5, 5]), passes)
    radiance, side = np.pad(room.radiance, [(0, 2), (0, 0)]), np.append(room.side, [0, 0])
    radiance[room.ids.tolist().index(4) :] = 0  # the ceiling light alone
    material = T.FaceMaterials(np.concatenate([ROOM_MATERIALS[room.ids], np.tile(np.float32([0, 0, 0, 1, 1]), (2, 1))]))
    return geometry, material, T.Emitters(geometry, radiance, side), np.append(room.group, [-1, -1])


@pytest.mark.parametrize("share", [0.2, 0.7])
def test_direct_light_through_a_sheet(T, share):
    """The light that is drawn on the lamp and the directions that find it agree: the floor gets `share` of the light."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(0.2, 3.8, 3000), rng.uniform(0.2, 2.8, 3000), np.zeros(3000)])
    up = np.tile([0.0, 0.0, 1.0], (3000, 1))
    light = {}
    for sheet in (0.0, share):
        geometry, material, emitters, _ = covered(T, sheet if sheet else 0.999999)
        light[sheet] = T.shading_caches(T.Scene(geometry, material, emitters), points, up, up, [], T.PathOptions(64, 1, 5))[0]
    ratio = light[share].sum(0) / light[0.0].sum(0)
    np.testing.assert_allclose(ratio, share, rtol=0.03)


def test_column_of_a_lamp_behind_a_sheet(T):
    points = np.column_stack([*np.random.default_rng(4).uniform([0.2, 0.2], [3.8, 2.8], (2000, 2)).T, np.zeros(2000)])
    up, one = np.tile([0.0, 0.0, 1.0], (2000, 1)), np.ones(2000)
    at = T.ShadingPoints(points, up, up, np.full((2000, 3), 0.5), 0.8 * one, 0 * one)
    columns = {}
    for share in (0.999999, 0.4):
        geometry, material, _, group = covered(T, share)
        scene = T.Scene(geometry, material, None)
        columns[share] = T.transport_matrix(scene, at, T.EmitterColumns(group, 2), T.PathOptions(32, 1, 6))[0].sum((0, 1))
    np.testing.assert_allclose(columns[0.4][0] / columns[0.999999][0], 0.4, rtol=0.03)
    np.testing.assert_allclose(columns[0.4][1] / columns[0.999999][1], 1.0, rtol=0.1)  # the wall light has no sheet before it


def test_guides_show_the_sheet_itself(T):
    geometry = sheets(T, 0.9, (0.0, 1.0))
    material = T.FaceMaterials(np.tile(np.float32([0.5, 0.5, 0.5, 1, 0]), (4, 1)))
    rays = np.column_stack([np.random.default_rng(0).normal(0, 0.1, (500, 2)), -np.ones(500)])
    assert (T.first_hits(geometry, material, (0, 0, 2.5), rays)[2] // 2 == 1).all()


@pytest.mark.parametrize("share", [-0.1, 1.0, np.nan])
def test_shares_out_of_range(T, share):
    with refused("transmittance"):
        sheets(T, share, (0.0, 1.0))


def test_no_share_is_no_sheet(T):
    assert sheets(T, 0.0).transmittance is None


# ------------------------------------------------------------------------------------------------------ which objects do


def pixels_of(open_radiance, rest_radiance, opens=50, rest=50):
    """Pixels of object 1 of 3."""
    is_open = np.r_[np.ones(opens, bool), np.zeros(rest, bool)]
    return np.ones(opens + rest, int), is_open, np.where(is_open, open_radiance, rest_radiance).astype(float)


def test_curtain_against_lampshade():
    assert is_brighter_where_open(*pixels_of(1.4, 0.2), 3).tolist() == [False, True, False]
    assert not is_brighter_where_open(*pixels_of(1.4, 1.3), 3).any()
    assert not is_brighter_where_open(*pixels_of(0.2, 1.4), 3).any()


def test_too_few_pixels_of_one_kind():
    assert not is_brighter_where_open(*pixels_of(5.0, 0.1, opens=7), 3).any()
    assert not is_brighter_where_open(*pixels_of(5.0, 0.1, rest=7), 3).any()
    assert not is_brighter_where_open(*pixels_of(5.0, 0.1, opens=40, rest=960), 3).any()  # one pixel in 25: an edge
    assert not is_brighter_where_open(*pixels_of(5.0, 0.1, opens=960, rest=40), 3).any()  # a pane, and the wall beside it
    assert not is_brighter_where_open(np.zeros(0, int), np.zeros(0, bool), np.zeros(0), 3).any()


@given(st.floats(1e-30, 1e30), st.floats(0.0, 4.0))
def test_units_do_not_matter(unit, ratio):
    if abs(ratio - OPEN_RATIO) > 1e-6:
        assert is_brighter_where_open(*pixels_of(unit * ratio, unit), 3)[1] == (ratio > OPEN_RATIO)


def test_sheets_on_a_ray(llvm):
    """Two sides of one cloth half a millimetre apart count twice, as paths meet them; a ray that misses them counts once."""
    from iif_core.light.tracer import Behind

    levels = (0.0, 1.0, 1.0005, 1.6)
    parts = [quad((-1, -1, z), (2, 0, 0), (0, 2, 0)) for z in levels]
    vertices, faces = np.concatenate([v for v, _ in parts]), np.concatenate([f + 4 * i for i, (_, f) in enumerate(parts)])
    scene = SimpleNamespace(vertices=vertices, faces=faces, object_id=np.repeat(np.arange(4), 2))
    behind = Behind(scene, np.repeat([False, True, True, True], 2))
    eye = np.array([0.0, 0.0, 2.0])
    towards = np.array([[0.0, 0.1, -1.0], [0.1, 0.0, 1.0], [0.0, 1.3, -1.0]])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    assert behind.sheets(eye, towards).tolist() == [3, 1, 1]
    assert behind.is_open(eye, towards).tolist() == [False, True, True]
    assert behind.sheets(eye, towards[:0]).tolist() == []
