"""The published method: light of one bounce, its descent to emitters, its descent to materials (lab/docs/published.md)."""

from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.camera.response import response
from iif_core.fitting.problem import FitProblem
from lab.published.fitting import descent as fitting
from lab.published.light import descent as emission
from lab.published.stages import emission as emission_stage
from lab.published.stages import plan as published_plan
from tests.unit import planted_fit as planted
from tests.unit import transport_rooms as rooms
from workflow.decisions import plan
from workflow.decisions.record import PROVISIONAL, SETTLED

# ------------------------------------------------------------------------------------------------------------ transport


@pytest.fixture(scope="module")
def bounce(llvm):
    from lab.published.light import single_bounce

    return single_bounce


def cache_of(T, vertices, radiance, edge=0.25):
    """A cache with radiance (3,) in every voxel of the bounding box."""
    low, high = vertices.min(0) - edge, vertices.max(0) + edge
    ijk = np.stack(np.meshgrid(*(np.arange(int(np.ceil(n))) for n in (high - low) / edge), indexing="ij"), -1).reshape(-1, 3)
    return T.RadianceCache(edge, low.astype(np.float32), ijk, np.tile(np.float32(radiance), (len(ijk), 1)))


# Roughness, cosine of the view, S0 and S1 of Eq. T.5 in light of radiance 1, by quadrature.
FURNACE = [(0.216, 0.7, 0.849, 0.002), (0.412, 0.4, 0.509, 0.028), (0.608, 1.0, 0.748, 0.0), (1.0, 0.2, 0.503, 0.009)]


@pytest.mark.parametrize(("roughness", "cosine", "s0", "s1"), FURNACE)
def test_lobes_in_constant_light(bounce, T, roughness, cosine, s0, s1):
    vertices, faces = rooms.box((-2, -2, 0), (2, 2, 3), inward=True)
    geometry = T.build_geometry(vertices, faces, np.zeros(len(faces), np.int32))
    world = T.Scene(geometry, None, T.Emitters(geometry, np.zeros((len(faces), 3))), cache_of(T, vertices, (1, 2, 0.5)))
    n = 512
    points, normals = np.tile([0.0, 0.0, 0.0], (n, 1)), np.tile([0.0, 0.0, 1.0], (n, 1))
    wo = np.tile([np.sqrt(1 - cosine**2), 0.0, cosine], (n, 1))
    found = bounce.shade_lobe(world, points, normals, wo, roughness, T.PathOptions(512, 1, 5))
    np.testing.assert_allclose([part.mean(0)[0] for part in found], [s0, s1], atol=0.004)
    np.testing.assert_allclose(found[0].mean(0) / found[0].mean(0)[0], [1, 2, 0.5], rtol=1e-4)
    diffuse, none = bounce.shade_lobe(world, points, normals, wo, None, T.PathOptions(64, 1, 5))
    np.testing.assert_allclose(diffuse, np.tile([1, 2, 0.5], (n, 1)), rtol=1e-5)
    assert not none.any()


def test_paths_of_one_bounce_agree_with_the_path_tracer(bounce, T):
    """Two roads to one number: contributions of emitters times their radiance, and the path tracer that ends in the cache."""
    room = rooms.Room(T)
    emitters = T.Emitters(room.geometry, room.radiance)  # both sides, as published
    world = T.Scene(room.geometry, room.material, emitters, cache_of(T, room.vertices, (0.3, 0.2, 0.1)))
    direction = room.directions[::7]
    origin, step = np.tile(room.origin, (len(direction), 1)), np.zeros((len(direction), 3))
    halves = []
    for seed in range(2):
        paths = bounce.trace_bounce(world, room.group, origin, direction, (step, step), T.PathOptions(256, 1, seed))
        traced = T.render(world, origin, direction, T.PathOptions(256, 1, 10 + seed))
        halves.append((paths.radiance(rooms.ROOM_RADIANCE.astype(float)), traced))
    (ours, theirs), (ours2, theirs2) = halves
    difference = 0.5 * (ours + ours2 - theirs - theirs2)
    noise = 0.5 * np.sqrt(((ours - ours2) ** 2 + (theirs - theirs2) ** 2).sum(0)) / len(direction)
    assert (np.abs(difference.mean(0)) < 4 * noise).all(), (difference.mean(0), noise)
    assert np.abs(difference.mean(0) / theirs.mean(0)).max() < 0.01


def test_gradient_is_the_transpose_of_radiance(bounce):
    rng = np.random.default_rng(0)
    paths = bounce.BouncePaths(rng.integers(0, 50, 400), rng.integers(0, 7, 400), rng.random((400, 3)), rng.random((50, 3)))
    light, by_ray = rng.random((7, 3)), rng.normal(size=(50, 3))
    along = ((paths.radiance(light) - paths.cached) * by_ray).sum(0)
    np.testing.assert_allclose(along, (paths.gradient(by_ray, 7) * light).sum(0), rtol=1e-12)


