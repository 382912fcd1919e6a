"""Free cells over cached shading: the loss as sums, the exact solver, Adam on the same loss, the camera response."""

from dataclasses import replace

import numpy as np
import pytest

from iif_core.camera.response import response
from iif_core.fitting.cell_pixels import AlbedoSums, BlockLight, PixelRows
from iif_core.fitting.levels import interpolate_levels
from lab.baselines import loss as judge
from lab.baselines.adam import AdamOptions, gradient, solve_adam
from lab.baselines.camera import fit_camera
from lab.baselines.direct import METALLIC_GRID, solve_direct
from lab.baselines.loss import FIPT, IRIS, CellFit, CellOptions
from lab.baselines.problem import CellSums
from lab.baselines.texture import blocks_of, cell_albedo
from tests.errors import refused

LEVELS = np.array([0.02, 0.2, 0.5, 0.8, 1.0])
FREE = CellOptions(regulariser=0.0, propagation=0.0)


def plant(cells=120, objects=3, per_cell=6, seed=0, family="identity", params=None, noise=0.0, matte=False):
    """Cells of known materials at levels and grid values of r and m, and what a camera sees of them."""
    rng = np.random.default_rng(seed)
    object_id = rng.integers(0, objects, cells)
    truth = np.zeros((cells, 5))
    truth[:, :3] = rng.uniform(0.15, 0.8, (cells, 3))
    truth[:, 3] = 1.0 if matte else rng.choice(LEVELS, cells)
    truth[:, 4] = 0.0 if matte else rng.choice(METALLIC_GRID, cells)
    cell = np.repeat(np.arange(cells), per_cell)
    n, count = len(cell), len(LEVELS)
    d = rng.uniform(0.1, 0.9, (n, 3)).astype(np.float32)
    s0 = rng.uniform(0.02, 0.9, (n, count, 3)).astype(np.float32)
    s1 = rng.uniform(0.0, 0.02, (n, count, 3)).astype(np.float32)
    exposure = rng.choice([0.4, 0.7, 1.0], n)
    a, r, m = truth[cell, :3], truth[cell, 3], truth[cell, 4:5]
    radiance = (1 - m) * a * d + (0.04 * (1 - m) + m * a) * interpolate_levels(s0, LEVELS, r)[0]
    radiance = radiance + interpolate_levels(s1, LEVELS, r)[0] + noise * rng.normal(size=(n, 3))
    curve = response(family, params)
    if family == "identity":
        value, exposure = radiance, np.ones(n)
    else:
        value = np.minimum(curve(exposure[:, None] * radiance), 0.99)
    rows = PixelRows(
        cell=cell, weight=np.ones(n), diffuse=d, s0=s0, s1=s1, value=value, exposure=exposure, saturated=value >= 0.99
    )
    return rows, object_id, objects, truth, curve


def collect(rows, object_id, objects, curve, dark=0.0):
    sums = CellSums(object_id, objects, LEVELS)
    sums.add(rows, curve, dark)
    return sums.problem()


def test_sums_hold_the_squared_error():
    """The second road: pixel by pixel, at a level."""
    rows, object_id, objects, truth, curve = plant(noise=0.05, family="srgb")
    problem = collect(rows, object_id, objects, curve)
    y, slope = rows.radiance(curve)
    slope = slope * np.where(rows.saturated, 1e-3, 1.0)
    a, m = np.array([0.3, 0.5, 0.7]), 0.4
    radiance = (1 - m) * a * rows.diffuse + (0.04 * (1 - m) + m * a) * rows.s0[:, 2] + rows.s1[:, 2]
    per_pixel = slope * (radiance - y) ** 2
    expected = np.stack([np.bincount(rows.cell, per_pixel[:, c]) for c in range(3)], 1)
    found = judge.data_loss(problem.dd, problem.lobes[:, 2], np.tile(a, (len(object_id), 1)), np.full((len(object_id), 1), m))
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-6)


def test_sums_do_not_depend_on_how_pixels_arrive():
    rows, object_id, objects, _, curve = plant(noise=0.05)
    whole = collect(rows, object_id, objects, curve)
    sums = CellSums(object_id, objects, LEVELS)
    for part in np.array_split(np.arange(len(rows.cell)), 3):
        sums.add(rows.take(part), curve)
    for name in ("dd", "lobes", "pixels", "specular"):
        np.testing.assert_allclose(getattr(sums.problem(), name), getattr(whole, name), rtol=1e-5)


