"""What a component of the plan is expected to bring and to cost."""

import json

import pytest

from workflow.decisions import expected
from workflow.decisions.plan import OVERRIDDEN
from workflow.decisions.record import SETTLED, not_probed

CLAIM = {"held_out_db": [4.0, 1.0, 9.0], "cpu_seconds": 0.25, "max_rss_mb": 0.0, "disk_mb": -0.02, "rooms": 5}


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "claims.json"
    file.write_text(json.dumps({"denoiser": {"included": CLAIM}, "environment": {"left_out": CLAIM}}))
    return file


def test_shares_are_of_what_the_scene_is_expected_to_cost(path):
    item = not_probed("denoiser", True, "noise", SETTLED)
    whole = expected.Whole(40.0, 900.0, 50.0)
    found = expected.with_expectation(item, whole, path)
    assert found == {
        **item,
        "expected": {
            "held_out_db": 4.0,
            "held_out_db_range": [1.0, 9.0],
            "rooms": 5,
            "cpu_seconds": 10.0,
            "memory_mb": 0.0,
            "disk_mb": -1.0,
        },
    }
    assert "cpu_seconds" not in expected.with_expectation(item, None, path)["expected"]


def test_what_was_not_measured_is_not_promised(path):
    for item in (not_probed("denoiser", False, "", SETTLED), not_probed("vignetting", True, "", SETTLED)):
        assert expected.with_expectation(item, None, path) == item
    assert "expected" in expected.with_expectation(not_probed("environment", False, "", SETTLED), None, path)


def test_the_whole_is_that_of_the_cost_model(repository, monkeypatch):
    from workflow.runtime import forecast

    monkeypatch.chdir(repository)
    whole = expected.Whole(*forecast.together(expected.STAGES, "kitchen", "draft"))
    costs = [forecast.job_cost(stage, "kitchen", "draft") for stage in expected.STAGES]
    assert whole.cpu_seconds == pytest.approx(sum(cost.cpu_seconds.middle for cost in costs))
    assert whole.memory_mb == max(cost.memory_mb.middle for cost in costs)
    assert forecast.together(expected.STAGES, "no-such-scene", "draft") is None


def test_what_comes_with_the_project_knows_the_components_that_can_be_forced():
    claims = expected.claims()
    assert set(claims) == set(OVERRIDDEN)
    for component, of in claims.items():
        assert "included" in of, component
        for claim in of.values():
            middle, low, high = claim["held_out_db"]
            assert low <= middle <= high and claim["rooms"] >= 1