def test_mixed_measures_brighten_large_lights(bounce, T):
    """A square light of 3 m, 2 m above a white floor: published weights make the floor too bright, the right ones do not."""
    vertices, faces, part = rooms.merge(
        [rooms.quad((-4, -4, 0), (8, 0, 0), (0, 8, 0)), rooms.quad((-1.5, -1.5, 2), (3, 0, 0), (0, 3, 0))]
    )
    geometry = T.build_geometry(vertices, faces, part)
    rows = np.tile(np.float32([1, 1, 1, 1, 0]), (len(faces), 1))
    emitter, dark = np.where(part == 1, 0, -1), np.zeros((len(faces), 3))
    emitters = T.Emitters(geometry, dark, sampling_weight=(part == 1).astype(float))
    world = T.Scene(geometry, T.FaceMaterials(rows), emitters, cache_of(T, vertices, (0, 0, 0)))
    origin, down = np.tile([0.0, 0.0, 1.0], (64, 1)), np.tile([0.0, 0.0, -1.0], (64, 1))
    still, paths = (0 * down, 0 * down), T.PathOptions(512, 1, 3)
    found = [
        bounce.trace_bounce(world, emitter, origin, down, still, paths, mixed).radiance(np.ones((1, 3))).mean()
        for mixed in (False, True)
    ]
    a = 1.5 / 2  # form factor of a square above the middle: four corners of Lambert's formula
    corner = a / np.sqrt(1 + a**2) * np.arctan(a / np.sqrt(1 + a**2)) / np.pi
    assert found[0] == pytest.approx(4 * corner, rel=0.12)  # and 4 % of gloss on top
    assert found[1] / found[0] == pytest.approx(1.64, abs=0.12)


# ------------------------------------------------------------------------------------------------------------- emission


class Planted:
    """Pixels that see emitters through a fixed matrix, traced without noise."""

    def __init__(self, rng, pixels=600, emitters=4):
        self.matrix = rng.uniform(0.02, 0.3, (pixels, emitters)) * (rng.random((pixels, emitters)) < 0.6)
        self.truth = rng.uniform(0.5, 1.5, (emitters, 3))
        self.truth[-1] = 0  # a bright triangle that only reflects
        self.curve, self.exposure = response("srgb"), rng.uniform(0.5, 1.0, pixels)
        self.shown = self.curve(np.clip(self.exposure[:, None] * (self.matrix @ self.truth), 0, 1))
        self.drawn = []

    def trace(self, rows, state, step):
        matrix = self.matrix[rows]
        self.drawn.append(state.sampling)

        class Paths:
            def radiance(self, light):
                return matrix @ light

            def gradient(self, by_ray, emitters):
                return matrix.T @ by_ray

        return Paths()

    def loss(self, rows, radiance):
        return emission.clamped_loss(radiance, self.exposure[rows], self.shown[rows], self.curve)


def test_descent_finds_planted_emitters_and_goes_on_after_a_kill():
    scene = Planted(np.random.default_rng(1))
    options = emission.PublishedOptions(batch=128, rate=20, steps=1500)
    states = list(emission.descend(emission.PublishedState.start(4), 600, scene.trace, scene.loss, options))
    end = states[-1]
    assert end.step == 1500 and len(end.loss) == 1500 and end.loss[-1] < 1e-6
    np.testing.assert_allclose(end.radiance, scene.truth, atol=0.02)
    assert end.keep.tolist() == [True, True, True, False]
    np.testing.assert_array_equal(scene.drawn[0], np.ones(4))  # evenly, and by radiance after the schedule
    np.testing.assert_allclose(scene.drawn[-1], states[1000].radiance.sum(1))
    again = list(emission.descend(states[736], 600, scene.trace, scene.loss, options))[-1]
    np.testing.assert_array_equal(again.stored, end.stored)
    assert again.loss == end.loss


def test_what_never_grew_is_switched_off_at_step_100_unless_nothing_would_remain():
    scene = Planted(np.random.default_rng(2))
    scene.matrix[:, 1] = 0
    options = emission.PublishedOptions(batch=128, rate=20, steps=102)
    end = list(emission.descend(emission.PublishedState.start(4), 600, scene.trace, scene.loss, options))[-1]
    assert end.keep[[0, 1, 2]].tolist() == [True, False, True]
    scene.matrix[:] = 0
    end = list(emission.descend(emission.PublishedState.start(4), 600, scene.trace, scene.loss, options))[-1]
    assert end.keep.all() and (end.stored == emission.START).all() and (end.sampling == 1).all()


