"""Budgets, targets and the bench through the real workflow."""

import json
import re

import pytest
from support import planned


def test_a_budget_chooses_a_point_and_says_what_is_expected(workflow):
    result = workflow.run("-n", "scenes/tiny", "--config", "budget=600")
    assert result.returncode == 0, result.stderr[-4000:]
    found = re.search(r"tiny, budget 600 s: point (p\d\d).*, about (\d+) s \(.*\), plus about \d+ s to render", result.stderr)
    assert found and float(found[2]) < 600
    assert "config/scenes/tiny.yaml sets capture.height, capture.views, capture.width" in result.stderr
    same = workflow.run("-n", "scenes/tiny", "--config", f"point={found[1]}")
    assert planned(same) == planned(result) and f"quality {found[1]}, at most " in same.stderr


def test_what_cannot_be_had_ends_before_any_job_with_one_error(workflow):
    for asked, words in (
        ("budget=3", "error: --config budget=3: tiny is expected to take at least some "),
        ("target=albedo:90", "error: --config target=albedo:90: the best point, p"),
        ("budget=60 point=p01", "error: --config point, budget: each of them chooses the quality"),
        ("point=p77", "error: --config point=p77: unknown point."),
    ):
        result = workflow.run("scenes/tiny", "--config", *asked.split())
        assert result.returncode != 0 and words in result.stderr, result.stderr[-2000:]
        assert "Traceback" not in result.stderr and "Select jobs" not in result.stderr


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
    assert "from bench/tiny/bench.json" in asked.stderr and asked.returncode == 0