@pytest.mark.parametrize("family", ["identity", "srgb"])
def test_clean_shading_gives_the_truth(family):
    rows, object_id, objects, truth, curve = plant(family=family)
    problem = collect(rows, object_id, objects, curve)
    fit = solve_direct(problem, FREE)
    assert fit.known.all() and fit.history[-1] < 1e-6
    dielectric = truth[:, 4] < 0.95  # of a metal nothing tells the diffuse lobe
    np.testing.assert_allclose(fit.value[dielectric, :3], truth[dielectric, :3], atol=2e-3)
    np.testing.assert_allclose(fit.value[:, 3:], truth[:, 3:], atol=1e-6)


def test_the_search_finds_the_minimum():
    """No random material of a cell is better than what was found, for the whole loss with the part means held."""
    rows, object_id, objects, _, curve = plant(cells=40, noise=0.1, per_cell=3)
    problem = collect(rows, object_id, objects, curve)
    alone = replace(problem, object_id=np.arange(40), n_objects=40)  # the loss of every cell by itself
    for options in (FREE, CellOptions(propagation=0.0)):
        best = judge.losses(alone, solve_direct(problem, options).value, options)
        rng = np.random.default_rng(5)
        for _ in range(1000):
            other = np.concatenate([rng.random((40, 3)), rng.uniform(0.02, 1, (40, 1)), rng.choice(METALLIC_GRID, (40, 1))], 1)
            assert (best <= judge.losses(alone, other, options) + 1e-6).all()


def test_gradient_is_that_of_the_loss():
    rows, object_id, objects, _, curve = plant(cells=30, noise=0.05)
    problem = collect(rows, object_id, objects, curve)
    rng = np.random.default_rng(3)
    value = np.concatenate([rng.uniform(0.2, 0.8, (30, 3)), rng.uniform(0.25, 0.45, (30, 1)), rng.uniform(0.2, 0.8, (30, 1))], 1)
    target, scale, means = np.full((30, 3), 0.4), 0.8, np.tile([0.6, 0.1], (objects, 1))
    options = CellOptions(prior=0.5)

    def cost(v):
        data = judge.data_loss(problem.dd, judge.lobes_at(problem, v[:, 3]), v[:, :3], v[:, 4:]).mean(1) / problem.pixels
        of = means[object_id]
        parts = np.abs(v[:, 3] - of[:, 0]) + np.abs(v[:, 4] - of[:, 1])
        pull = options.prior * ((scale * v[:, :3] - target) ** 2).mean(1)
        return data + options.regulariser * (1 - v[:, 3] + v[:, 4]) + options.propagation * parts + pull

    found = gradient(problem, value, options, target, scale, means)
    for i in range(5):
        step = np.zeros(5)
        step[i] = 1e-5
        np.testing.assert_allclose(found[:, i], (cost(value + step) - cost(value - step)) / 2e-5, rtol=1e-3, atol=2e-6)


@pytest.mark.parametrize("options", [FIPT, IRIS])
def test_direct_is_not_above_adam(options):
    rows, object_id, objects, truth, curve = plant(cells=300, objects=6, noise=0.05, family="srgb", per_cell=4)
    problem = collect(rows, object_id, objects, curve)
    prior = np.tile([0.5, 0.4, 0.3], (300, 1)) if options.prior else None
    direct = solve_direct(problem, options, prior)
    adam = solve_adam(problem, options, prior, AdamOptions(iterations=800))
    ours, theirs = (judge.losses(problem, fit.value, options, prior).sum() for fit in (direct, adam))
    assert ours <= theirs * 1.002
    assert theirs < 1.5 * ours  # the twin does work, so the comparison means something


def test_propagation_makes_parts_uniform():
    rows, object_id, objects, _, curve = plant(noise=0.02)
    problem = collect(rows, object_id, objects, curve)
    spread = []
    for weight in (0.0, 5e-3, 10.0):
        value = solve_direct(problem, CellOptions(propagation=weight)).value
        spread.append(np.mean([value[object_id == o, 3].std() for o in range(objects)]))
    assert spread[0] >= spread[1] > spread[2] and spread[2] < 1e-6


def test_rough_and_dielectric_where_nothing_speaks_against_it():
    """Without specular shading the data are blind to roughness: the regulariser decides."""
    rows, object_id, objects, truth, curve = plant(matte=True)
    rows = PixelRows(**{**rows.__dict__, "s0": 0 * rows.s0, "s1": 0 * rows.s1, "value": rows.diffuse * truth[rows.cell, :3]})
    fit = solve_direct(collect(rows, object_id, objects, curve), FIPT)
    np.testing.assert_allclose(fit.value[:, 3], 1.0)
    np.testing.assert_allclose(fit.value[:, 4], 0.0)
    np.testing.assert_allclose(fit.value[:, :3], truth[:, :3], atol=1e-3)


