"""The measured front of speed and accuracy, and the points that are taken from it."""

import numpy as np
import pandas as pd
from hypothesis import given
from hypothesis import strategies as st

from lab.points import front
from lab.points.picture import Pooled
from lab.studies.files import load_study
from workflow.settings import loading
from workflow.settings.names import REPOSITORY
from workflow.settings.scene import SceneSettings
from workflow.settings.yaml_file import read_yaml
from workflow.trade import points as trade_points


def rows(costs, scores, rooms=("a", "b")):
    columns = ["scene", "variant", "seed", "quantity", "metric", "protocol", "value", "cpu_seconds", "max_rss_mb", "disk_mb"]
    out = []
    for name in costs:
        for room in rooms:
            facts = [costs[name], 100.0, 10.0]
            out.append([room, name, 0, "albedo", "psnr", "scaled", scores[name], *facts])
            out.append([room, name, 0, "rgb", "psnr", "raw", scores[name], *facts])
    return pd.DataFrame(out, columns=columns)


def test_the_front_has_no_point_that_is_dearer_and_worse():
    costs = {"a": 10.0, "b": 20.0, "c": 15.0, "d": 40.0, "e": 41.0}
    scores = {"a": 20.0, "b": 21.0, "c": 19.0, "d": 22.0, "e": 22.5}
    found = front.front(front.pool(rows(costs, scores)))
    assert [one.variant for one in found] == ["a", "b", "e"]  # d and e are closer than a step: the better one is kept
    frame = rows(costs, scores)
    lacking = frame[~((frame["variant"] == "b") & (frame["scene"] == "a"))]
    assert [one.variant for one in front.front(front.pool(lacking))] == ["a", "e"]


@given(st.lists(st.tuples(st.floats(1, 1e4), st.floats(10, 40)), min_size=1, max_size=30))
def test_points_of_the_front_are_apart_and_each_is_better_than_all_cheaper_ones(pairs):
    pooled = sorted((Pooled(str(i), cost, albedo, {}) for i, (cost, albedo) in enumerate(pairs)), key=lambda one: one.cpu_seconds)
    found = front.front(pooled)
    assert found and found[0].cpu_seconds <= front.STEP * pooled[0].cpu_seconds
    for before, after in zip(found, found[1:], strict=False):
        assert after.albedo >= before.albedo + front.LEAST_GAIN
    costs = np.array([one.cpu_seconds for one in found])
    assert (costs[1:] / costs[:-1] >= 1 - 1e-12).all()
    best = max(one.albedo for one in pooled)
    assert found[-1].albedo >= best - front.LEAST_GAIN - 1e-9


def test_the_points_that_are_checked_in_other_rooms_are_those_of_the_front(monkeypatch):
    monkeypatch.chdir(REPOSITORY)
    design = load_study("tradeoff_check").design
    scene = {"source": {"kind": "builtin", "scene": "tiny"}, "prior": {"kind": "simulated"}}

    def settings(layer):
        return SceneSettings.model_validate(loading.merge(scene, layer))

    checked = [settings(design.overrides(run)) for run in design.runs]
    assert checked == [settings(read_yaml(REPOSITORY / f"config/quality/{name}.yaml")) for name in trade_points.points()]
