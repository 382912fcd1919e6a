"""Corrections by hand (`materials`): given values stay exactly as they are, and everything else is still fitted."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.camera.response import response
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.gauge import Gauge, apply_gauge
from iif_core.fitting.problem import FitOptions
from iif_core.fitting.selection import ROUGHNESS_GRID, Profile, choose_kinds
from tests.errors import misset, refused
from tests.unit.planted_fit import problem_of
from workflow.decisions import materials
from workflow.fitting import asked
from workflow.registry import STAGES
from workflow.scene.named import object_number
from workflow.settings.scene import SceneSettings

NAN = np.nan
NAMES = ["floor", "window frame", "door"]
METALLIC, ROUGHNESS = slice(14, 16), slice(12, 14)


@pytest.mark.parametrize("select", [True, False])
def test_given_values_stay_exactly_and_others_change_little(select):
    problem, _ = problem_of(np.random.default_rng(0), n_objects=6, per_object=600, noise=0.2, halves=2)
    options = FitOptions(select=select, population=select)
    given = np.full((6, 2), NAN)
    given[1], given[3, 0], given[4, 1] = (0.6, 1.0), 0.37, 0.0
    free = fit_affines(problem, response("identity"), options)
    held = fit_affines(replace(problem, given=given), response("identity"), options)
    for fit in (held, apply_gauge(problem, held, Gauge("prior"))):
        assert fit.affine[1, ROUGHNESS].tolist() == [0, 0.6] and fit.affine[1, METALLIC].tolist() == [0, 1]
        assert fit.affine[3, ROUGHNESS].tolist() == [0, 0.37] and fit.affine[4, METALLIC].tolist() == [0, 0]
        assert not fit.free[1, 12:].any() and not fit.free[3, ROUGHNESS].any()
        assert not fit.covariance[1, 12:].any() and not fit.covariance[3, ROUGHNESS].any()
    assert held.free[1, :12].any() and held.free[3, :12].any() and held.free[4, 13]  # the rest of them is fitted
    assert np.isfinite(held.affine).all() and np.isfinite(held.covariance).all()
    others = [0, 2, 5]
    np.testing.assert_allclose(held.affine[others][:, [0, 5, 10]], free.affine[others][:, [0, 5, 10]], atol=0.05)
    assert held.residual[1] > free.residual[1]  # a metal it is not: the photographs contradict, and what is given stays
    assert "roughness given, metallic given" in held.model[1] and "given" not in held.model[0]


def test_a_right_value_helps():
    """A given roughness that is true brings the albedo of its object nearer to the truth, and no farther from it."""
    problem, truth = problem_of(np.random.default_rng(3), n_objects=4, per_object=500, noise=0.3, halves=2)
    flat = truth.copy()
    flat[:, 12], flat[:, 13] = 0.0, [0.2, 0.35, 0.5, 0.3]
    problem, _ = problem_of(np.random.default_rng(3), n_objects=4, per_object=500, truth=flat, noise=0.3, halves=2)
    given = np.column_stack([flat[:, 13], np.zeros(4)])
    free = fit_affines(problem, response("identity"), FitOptions())
    held = fit_affines(replace(problem, given=given), response("identity"), FitOptions())
    error = [np.abs(fit.affine[:, [0, 5, 10]] - flat[:, [0, 5, 10]]).mean() for fit in (free, held)]
    assert error[1] <= error[0] + 1e-3
    assert (held.affine[:, 13] == flat[:, 13]).all()


def test_objects_without_pixels_take_what_is_given():
    problem, _ = problem_of(np.random.default_rng(1), n_objects=4, per_object=400)
    some = problem.take(np.flatnonzero(problem.object_id != 2))
    given = np.full((4, 2), NAN)
    given[2] = 0.25, 1.0
    fit = fit_affines(replace(some, given=given), response("identity"), FitOptions())
    assert fit.affine[2, 12:].tolist() == [0, 0.25, 0, 1] and not fit.free[2].any()
    assert fit.model[2] == "population (0 pixels), roughness given, metallic given"


def test_kinds_are_chosen_among_those_that_agree_with_what_is_given():
    """Also where the rules against rough metals would exclude it, and where no such kind was tried."""
    rng = np.random.default_rng(0)
    cost = rng.uniform(1, 2, (4, 3, len(ROUGHNESS_GRID)))
    cost[:, 2] = np.inf
    cost[3, 1] = np.inf
    found = Profile(cost, np.zeros((*cost.shape, 16)), np.full(4, 1.0))
    given = np.array([[NAN, NAN], [0.98, 1.0], [NAN, 1.0], [0.3, 1.0]])
    base = np.full((4, 5), 0.5)
    choice = choose_kinds(found, np.ones(4, bool), base, np.full(4, 100), given)
    assert choice.kind[1:].tolist() == [1, 1, 1]
    assert choice.roughness[1] == pytest.approx(0.98) and choice.roughness[3] == pytest.approx(0.32)
    assert np.isfinite(choice.kinds.probability).all() and np.isfinite(choice.deviation).all()
    free = choose_kinds(found, np.ones(4, bool), base, np.full(4, 100))
    assert free.kind[1] == 0  # a rough metal is none, unless somebody knows better


def job_of(monkeypatch, lobes=True, **entries):
    monkeypatch.setattr(asked, "has_lobes", lambda job: lobes)
    rows = {key: SimpleNamespace(**{"roughness": None, "metallic": None, **value}) for key, value in entries.items()}
    return SimpleNamespace(scene="kitchen", settings=SimpleNamespace(materials=SimpleNamespace(**rows)))


def test_objects_are_named_by_name_or_id(monkeypatch):
    given = asked.given_materials(job_of(monkeypatch, **{"window frame": {"metallic": 0.0}, "2": {"roughness": 0.6}}), NAMES)
    assert np.isnan(given[0]).all() and given[1, 1] == 0 and np.isnan(given[1, 0]) and given[2, 0] == 0.6
    assert asked.given_materials(job_of(monkeypatch), NAMES) is None
    assert materials.given_words(3, given) == ["", "metallic", "roughness"]
    record = materials.given_by_hand(NAMES, given)
    assert record["status"] == "forced" and "window frame (metallic); door (roughness)" in record["reason"]


@pytest.mark.parametrize(
    "entries, lobes, names",
    [
        ({"windw frame": {"metallic": 0.0}}, True, ["'windw frame'", "'window frame'"]),
        ({"7": {"metallic": 0.0}}, True, ["'7'", "floor, window frame, door"]),
        ({"door": {"metallic": 0.0}, "2": {"roughness": 0.5}}, True, ["'door'", 2]),
        ({"door": {"metallic": 1.0}}, False, ["components: {specular: on}"]),
    ],
)
def test_what_cannot_be_given_is_said(monkeypatch, entries, lobes, names):
    with refused("config/scenes/kitchen.yaml", "materials", *names):
        asked.given_materials(job_of(monkeypatch, lobes, **entries), NAMES)


def test_equal_names_need_the_id():
    with refused("materials", "'chair'", 2, "[0, 1]"):
        object_number("chair", ["chair", "chair"], "materials")
    assert object_number("1", ["chair", "chair"], "materials") == 1
    assert object_number("1", ["wall", "floor", "1"], "materials") == 2  # names come first


def test_objects_with_a_word_of_what_was_asked_for_come_first():
    names = [f"grey piece {i}" for i in range(20)] + ["white wall 1", "white wall 2"]
    with refused("materials", "'wall'", "such as white wall 1, white wall 2, grey piece 0"):
        object_number("wall", names, "materials")


def settings_of(materials, **more):
    tree = {"source": {"kind": "builtin", "scene": "kitchen"}, "prior": {"kind": "simulated"}, "materials": materials, **more}
    return SceneSettings.model_validate(tree)


def test_settings_take_ids_and_refuse_the_rest():
    assert settings_of({7: {"metallic": 0}, "door": {"roughness": 0.6}}).materials["7"].metallic == 0
    for bad, *fault in (
        ({"door": {}}, "materials.door", "value_error", "roughness", "metallic"),
        ({"door": {"roughness": 0}}, "materials.door.roughness", "greater_than_equal", 0.02),
        ({"door": {"metallic": 2}}, "materials.door.metallic", "less_than_equal", 1),
        ({"door": {"albedo": [1, 1, 1]}}, "materials.door", "value_error", "albedo", "white_patch"),
        ({"door": {"metalic": 1}}, "materials.door.metalic", "extra_forbidden"),
    ):
        with misset(*fault):
            settings_of(bad)


def test_only_the_fit_and_what_follows_it_read_them():
    readers = {name for name, stage in STAGES.items() if any(key.split(".")[0] == "materials" for key in stage.settings)}
    assert readers == {"affines"}