def test_prior_pulls_where_light_is_wrong():
    """Shading that is wrong by a factor per cell goes into free albedo; the prior of the object takes it out, but its level
    stays free."""
    rows, object_id, objects, truth, curve = plant(cells=200, matte=True)
    colours = np.random.default_rng(9).uniform(0.2, 0.6, (objects, 3))
    truth[:, :3] = colours[object_id]
    wrong = np.exp(0.4 * np.random.default_rng(1).normal(size=(200, 1)))[rows.cell]
    lit = rows.diffuse * truth[rows.cell, :3] + 0.04 * rows.s0[:, -1] + rows.s1[:, -1]
    rows = PixelRows(**{**rows.__dict__, "value": lit, "diffuse": rows.diffuse * wrong})
    problem = collect(rows, object_id, objects, curve)
    errors = []
    for weight in (0.0, 1e-2, 1.0, 100.0):
        options = CellOptions(prior=weight, propagation=0.0)
        fit = solve_direct(problem, options, 0.5 * truth[:, :3], scales=8)
        errors.append(np.std(np.log(np.maximum(fit.value[:, :3], 1e-3) / truth[:, :3])))
    assert errors[0] > errors[1] > errors[2] > errors[3] and errors[3] < 0.1 * errors[0]
    assert fit.scale == pytest.approx(0.5, abs=0.1)  # halved prior, albedo at its own level


@pytest.mark.parametrize("params", [[-0.6, 0.2, 0.1], [-1.0, -0.1, 0.05]])
def test_camera_response_from_cells_under_varied_light(params):
    rows, object_id, objects, truth, curve = plant(cells=400, per_cell=8, family="ggcm", params=params, matte=True)
    sums = CellSums(object_id, objects, LEVELS)
    start = response("ggcm", np.tile([-0.8, 0.0, 0.0], (3, 1)))
    fit = fit_camera(rows, sums, start, truth[:, :3], IRIS, iterations=16)
    x = np.linspace(0, 0.6, 50)[:, None] * np.ones(3)  # what the pixels reach

    def distance(f):  # a free albedo leaves the level open
        return min(np.sqrt(np.mean((f(s * x) - curve(x)) ** 2)) for s in np.geomspace(0.7, 1.4, 71))

    assert distance(fit.response) < 0.006 and distance(fit.response) < 0.2 * distance(start)
    assert fit.history[-1] < 0.1 * fit.history[0]


def test_weights_of_the_fits_in_whose_style_it_is():
    """FIPT: 5e-4 (1 - r + m) and 5e-3 of the distance from the mean of the part; IRIS adds 1e-2 of the squared distance of a."""
    rows, object_id, objects, truth, curve = plant(cells=4, objects=1)
    problem = collect(rows, object_id, objects, curve)
    value = np.c_[np.full((4, 3), 0.4), [0.2, 0.6, 0.6, 0.6], [0.0, 1.0, 1.0, 1.0]]
    prior = np.full((4, 3), 0.7)
    data = judge.losses(problem, value, FREE)
    for options, weight in ((FIPT, 0.0), (IRIS, 1e-2)):
        mean = np.average(value[:, 3:], axis=0, weights=judge.part_weights(problem, value, options))
        away = np.abs(value[:, 3:] - mean).sum(1)
        pull = 5e-4 * (1 - value[:, 3] + value[:, 4]) + 5e-3 * away + weight * (2 * 0.4 - 0.7) ** 2
        found = judge.losses(problem, value, options, prior, scale=2.0) - data
        np.testing.assert_allclose(found, (problem.pixels * pull).sum(), rtol=1e-6)


def test_camera_without_parameters_or_pixels_stays():
    rows, object_id, objects, truth, _ = plant(cells=20)
    sums = CellSums(object_id, objects, LEVELS)
    assert fit_camera(rows, sums, response("srgb"), truth[:, :3]).response.family == "srgb"
    start = response("gamma", np.full((3, 1), 2.0))
    for broken in (rows.take(np.arange(0)), PixelRows(**{**rows.__dict__, "weight": 0 * rows.weight})):
        np.testing.assert_array_equal(fit_camera(broken, sums, start, truth[:, :3]).response.params, start.params)


