"""Inputs of the learned prior, its hypotheses, and how they become predictions (iif_core/priors/)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iif_core.camera.pinhole import look_at, pixel_directions
from iif_core.camera.pixels import ViewMaps
from iif_core.camera.view import View
from iif_core.errors import InputError
from iif_core.priors import features as inputs
from iif_core.priors.features import CHANNELS, features, gather_again, gather_views, mirrored, with_computed_light
from iif_core.priors.hypotheses import combined
from iif_core.priors.reprojection import NORMAL_STEPS, Camera, ViewTable, add_samples, as_steps, from_steps, quantiles
from iif_core.priors.upsampling import enlarged

SIZE = np.array([4.0, 3.0, 2.5])
ALBEDO = np.array([[0.7, 0.2, 0.2], [0.2, 0.6, 0.2], [0.3, 0.3, 0.7], [0.6, 0.6, 0.5], [0.4, 0.3, 0.2], [0.8, 0.8, 0.8]])
WIDTH, HEIGHT, FOCAL = 40, 32, 30.0


def trace_box(origins, directions):
    """The walls of an empty box, from inside: face 2 axis + side, and the distance."""
    o, d = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(d > 0, (SIZE - o) / d, -o / d)
    t = np.where(d == 0, np.inf, t)
    axis = t.argmin(1)
    rows = np.arange(len(t))
    return 2 * axis + (d[rows, axis] > 0), t[rows, axis]


def view_of(position, target, exposure=1.0, light=1.0):
    pose = look_at(position, target, (0, 0, 1))
    intrinsics = np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])
    rays = pixel_directions(*intrinsics, WIDTH, HEIGHT, pose)
    face, depth = trace_box(np.broadcast_to(position, rays.reshape(-1, 3).shape), rays.reshape(-1, 3))
    normals = np.zeros((len(face), 3), np.float32)
    normals[np.arange(len(face)), face // 2] = np.where(face % 2, -1, 1)
    shape = HEIGHT, WIDTH
    linear = (ALBEDO[face] * light * exposure).reshape(*shape, 3).astype(np.float32)
    return ViewMaps(
        camera=View(0, "v", WIDTH, HEIGHT, *intrinsics.tolist(), pose, exposure),
        value=linear,
        valid=np.ones(shape, bool),
        depth=depth.reshape(shape).astype(np.float32),
        face=face.reshape(shape),
        object_id=face.reshape(shape),
        saturated=np.zeros(shape, bool),
        normals=normals.reshape(*shape, 3),
    )


@pytest.fixture(scope="module")
def room():
    places = [((1, 1, 1.2), (4, 3, 1)), ((3, 2, 1.4), (0, 0, 1)), ((2, 1.5, 1.2), (4, 0, 0.5)), ((1.2, 2.2, 1), (3, 0, 2.5))]
    return [view_of(np.array(a, float), np.array(b, float)) for a, b in places]


def all_inputs(views, seed=0):
    gathered = gather_views(views, trace_box, seed=seed)
    return np.stack([features(gathered, views, i) for i in range(len(views))])


def channel(x, name, count=1):
    first = CHANNELS.index(name)
    return x[..., first : first + count, :, :]


def test_inputs_are_finite_and_name_what_they_hold(room):
    x = all_inputs(room)
    assert x.shape == (4, len(CHANNELS), HEIGHT, WIDTH) and x.dtype == np.float32
    assert np.isfinite(x).all()
    assert (channel(x, "hit") == 1).all() and (channel(x, "saturated") == 0).all()
    normal = channel(x, "n_x", 3)
    assert np.allclose((normal**2).sum(1), 1, atol=1e-5)
    # A surface that faces the camera has its normal against the viewing direction, which is +z of the camera.
    assert (normal[:, 2] < 0).mean() > 0.9
    assert (channel(x, "nov") > 0).all()


def test_surface_that_looks_alike_from_everywhere_has_equal_quantiles(room):
    x = all_inputs(room)
    inside = channel(x, "border")[:, 0] == 0
    for name, count in (("low_r", 3), ("mid_r", 3), ("high", 1), ("top", 1)):
        assert np.abs(channel(x, name, count)[np.broadcast_to(inside[:, None], (4, count, HEIGHT, WIDTH))]).max() < 0.01


def test_the_exposure_of_a_view_changes_no_input(room):
    plain = all_inputs(room)
    changed = [
        replace(view, value=view.value * f, camera=replace(view.camera, exposure=f))
        for view, f in zip(room, (1.0, 0.25, 4.0, 2.0), strict=True)
    ]
    assert np.abs(all_inputs(changed) - plain).max() < 0.02


def test_a_common_factor_of_all_photographs_changes_no_input(room):
    plain = all_inputs(room)
    darker = [replace(view, value=view.value * 0.5) for view in room]
    assert np.abs(all_inputs(darker) - plain).max() < 0.02


def test_the_order_of_the_views_changes_no_input(room):
    plain = all_inputs(room)
    turned = all_inputs(room[::-1])[::-1]
    assert np.quantile(np.abs(turned - plain), 0.999) < 0.02


def test_equal_bytes_for_equal_seeds(room):
    assert np.array_equal(all_inputs(room, 3), all_inputs(room, 3))


def test_a_photograph_of_nothing_is_zero_and_a_room_of_nothing_is_refused(room):
    blind = replace(room[0], depth=np.zeros_like(room[0].depth), valid=np.zeros_like(room[0].valid))
    views = [*room[1:], blind]
    gathered = gather_views(views, trace_box)
    assert not features(gathered, views, 3).any()
    assert np.isfinite(features(gathered, views, 0)).all()
    with pytest.raises(InputError):
        gather_views([blind], trace_box)


@settings(max_examples=12, deadline=None)
@given(st.sampled_from([1e-6, 1e-2, 1.0, 1e3, 1e6]), st.sampled_from(["black", "saturated", "one"]))
def test_extreme_photographs_give_finite_inputs(light, kind):
    places = (((1, 1, 1.2), (4, 3, 1)), ((3, 2, 1.4), (0, 0, 0)))
    views = [view_of(np.array(a, float), np.array(b, float), light=light) for a, b in places]
    if kind == "black":
        views[0] = replace(views[0], value=np.zeros_like(views[0].value))
    if kind == "saturated":
        views = [replace(view, saturated=np.ones_like(view.saturated)) for view in views]
    if kind == "one":
        views = views[:1]
    assert np.isfinite(all_inputs(views)).all()


def test_neighbours_are_the_views_that_see_the_same_surface(room, monkeypatch):
    monkeypatch.setattr(inputs, "MAX_VIEWS", 2)
    gathered = gather_views(room, trace_box)
    assert [len(own) for own in gathered.neighbours] == [2] * 4
    assert [int(own[0]) for own in gathered.neighbours] == [0, 1, 2, 3]


def test_blocks_of_surface_are_counted_from_its_lowest_corner(room):
    cells, _, seen = inputs._cells(room)
    points = [view.points()[view.hit] for view in room]
    low = np.concatenate(points).min(0)
    for found, own in zip(seen, points, strict=True):
        i, j, k = np.unique((own - low) // (4 * cells.edge), axis=0).astype(int).T
        np.testing.assert_array_equal(found, i * 2**42 + j * 2**21 + k)


def test_a_first_prediction_moves_the_light_and_nothing_else(room):
    """With the true albedos the quotients of the walls differ as the albedos do."""
    gathering = gather_views(room, trace_box)
    again = gather_again(gathering, room, np.log(ALBEDO)[gathering.group])
    first, second = (np.stack([features(g, room, i) for i in range(len(room))]) for g in (gathering, again))
    moved = {name for c, name in enumerate(CHANNELS) if not np.array_equal(first[:, c], second[:, c])}
    assert moved <= {"y_r", "y_g", "y_b", "dy_r", "dy_g", "dy_b", "g_r", "g_g", "g_b"} and "y_r" in moved
    truth = np.log(ALBEDO)[np.stack([view.object_id for view in room])].transpose(0, 3, 1, 2)

    def error(x):
        difference = channel(x, "y_r", 3) - truth
        return np.abs(difference - np.median(difference)).mean()

    assert error(second) < error(first)


def test_objects_without_a_first_prediction_have_the_mean_albedo(room):
    gathering = gather_views(room, trace_box)
    unknown = gather_again(gathering, room, np.full((len(gathering.group), 3), np.nan))
    mean = gather_again(gathering, room, np.full((len(gathering.group), 3), np.log(inputs.MEAN_ALBEDO)))
    assert np.array_equal(unknown.median, mean.median) and np.isfinite(unknown.median).all()


def test_light_that_falls_off_is_divided_out():
    """Walls of one albedo under uneven light: the quotient is more even than the photograph."""
    rng = np.random.default_rng(0)
    views = []
    for position, target in (((1, 1, 1.2), (4, 3, 1)), ((3, 2, 1.4), (0, 0, 1)), ((2, 1.5, 1.2), (4, 0, 0.5))):
        view = view_of(np.array(position, float), np.array(target, float))
        points = view.points()
        fall = np.exp(-0.8 * points[..., :1]) * np.exp(rng.normal(0, 0.01, (HEIGHT, WIDTH, 1)))
        views.append(replace(view, value=(0.5 * fall * np.ones(3)).astype(np.float32)))
    x = all_inputs(views)
    quotient = channel(x, "y_r", 3)
    photograph = np.log(np.stack([view.value for view in views]))
    assert quotient.std() < 0.8 * photograph.std()


# ------------------------------------------------------------------------------------------------------------- second look


@pytest.fixture(scope="module")
def lit():
    """A room whose light changes where the albedo does not: its views, the light of their pixels, and what is gathered."""
    places = [((1, 1, 1.2), (4, 3, 1)), ((3, 2, 1.4), (0, 0, 1)), ((2, 1.5, 1.2), (4, 0, 0.5)), ((1.2, 2.2, 1), (3, 0, 2.5))]
    views, light = [], []
    for position, target in places:
        view = view_of(np.array(position, float), np.array(target, float))
        points = view.points().astype(np.float64)
        light.append(np.exp(-0.7 * points[..., :1] + 0.5 * np.sin(3 * points[..., 1:2])) * np.array([1.0, 0.8, 0.6]))
        views.append(replace(view, value=(view.value * light[-1]).astype(np.float32)))
    return views, light, gather_views(views, trace_box)


def error_of_light(gathering, views, light):
    """Standard deviation of the logarithm of estimated over true light, over all cells, by channel."""
    difference = []
    for i, view in enumerate(views):
        own = gathering.lights[i]
        difference.append(gathering.light.log_at(own.row, own.weight)[0] - np.log(light[i])[view.depth > 0])
    return np.concatenate(difference).std(0)


def test_computed_light_takes_its_share_of_the_error_away(lit):
    views, light, gathering = lit
    again = with_computed_light(gathering, views, light)
    before, after = error_of_light(gathering, views, light), error_of_light(again, views, light)
    left = 1 - inputs.COMPUTED_SHARE
    # In addition to that share, the size of a cell leaves an error.
    assert (before > 0.2).all() and (after < left * before + 0.06).all() and (after > 0.5 * left * before).all()


def test_computed_light_moves_the_quotient_alone(lit):
    views, light, gathering = lit
    again = with_computed_light(gathering, views, light)
    first, second = (np.stack([features(g, views, i) for i in range(len(views))]) for g in (gathering, again))
    moved = {name for c, name in enumerate(CHANNELS) if np.abs(first[:, c] - second[:, c]).max() > 1e-5}
    assert moved == {"y_r", "y_g", "y_b", "g_r", "g_g", "g_b"}


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(1e-12, 1e12), min_size=3, max_size=3))
def test_a_factor_of_each_channel_changes_nothing(lit, factor):
    views, light, gathering = lit
    plain = with_computed_light(gathering, views, light)
    scaled = with_computed_light(gathering, views, [own * np.array(factor) for own in light])
    assert np.allclose(scaled.light.log_light, plain.light.log_light, atol=1e-9)


def test_where_no_light_was_computed_it_stays_the_gathered_one(lit):
    views, light, gathering = lit
    for nothing in (0.0, np.nan, -1.0):
        assert with_computed_light(gathering, views, [np.full_like(own, nothing) for own in light]) is gathering
    wall = 1  # x = 4 m

    def partly(i):
        return np.where((views[i].object_id == wall)[..., None], np.nan, light[i])

    again = with_computed_light(gathering, views, map(partly, range(len(views))))
    on_wall = gathering.light.cells.group == wall
    change = (again.light.log_light - gathering.light.log_light)[0]
    assert not change[on_wall].any() and np.ptp(change[~on_wall], axis=0).min() > 0.1


def test_lamps_among_the_cells_do_not_move_the_level(lit):
    """Light on the surface of a lamp means nothing; a tenth of the cells may have any."""
    views, light, gathering = lit
    cells = gathering.light.cells
    lamp = np.zeros(len(cells), bool)
    lamp[: len(cells) // 10] = True

    def spoilt(i):
        out = light[i].copy()
        shown = np.zeros(views[i].depth.shape, bool)
        shown[views[i].depth > 0] = lamp[gathering.lights[i].row[:, 0].astype(int)]
        out[shown] *= 1e-6
        return out

    plain, other = (with_computed_light(gathering, views, own).light.log_light for own in (light, map(spoilt, range(len(views)))))
    moved = np.median((other - plain)[0][~lamp], 0)
    assert (np.abs(moved) < 0.15).all()  # the median of all is the 0.55 quantile of those that are right


# ------------------------------------------------------------------------------------------------------------ reprojection


def tables(room):
    out = []
    for view in room:
        n = view.depth.size
        out.append(
            ViewTable(
                view.depth.ravel(),
                np.rint(view.normals.reshape(n, 3) * NORMAL_STEPS).astype(np.int8),
                view.valid.ravel(),
                as_steps(np.log(view.value.reshape(n, 3))),
                view.value.reshape(n, 3).mean(-1),
                np.full(n, 0.5, np.float32),
            )
        )
    return out


def test_samples_are_what_projection_finds(room):
    """Every sample against a projection in plain NumPy, pixel by pixel."""
    first, second = room[0], room[3]
    n = first.depth.size
    points, normals = first.points().reshape(n, 3), first.normals.reshape(n, 3)
    samples, count, sums = np.zeros((n, 2, 3), np.float32), np.zeros(n, np.int32), np.zeros((n, 6))
    camera: Camera = inputs.camera_of(second)
    add_samples(points, normals, np.full(n, -1, np.int64), camera, tables(room)[3], samples, count, sums)
    local = (points - second.camera.world_from_camera[:3, 3]) @ second.camera.world_from_camera[:3, :3]
    seen = 0
    for i in range(n):
        z = local[i, 2]
        u, v = (FOCAL * local[i, 0] / z + WIDTH / 2, FOCAL * local[i, 1] / z + HEIGHT / 2) if z > 0.05 else (-1, -1)
        inside = 0 <= u < WIDTH and 0 <= v < HEIGHT
        same = inside and abs(second.depth[int(v), int(u)] - z) < 0.012 * z + 0.004
        same = same and (second.normals[int(v), int(u)] * normals[i]).sum() > 0.8
        assert count[i] == same
        if same:
            seen += 1
            assert np.allclose(samples[i, 0], np.log(second.value[int(v), int(u)]), atol=1e-3)
            luminance = second.value[int(v), int(u)].mean()
            expected = [1, luminance, 0.5, luminance**2, 0.25, 0.5 * luminance]
            assert np.allclose(sums[i], expected, rtol=1e-4)
    assert 20 < seen < n


def test_quantiles_are_the_nearest_of_the_sorted_samples():
    rng = np.random.default_rng(1)
    samples = rng.normal(size=(50, 9, 3)).astype(np.float32)
    count = rng.integers(0, 10, 50).astype(np.int32)
    expected = np.zeros((50, 4, 3), np.float32)
    for i, k in enumerate(count):
        for q, share in enumerate((0.2, 0.5, 0.8, 1.0)):
            if k:
                expected[i, q] = np.sort(samples[i, :k], 0)[int(np.rint((k - 1) * share))]
    assert np.array_equal(quantiles(samples, count), expected)


@given(st.floats(-40, 40))
def test_steps_of_a_logarithm_are_a_thousandth(value):
    back = float(from_steps(as_steps(np.array([value])))[0])
    assert abs(back - np.clip(value, -31.9, 31.9)) <= 0.5 / 1024 + 1e-6


# -------------------------------------------------------------------------------------------------------------- hypotheses


def heads_of(albedo, roughness, metallic, log_scale):
    """(M, 2, 3, 8) heads with one value each."""
    m = len(albedo)
    out = np.zeros((m, 2, 3, 8), np.float32)
    out[..., :3] = np.log(albedo)[:, None, None, None]
    out[..., 3], out[..., 4] = (np.asarray(a)[:, None, None] for a in (roughness, metallic))
    out[..., 5:] = np.asarray(log_scale)[:, None, None, None]
    return out


def test_the_mean_of_heads_is_weighted_by_their_precision():
    heads = heads_of([0.2, 0.8], [0.3, 0.9], [0.0, 1.0], np.log([0.1, 0.2]))
    found = combined(heads, 1)
    w = np.array([1 / 0.1**2, 1 / 0.2**2])
    w /= w.sum()
    assert np.allclose(found.maps[0, ..., :3], np.exp(w @ np.log([0.2, 0.8])), rtol=1e-5)
    assert np.allclose(found.maps[0, ..., 3], w @ [0.3, 0.9], rtol=1e-5)
    assert np.allclose(found.maps[0, ..., 4], w @ [0.0, 1.0], atol=1e-6)
    scale = w @ [0.1, 0.2]
    assert np.allclose(found.scale[..., 1:], scale, rtol=1e-5)
    assert np.allclose(found.scale[..., 0], scale * found.maps[0, 0, 0, 0], rtol=1e-5)
    factors = combined(heads, 1, calibration=(2.0, 3.0, 4.0)).scale / found.scale
    assert np.allclose(factors, (2, 3, 4), rtol=1e-5)


def test_predictions_lie_between_mean_and_heads():
    heads = heads_of([0.2, 0.8], [0.3, 0.9], [0.0, 1.0], np.log([0.1, 0.1]))
    assert np.allclose(combined(heads, 2, spread=1.0).maps[:, 0, 0, 3], [0.3, 0.9], rtol=1e-5)
    assert np.allclose(combined(heads, 2, spread=0.5).maps[:, 0, 0, 3], [0.45, 0.75], rtol=1e-5)
    assert np.allclose(combined(heads, 2, spread=0.0).maps[:, 0, 0, :3], 0.4, rtol=1e-5)  # the geometric mean


def test_more_predictions_than_heads_are_refused():
    with pytest.raises(InputError):
        combined(heads_of([0.2], [0.3], [0.0], [0.0]), 2)


# --------------------------------------------------------------------------------------------------------------- mirroring


def test_mirroring_twice_is_nothing(room):
    x = all_inputs(room)[0]
    assert np.array_equal(mirrored(mirrored(x)), x)
    assert np.array_equal(channel(mirrored(x), "n_x"), -channel(x, "n_x")[..., ::-1])
    assert np.array_equal(channel(mirrored(x), "n_y"), channel(x, "n_y")[..., ::-1])


# --------------------------------------------------------------------------------------------------------------- upsampling


def smaller(view, factor):
    """The view with only the middle pixel of every block, photographs averaged."""
    f, m = factor, factor // 2
    blocks = view.value.reshape(HEIGHT // f, f, WIDTH // f, f, 3).mean((1, 3))
    take = {name: getattr(view, name)[m::f, m::f] for name in ("valid", "saturated", "depth", "normals", "face", "object_id")}
    return replace(view, value=blocks, **take)


def test_constant_maps_stay_constant(room):
    small = smaller(room[0], 2)
    maps = np.broadcast_to(np.float32([0.3, 0.4, 0.5, 0.6, 0.1]), (2, *small.depth.shape, 5))
    even = replace(room[0], value=np.full_like(room[0].value, 0.4))
    scale = np.full((*small.depth.shape, 3), 0.2, np.float32)
    out, wide = enlarged(maps, scale, smaller(even, 2), even, 2)
    assert out.shape == (2, HEIGHT, WIDTH, 5) and np.allclose(out, maps[0, 0, 0], atol=1e-4)
    assert np.allclose(wide, 0.2, atol=1e-5)


def test_albedo_follows_texture_and_not_light(room):
    """Fine stripes of albedo come back; where the albedo is even, stripes of light do not enter."""
    stripes = np.where(np.arange(WIDTH) % 2, 0.3, 0.5)[None, :, None] * np.ones((HEIGHT, 1, 3))
    slow = np.linspace(0.2, 0.8, WIDTH)[None, :, None] * np.ones((HEIGHT, 1, 3))
    wall = replace(room[0], object_id=np.zeros((HEIGHT, WIDTH), int), normals=np.tile(np.float32([0, 0, 1]), (HEIGHT, WIDTH, 1)))
    # The photograph is albedo under even light: the small albedo follows the small photograph exactly.
    full = replace(wall, value=(slow * stripes).astype(np.float32))
    small = smaller(full, 2)
    maps = np.concatenate([small.value, np.full((*small.depth.shape, 2), 0.5)], -1)[None]
    out, _ = enlarged(maps, np.zeros((*small.depth.shape, 3)), small, full, 2)
    assert np.abs(out[0, 4:-4, 4:-4, :3] / full.value[4:-4, 4:-4] - 1).mean() < 0.1  # 0.25 without the photograph
    # The albedo is even, and all that the photograph shows is light.
    maps = np.full((1, *small.depth.shape, 5), 0.5)
    out, _ = enlarged(maps, np.zeros((*small.depth.shape, 3)), small, full, 2)
    assert np.abs(out[0, ..., :3] - 0.5).max() < 0.02


def test_roughness_does_not_cross_borders_of_objects(room):
    view = replace(room[0], object_id=(np.arange(WIDTH)[None] >= 20).astype(int) * np.ones((HEIGHT, 1), int))
    view = replace(view, normals=np.tile(np.float32([0, 0, 1]), (HEIGHT, WIDTH, 1)))
    small = smaller(view, 4)
    maps = np.concatenate([np.full((*small.depth.shape, 3), 0.5), np.where(small.object_id == 1, 0.9, 0.1)[..., None]], -1)
    maps = np.concatenate([maps, np.zeros((*small.depth.shape, 1))], -1)[None]
    out, _ = enlarged(maps, np.zeros((*small.depth.shape, 3)), small, view, 4)
    assert np.abs(out[0, ..., 3] - np.where(view.object_id == 1, 0.9, 0.1)).max() < 0.01


def test_medians_of_objects_are_those_of_all_their_pixels():
    """Whatever views bring them, and without the pixels that do not count; to a bin."""
    rng = np.random.default_rng(0)
    group = np.r_[np.full(40, 5), rng.choice([2, 5, 9], 3000)]  # the first view shows one object alone
    values, clear = rng.normal(0, 1, (3040, 3)), rng.random(3040) < 0.7
    clear[group == 9] = False
    medians = inputs._Medians()
    for part in (slice(0, 40), slice(40, 1700), slice(1700, 3040)):
        medians.add(group[part], values[part], clear[part])
    expected = [np.median(values[clear & (group == g)], 0) for g in (2, 5)]
    assert medians.group.tolist() == [2, 5, 9]
    np.testing.assert_allclose(medians.values(), [*expected, [0, 0, 0]], atol=1 / 64)
