"""Exponents with which costs grow, and their tables."""

import json

import pandas as pd
import pytest

from lab.studies.files import Study
from lab.studies.growth import exponent, growth_lines


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_exponent_of_a_power_law(power):
    sizes = [6, 12, 24, 48]
    assert exponent(sizes, [3.0 * size**power for size in sizes]) == pytest.approx(power, abs=1e-12)


def test_fewer_than_two_sizes_have_no_exponent():
    assert exponent([], []) != exponent([], []) and exponent([4, 4], [1, 2]) != 0


def test_tables_have_a_row_for_each_stage():
    study = Study(
        title="t",
        scenes=["a"],
        variants={name: {} for name in ("small", "large", "other")},
        costs=["base", "render"],
        growth={"views": {"large": 16, "small": 4}},
    )
    costs = {
        "small": {"base": {"cpu_seconds": 2.0, "max_rss_mb": 100}, "render": {"cpu_seconds": 1.0, "max_rss_mb": 100}},
        "large": {"base": {"cpu_seconds": 8.0, "max_rss_mb": 100}, "render": {"cpu_seconds": None, "max_rss_mb": 200}},
    }
    rows = [{"scene": "a", "variant": name, "seed": 0, "stage_costs": json.dumps(cost)} for name, cost in costs.items()]
    lines = growth_lines(study, pd.DataFrame(rows), ["a"])
    assert "| stage, CPU s | views 4 | views 16 | exponent | last step |" in lines
    assert "| base | 2.0 | 8.0 | 1.00 | 1.00 |" in lines and "| render | 100 | 200 | 0.50 | 0.50 |" in lines
    assert "| render | 1.0 | nan | nan | nan |" in lines