def test_loss_and_its_derivative():
    rng = np.random.default_rng(3)
    radiance, shown, exposure = rng.uniform(0.01, 1.2, (40, 3)), rng.random((40, 3)), rng.uniform(0.5, 1, 40)
    curve = response("ggcm")
    value, slope = emission.clamped_loss(radiance, exposure, shown, curve)
    x = curve(np.clip(exposure[:, None] * radiance, 0, 1))
    assert value == pytest.approx(np.mean((np.minimum(x, 0.9) - np.minimum(shown, 0.9)) ** 2))
    for i, c in ((0, 0), (5, 1), (11, 2), (30, 0)):
        moved = radiance.copy()
        moved[i, c] += 1e-6
        numeric = (emission.clamped_loss(moved, exposure, shown, curve)[0] - value) / 1e-6
        assert slope[i, c] == pytest.approx(numeric, abs=1e-7)
    assert not slope[x >= 0.9].any()


def test_bright_triangles_and_the_cube_of_the_cache():
    mean = np.array([[0.2, 0.995, 0.1], [0.99, 0.99, 0.99], [2.0, 2.0, 2.0]])
    assert emission.bright_triangles(mean, np.array([5, 5, 0])).tolist() == [True, False, False]
    assert emission.bright_triangles(mean, np.array([5, 5, 0]), 0.5).tolist() == [True, True, False]
    low, edge = emission.bounding_cube(-1.0, 3.0)
    assert (low, low + 256 * edge) == pytest.approx((-1.04, 3.04))
    assert emission.bounding_cube(2.0, 2.0)[1] > 0


# ------------------------------------------------------------------------------------------------------------ materials


def fit_problem(rng, **changes) -> FitProblem:
    curve = response("srgb")
    return planted.problem_of(rng, value_of=lambda radiance: curve(np.clip(radiance, 0, 1)), **changes)[0]


def test_gradient_of_the_published_loss():
    """Against differences of the loss, where nothing is clamped at the point."""
    rng = np.random.default_rng(4)
    problem, curve = fit_problem(rng), response("ggcm")
    curve = curve.with_params(np.tile(curve.params, (3, 1)))
    affine = planted.planted(rng, 6, 0.1)
    affine[:, 15] = 0.05  # metals
    rows = np.arange(0, len(problem.object_id), 3)
    value, gradient, by_params = fitting.loss_and_gradient(problem, rows, affine, curve)
    for o in (0, 4):
        for i in range(16):
            step = np.zeros_like(affine)
            step[o, i] = 1e-6
            up, down = (fitting.loss_and_gradient(problem, rows, affine + s * step, curve)[0] for s in (1, -1))
            assert gradient[o, i] == pytest.approx((up - down) / 2e-6, abs=2e-7), (o, i)
    for c in range(3):
        for i in range(3):
            step = np.zeros((3, 3))
            step[c, i] = 1e-6
            up, down = (
                fitting.loss_and_gradient(problem, rows, affine, curve.with_params(curve.params + s * step))[0] for s in (1, -1)
            )
            assert by_params[c, i] == pytest.approx((up - down) / 2e-6, abs=2e-7), (c, i)


def test_clamped_numbers_and_pixels_do_not_pull():
    problem, curve = fit_problem(np.random.default_rng(5)), response("srgb")
    rows = np.arange(len(problem.object_id))
    bright = np.tile(fitting.IDENTITY, (6, 1))
    bright[:, [3, 7, 11]] = 2.0  # all albedos above 1
    bright[:, 13], bright[:, 15] = 2.0, -1.0
    _, gradient, _ = fitting.loss_and_gradient(problem, rows, bright, curve)
    assert not gradient.any()


def test_levels_are_joined_by_straight_lines():
    levels, shading = np.array([0.02, 0.216, 0.412]), np.array([[[1.0], [3.0], [2.0]]]).repeat(5, 0)
    r = np.array([0.0, 0.02, 0.118, 0.314, 0.9])
    value, slope = fitting.interpolate_linearly(shading, levels, r)
    np.testing.assert_allclose(value[:, 0], [1, 1, 2, 2.5, 2])
    np.testing.assert_allclose(slope[2:4, 0], [2 / 0.196, -1 / 0.196])