def test_saturated_values_decide_only_where_nothing_else_does():
    rows, object_id, objects, truth, curve = plant(cells=50, matte=True, family="srgb")
    value, saturated = rows.value.copy(), np.zeros(rows.value.shape, bool)
    first = np.r_[True, np.diff(rows.cell) != 0]
    value[first], saturated[first] = 0.99, True  # one lie per cell
    lied = PixelRows(**{**rows.__dict__, "value": value, "saturated": saturated})
    fit = solve_direct(collect(lied, object_id, objects, curve), CellOptions(propagation=0.0))
    np.testing.assert_allclose(fit.value[:, :3], truth[:, :3], atol=0.02)
    whole = PixelRows(**{**rows.__dict__, "value": np.full(value.shape, 0.99), "saturated": np.ones(value.shape, bool)})
    fit = solve_direct(collect(whole, object_id, objects, curve), FIPT)
    assert fit.known.all() and np.isfinite(fit.value).all() and fit.value[:, :3].min() > 0.5


def test_extremes_are_finite_and_bounded():
    rows, object_id, objects, _, curve = plant(cells=60, objects=4, noise=0.02)
    d, value, s0, cell, exposure = (np.array(getattr(rows, k)) for k in ("diffuse", "value", "s0", "cell", "exposure"))
    d[cell < 5] = 0.0  # no light
    value[(cell >= 5) & (cell < 8)] = np.nan
    s0[(cell >= 8) & (cell < 10)] = np.inf
    exposure[(cell >= 10) & (cell < 12)] = 0.0
    value[(cell >= 12) & (cell < 14)] = -3.0
    value[(cell >= 14) & (cell < 16)] = 1e9
    d[(cell >= 16) & (cell < 18)] = 1e-30
    cell[cell >= 55] = -1  # cells without pixels
    broken = PixelRows(
        cell=cell, weight=rows.weight, diffuse=d, s0=s0, s1=rows.s1, value=value, exposure=exposure, saturated=rows.saturated
    )
    problem = collect(broken, object_id, objects + 1, curve, dark=1e-6)  # and an object without cells
    for options in (FIPT, IRIS):
        prior = np.full((60, 3), 0.4) if options.prior else None
        for solve in (solve_direct, lambda *a: solve_adam(*a, AdamOptions(iterations=40))):
            fit = solve(problem, options, prior)
            assert not fit.known[:12].any() and not fit.known[16:18].any() and not fit.known[55:].any() and fit.known[18:55].all()
            assert np.isfinite(fit.value).all() and (fit.value >= 0).all() and (fit.value <= 1).all() and np.isfinite(fit.scale)
            assert (fit.value[fit.known, 3] >= 0.02).all()
            deviation = judge.albedo_deviation(problem, fit.value)
            assert np.isfinite(deviation).all() and (deviation[~fit.known] == 1).all() and (deviation <= 1).all()


def test_unknown_cells_take_the_mean_of_their_object():
    rows, object_id, objects, _, curve = plant(cells=30, objects=2)
    keep = (rows.cell % 3 > 0) & (object_id[rows.cell] == 0)
    problem = collect(rows.take(keep), object_id, objects, curve)
    fit = solve_direct(problem, FIPT)
    unseen = np.tile([0.5, 0.5, 0.5, 0.9, 0.0], (objects, 1))
    value = judge.fill_unknown(fit, problem, unseen)
    own = (object_id == 0) & ~fit.known
    np.testing.assert_allclose(value[own], np.tile(fit.value[fit.known].mean(0), (own.sum(), 1)))
    np.testing.assert_allclose(value[object_id == 1], np.tile(unseen[0], ((object_id == 1).sum(), 1)))


def test_nothing_at_all():
    sums = CellSums(np.zeros(0, int), 0, LEVELS)
    problem = sums.problem()
    for fit in (solve_direct(problem, FIPT), solve_adam(problem, FIPT, None, AdamOptions(iterations=2))):
        assert fit.value.shape == (0, 5)
    blind = CellSums(np.zeros(4, int), 1, LEVELS).problem()
    fit = solve_direct(blind, FIPT)
    assert not fit.known.any() and fit.history == [0.0]
    assert judge.fill_unknown(CellFit(fit.value, fit.known), blind, np.full((1, 5), 0.5)).min() == 0.5


