"""Qualities by time and by score, and the bench, through the real workflow."""

import json
import re

import pytest
from support import planned


@pytest.mark.long
def test_a_time_chooses_a_quality_and_says_what_is_expected(workflow):
    result = workflow.run("-n", "scenes/tiny", "--config", "quality=600s")
    assert result.returncode == 0, result.stderr[-4000:]
    found = re.search(r"tiny, 600s: quality (p\d\d).*, about (\d+) s \(.*\), plus about \d+ s to render", result.stderr)
    assert found and float(found[2]) < 600
    assert "config/scenes/tiny.yaml sets capture.height, capture.views, capture.width" in result.stderr
    same = workflow.run("-n", "scenes/tiny", "--config", f"quality={found[1]}")
    assert planned(same) == planned(result) and f"quality {found[1]}, at most " in same.stderr


@pytest.mark.long
def test_what_cannot_be_had_ends_before_any_job_with_one_error(workflow):
    for asked, words in (
        ("quality=3s", "error: --config quality=3s: tiny is expected to take longer on this machine"),
        ("quality=albedo:90", "error: --config quality=albedo:90: the best of the measured qualities, p"),
        ("budget=60", "error: --config budget=60: there is no `budget` any more"),
        ("quality=p77", "error: --config quality=p77: unknown quality."),
    ):
        result = workflow.run("scenes/tiny", "--config", asked)
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
    asked = workflow.run("-n", "scenes/tiny", "--config", f"quality=albedo:{least - 2:.1f}")
    assert "from bench/tiny/bench.json" in asked.stderr and asked.returncode == 0