def test_descent_lowers_the_loss_and_goes_on_after_a_kill():
    problem, curve = fit_problem(np.random.default_rng(6)), response("ggcm")
    options = fitting.PublishedOptions(rate=2.0, batch=64)
    states = list(fitting.descend(problem, curve, fitting.PublishedState.start(6, curve), options))
    assert [state.step for state in states] == [38, 76, 114]
    again = list(fitting.descend(problem, curve, states[0], options))
    np.testing.assert_array_equal(again[-1].affine, states[-1].affine)
    np.testing.assert_array_equal(again[-1].params, states[-1].params)
    fit = fitting.fit_published(problem, curve, options)
    np.testing.assert_array_equal(fit.affine, states[-1].affine)
    assert fit.converged and fit.iterations == 114 and len(fit.history) == 3 and fit.history[-1] < 0.7 * fit.history[0]
    assert (fit.pixels == 400).all() and (fit.residual > 0).all()
    seen = []
    resumed = fitting.fit_published(problem, curve, options, states[1], seen.append)
    np.testing.assert_array_equal(resumed.affine, fit.affine)
    assert resumed.history == fit.history and [state.step for state in seen] == [114]


@pytest.mark.parametrize(("steps", "per_epoch"), [(3, 1), (114, 38), (200, 67)])
def test_a_descent_of_so_many_steps(steps, per_epoch):
    """An epoch takes its share of the steps, however often it passes over the pixels."""
    problem, curve = fit_problem(np.random.default_rng(6)), response("ggcm")
    options = fitting.PublishedOptions(rate=2.0, batch=64, steps=steps)
    states = list(fitting.descend(problem, curve, fitting.PublishedState.start(6, curve), options))
    assert [state.step for state in states] == [per_epoch, 2 * per_epoch, 3 * per_epoch]
    again = list(fitting.descend(problem, curve, states[0], options))
    np.testing.assert_array_equal(again[-1].affine, states[-1].affine)
    fit = fitting.fit_published(problem, curve, options)
    assert fit.converged and fit.iterations == 3 * per_epoch and len(fit.history) == 3
    passes = fitting.fit_published(problem, curve, fitting.PublishedOptions(rate=2.0, batch=64))
    assert np.array_equal(passes.affine, fit.affine) == (steps == 114)  # one pass an epoch


def test_a_descent_that_leaves_the_finite_numbers_says_so():
    problem, curve = fit_problem(np.random.default_rng(7)), response("ggcm")
    fit = fitting.fit_published(problem, curve, fitting.PublishedOptions(rate=1e9, batch=64))
    assert not fit.converged and "diverged" in fit.reason and (fit.affine == fitting.IDENTITY).all()


def test_pixels_of_no_object_and_no_pixels():
    problem = fit_problem(np.random.default_rng(8))
    none = problem.take(np.zeros(0, np.int64))
    fit = fitting.fit_published(none, response("srgb"))
    assert fit.converged and not fit.free.any() and (fit.affine == fitting.IDENTITY).all() and fit.iterations == 0


def test_the_published_method_is_not_planned():
    of = {item["component"]: item for item in published_plan.not_planned()}
    assert of["specular"]["status"] == SETTLED and of["environment"]["status"] == PROVISIONAL
    later = plan.later(False, True, set(of))
    assert not {item["component"] for item in later} & set(of)


@pytest.mark.parametrize(("solver", "bright"), [("published", [1]), ("published_repaired", [])])
def test_the_cache_holds_radiance_whatever_the_exposure(monkeypatch, solver, bright):
    """Two photographs of the same three triangles, of radiance 0.2, 1.2, 0.8, exposed by 0.5 and 0.25: nothing is saturated."""
    radiance, exposure, curve = np.array([0.2, 1.2, 0.8]), np.array([0.5, 0.25]), response("gamma", [2.0])
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 1]])

    class Decoded:
        def __init__(self, *_):
            pass

        def pixels(self, view, _):
            value = curve(exposure[view] * radiance[:, None] * np.ones(3))
            fields = {"points": points, "value": value, "face": np.arange(3), "index": np.arange(3), "valid": np.ones(3, bool)}
            return SimpleNamespace(**fields, take=lambda rows: SimpleNamespace(**{k: v[rows] for k, v in fields.items()}))

    monkeypatch.setattr(emission_stage, "DecodedViews", Decoded)
    settings = SimpleNamespace(emission=SimpleNamespace(solver=solver))
    job = SimpleNamespace(read=lambda _: None, settings=settings, progress=lambda *_: None)
    capture, scene = SimpleNamespace(used=[0, 1]), SimpleNamespace(faces=np.zeros((3, 3)), normals=None)
    pool, cache, shine, count = emission_stage._read(job, capture, scene, exposure, curve)
    np.testing.assert_allclose(np.sort(cache.radiance[:, 0]), np.sort(radiance), rtol=1e-5)
    np.testing.assert_array_equal(np.flatnonzero(shine), bright)
    np.testing.assert_array_equal(count, 2)
    np.testing.assert_array_equal(pool.view, np.repeat([0, 1], 3))
