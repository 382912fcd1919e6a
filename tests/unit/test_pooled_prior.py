"""Prior `pooled`: predictions of several priors as those of one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.errors import InputError
from tests.errors import refused
from workflow.costs.work import SceneSize, work_of
from workflow.priors import Predicted, correction, files, learned, pooled, retinex
from workflow.runtime import fingerprint as fp
from workflow.settings import dump, load
from workflow.settings.prior import predictions


def scene(tmp_path, prior):
    """The dumped settings of a scene with this section `prior`."""
    (tmp_path / "config/scenes").mkdir(parents=True)
    (tmp_path / "config/quality").mkdir()
    (tmp_path / "config/quality/draft.yaml").write_text("{}\n")
    (tmp_path / "config/scenes/room.yaml").write_text(f"source: {{kind: builtin, scene: kitchen}}\nprior: {prior}\n")
    return dump(load("room", "draft", tmp_path))


def test_members_take_the_number_of_the_pool_unless_they_state_their_own(tmp_path):
    found = scene(tmp_path, "{kind: pooled, samples: 3, of: [{kind: learned}, {kind: retinex, samples: 2}]}")["prior"]
    assert [(one["kind"], one["samples"]) for one in found["of"]] == [("learned", 3), ("retinex", 2)]
    assert predictions(found) == 5 and predictions({"kind": "learned", "samples": 4}) == 4


@pytest.mark.parametrize(
    ("prior", "key"),
    [
        ("{kind: pooled}", "prior.of"),
        ("{kind: pooled, of: [{kind: learned}]}", "prior.of"),
        ("{kind: pooled, of: [{kind: learned}, {kind: rgbx, stepps: 3}]}", "prior.of.1.stepps"),
        ("{kind: pooled, of: [{kind: learned}, {kind: pooled, of: []}]}", "prior.of.1.kind"),
        ("{kind: pooled, of: [{kind: learned, samples: 17}, {kind: retinex}]}", "prior.of.0.samples"),
        ("{kind: pooled, of: [{kind: learned}, {kind: retinex}]}\nbase: {predictions: 17}", "base: predictions"),
    ],
)
def test_what_cannot_be_pooled_is_refused_with_its_key(tmp_path, prior, key):
    with refused("config/scenes/room.yaml", key):
        scene(tmp_path, prior)


class Fake:
    """A prior whose k-th prediction is `first + k` hundredths everywhere."""

    def __init__(self, first, samples, scale=None):
        self.first, self.samples, self.scale = first, samples, scale

    def prepare(self, settings, capture, seed, keep, threads=1):
        assert settings.source == "kept" and settings.prior.samples == self.samples
        values = (self.first + np.arange(self.samples) + 0.1 * seed) / 100
        maps = np.broadcast_to(values[:, None, None, None], (self.samples, 2, 3, 5)).astype(np.float32)
        return lambda view: Predicted(maps, self.scale)


@pytest.fixture
def fakes(monkeypatch):
    """Priors `learned` and `retinex`, replaced; the second one states scales."""
    scale = np.full((2, 3, 3), 0.2, np.float32)
    monkeypatch.setattr(retinex, "prepare", Fake(10, 2).prepare)
    monkeypatch.setattr(learned, "prepare", Fake(50, 3, scale).prepare)
    return scale


def settings(**seeds):
    of = [
        {"kind": "retinex", "samples": 2, "seed": seeds.get("retinex")},
        {"kind": "learned", "samples": 3, "seed": seeds.get("learned")},
    ]
    return SimpleNamespace(prior=SimpleNamespace(kind="pooled", samples=8, seed=None, of=of), source="kept")


def test_predictions_stand_in_the_order_of_the_members_with_the_scale_of_the_first_that_states_one(fakes):
    made = pooled.prepare(settings(learned=1), None, 0, lambda array: array)(None)
    assert np.allclose(made.maps[:, 0, 0, 0], [0.10, 0.11, 0.501, 0.511, 0.521])
    assert made.scale is fakes


def test_threads_may_share_a_pool_only_where_they_may_share_all_members(fakes, monkeypatch):
    assert not pooled.prepare(settings(), None, 0, lambda array: array).concurrent
    shared = SimpleNamespace(concurrent=True)
    for module in (retinex, learned):
        monkeypatch.setattr(module, "prepare", lambda *args: shared)
    assert pooled.prepare(settings(), None, 0, lambda array: array).concurrent


def test_the_learned_prior_hands_on_what_it_is_given(monkeypatch):
    monkeypatch.setattr(correction, "Correction", lambda *given: given)
    given = ("settings", "capture", 7, "keep", 2, "light")
    assert learned.prepare(*given) == given


def test_the_facts_are_those_of_each_member_and_state_the_errors_of_the_learned_one():
    facts = pooled.describe(settings())
    assert [one["prior"] for one in facts["of"]] == ["retinex", "learned"]
    assert facts["object_errors"] == learned.describe(None)["object_errors"]


def test_files_of_every_member_are_inputs_and_missing_ones_are_refused(tmp_path, monkeypatch):
    one = tmp_path / "a"
    monkeypatch.setattr(files, "raw_inputs", lambda document: [one / document["prior"]["path"]])
    document = {"prior": {"of": [{"kind": "files", "path": "x"}, {"kind": "learned"}, {"kind": "files", "path": "y"}]}}
    found = pooled.raw_inputs(document)
    assert {one / "x", one / "y"} < set(found) and set(learned.raw_inputs({})) < set(found)
    monkeypatch.undo()
    with pytest.raises(InputError):
        pooled.raw_inputs({"prior": {"of": [{"kind": "files", "path": str(one), "samples": 1}]}, "source": {}})


def test_the_result_depends_on_the_code_of_every_member():
    made = {"prior": {"kind": "pooled", "of": [{"kind": "retinex"}, {"kind": "learned"}]}}
    modules = fp.stage_modules("prior", made)
    for kind in ("retinex", "learned"):
        assert set(fp.stage_modules("prior", {"prior": {"kind": kind}})) < set(modules)


def test_the_forecast_counts_the_predictions_of_all_members(tmp_path):
    document = scene(tmp_path, "{kind: pooled, of: [{kind: learned, samples: 8}, {kind: retinex, samples: 4}]}")
    size = SceneSize(10, 1_000_000, 1000)
    assert work_of("prior", document, size).counts["predictions"] == pytest.approx(12)
    assert work_of("base", document, size).counts["predictions"] == pytest.approx(12)
    assert work_of("second_look", document, size).kind.startswith("learned")