def test_claimed_deviation_is_that_of_the_noise():
    errors, claims = [], []
    for seed in range(8):
        rows, object_id, objects, truth, curve = plant(cells=300, matte=True, seed=seed)
        rows = PixelRows(**{**rows.__dict__, "s0": 0 * rows.s0, "s1": 0 * rows.s1})
        # Noise of one size in the curve that the loss is measured in.
        clean = rows.diffuse * truth[rows.cell, :3]
        slope = np.sqrt(PixelRows(**{**rows.__dict__, "value": clean}).radiance(curve)[1])
        noise = 0.01 * np.random.default_rng(seed).normal(size=clean.shape)
        problem = collect(PixelRows(**{**rows.__dict__, "value": clean + noise / slope}), object_id, objects, curve)
        fit = solve_direct(problem, FIPT)
        errors.append((fit.value[:, :3] - truth[:, :3]).std())
        claims.append(judge.albedo_deviation(problem, fit.value).mean())
    assert np.mean(claims) == pytest.approx(np.mean(errors), rel=0.15)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: CellSums(np.array([0, 3]), 2, LEVELS), ["object ids", "0 ... 3", "0 ... 1"]),
        (lambda: CellSums(np.array([0]), 1, np.array([1.0, 0.5])), ["cells", "roughness levels"]),
        (lambda: CellOptions(part_weight="area"), ["part_weight", "'area'", "specular, gloss"]),
        (lambda: solve_direct(CellSums(np.array([0]), 1, LEVELS).problem(), IRIS), ["prior albedo", "(1, 3)"]),
        (lambda: PixelRows(**dict.fromkeys(PixelRows.__dataclass_fields__, np.zeros(2))), ["diffuse", "(2,)", "(2, 3)"]),
    ],
)
def test_bad_input(make, words):
    with refused(*words):
        make()


def test_blocks_keep_objects_apart():
    ijk = np.array([[0, 0, 0], [3, 1, 2], [4, 0, 0], [0, 0, 1]])
    block, owner = blocks_of(ijk, np.array([0, 0, 0, 1]), 4)
    assert block[0] == block[1] and len(set(block.tolist())) == 3 and owner[block].tolist() == [0, 0, 0, 1]
    block, owner = blocks_of(np.zeros((0, 3), int), np.zeros(0, int), 4)
    assert len(block) == len(owner) == 0


def test_light_of_blocks_is_the_mean_of_what_is_finite():
    light = BlockLight(3)
    light.add(np.array([0, 0, 2, -1]), np.array([[1.0, 2, 3], [3, 4, 5], [np.nan, 0, 0], [9, 9, 9]]))
    light.add(np.array([0]), np.array([[2.0, 3, 7]]))
    np.testing.assert_allclose(light.mean(), [[2, 3, 5], [0, 0, 0], [0, 0, 0]])


def test_albedo_of_cells_in_known_blocks():
    """Exact without shrinkage; with it a cell without pixels takes its block's, and a pull moves it where the prior is."""
    rows, object_id, objects, truth, curve = plant(cells=60, family="srgb")
    fine = AlbedoSums(61)
    for part in np.array_split(np.arange(len(rows.cell)), 2):
        own = truth[rows.cell[part]]
        fine.add(rows.take(part), LEVELS, own[:, 3], own[:, 4], curve)
    block = np.full((61, 3), 0.3)
    clear = truth[:, 4] < 0.9
    np.testing.assert_allclose(cell_albedo(fine, block, shrink=0.0)[:60][clear], truth[clear, :3], atol=1e-3)
    np.testing.assert_array_equal(cell_albedo(fine, block)[60], [0.3] * 3)
    target = np.full((61, 3), 0.9)
    away = [np.abs(cell_albedo(fine, block, target, weight)[:60] - 0.9).mean() for weight in (0.0, 0.01, 1.0, 1e6)]
    assert away[0] > away[1] > away[2] > away[3] and away[3] < 1e-3
    shrunk = np.abs(cell_albedo(fine, block, shrink=0.5)[:60] - truth[:, :3])[clear].mean()
    assert 0 < shrunk < 0.5 * np.abs(truth[clear, :3] - 0.3).mean()


def test_cells_of_blocks_survive_the_extremes():
    rows, object_id, objects, truth, curve = plant(cells=20)
    d, value = np.array(rows.diffuse), np.array(rows.value)
    d[rows.cell < 4], value[rows.cell == 5] = 0.0, np.nan
    rows = PixelRows(**{**rows.__dict__, "diffuse": d, "value": value})
    fine, own = AlbedoSums(20), truth[rows.cell]
    fine.add(rows, LEVELS, own[:, 3], own[:, 4], curve)
    out = cell_albedo(fine, np.full((20, 3), 0.5))
    assert np.isfinite(out).all() and (out >= 0).all() and (out <= 1).all() and (out[5] == 0.5).all()
    assert (cell_albedo(AlbedoSums(3), np.full((3, 3), 0.2)) == 0.2).all()
