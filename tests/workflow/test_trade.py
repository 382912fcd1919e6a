"""Budgets, targets and the bench through the real workflow."""

import json
import re

import pytest
from support import error_of, planned

from tests.errors import missing, named


def test_a_budget_chooses_a_point_and_says_what_is_expected(workflow):
    result = workflow.run("-n", "scenes/tiny", "--config", "budget=600")
    assert result.returncode == 0, result.stderr[-4000:]
    found = re.search(r"^tiny\W.*?\b600 s\b.*?\b(p\d\d)\b.*?\b(\d+) s \(", result.stderr, re.M)
    assert found and float(found[2]) < 600
    named(result.stderr, "config/scenes/tiny.yaml", "capture.height, capture.views, capture.width")
    same = workflow.run("-n", "scenes/tiny", "--config", f"point={found[1]}")
    assert planned(same) == planned(result) and not missing(same.stderr, found[1])


def test_what_cannot_be_had_ends_before_any_job_with_one_error(workflow):
    for asked, names in (
        ("budget=3", ["--config budget=3", "tiny", "--config point=p01"]),
        ("target=albedo:90", ["--config target=albedo:90", "tiny", "albedo"]),
        ("budget=60 point=p01", ["--config point, budget"]),
        ("point=p77", ["--config point=p77", "p01"]),
    ):
        result = workflow.run("scenes/tiny", "--config", *asked.split())
        named(error_of(result), *names)
        assert "Select jobs" not in result.stderr


@pytest.mark.long
def test_a_bench_runs_three_points_in_the_room_and_targets_follow_it(workflow):
    result = workflow.run("bench/tiny")
    assert result.returncode == 0, result.stderr[-4000:]
    page = (workflow.folder / "bench/tiny/bench.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| p0")]
    found = json.loads((workflow.folder / "bench/tiny/bench.json").read_text())
    assert len(rows) == len(found["points"]) == 3 and all(set(p["scores"]) == {"albedo"} for p in found["points"].values())
    assert "Nothing to be done" in workflow.run("-n", "bench/tiny").stdout
    least = min(point["scores"]["albedo"] for point in found["points"].values())  # four views hold none out
    asked = workflow.run("-n", "scenes/tiny", "--config", f"target=albedo:{least - 2:.1f}")
    assert asked.returncode == 0 and not missing(asked.stderr, "bench/tiny/bench.json")
