"""Screening of settings: trajectories, and effects against closed forms."""

import json

import numpy as np
import pytest

from lab.studies.files import MORRIS_LEVELS as LEVELS
from lab.studies.files import load_study
from lab.studies.screening import elementary_effects, ranked, trajectories
from tests.errors import refused

FACTORS = ["a", "b", "c", "d"]


def test_each_step_of_a_trajectory_changes_one_factor_and_each_factor_once():
    runs = trajectories(FACTORS, 3, seed=5)
    assert len(runs) == 3 * (len(FACTORS) + 1) and runs == trajectories(FACTORS, 3, seed=5) != trajectories(FACTORS, 3, seed=6)
    levels = np.array([[int(digit) for digit in run] for run in runs]).reshape(3, len(FACTORS) + 1, len(FACTORS))
    assert levels.min() >= 0 and levels.max() < LEVELS
    steps = np.diff(levels, axis=1)
    assert ((steps != 0).sum(2) == 1).all() and ((steps != 0).sum(1) == 1).all()
    assert (abs(steps[steps != 0]) == LEVELS // 2).all()


def test_effects_of_a_plane_are_its_slopes_and_interaction_shows_as_spread():
    runs = trajectories(FACTORS, 6)
    at = np.array([[int(digit) for digit in run] for run in runs]) / (LEVELS - 1)
    plane = elementary_effects(FACTORS, runs, 3 * at[:, 0] - 2 * at[:, 1] + 7)
    assert [round(plane[name].mean, 9) for name in FACTORS] == [3, -2, 0, 0]
    assert [round(plane[name].mean_size, 9) for name in FACTORS] == [3, 2, 0, 0]
    assert all(plane[name].spread < 1e-9 and plane[name].error < 1e-9 for name in FACTORS)
    assert [name for name, _ in ranked(plane)][:2] == ["a", "b"]
    product = elementary_effects(FACTORS, runs, at[:, 2] * at[:, 3])
    assert product["c"].spread > 0.1 and product["d"].spread > 0.1 and product["a"].mean_size < 1e-9


def study(tmp_path, monkeypatch, runs, count=2):
    """A study of two factors with these runs, loaded."""
    (tmp_path / "lab/config/studies").mkdir(parents=True)
    (tmp_path / "lab/config/studies/scenes.yaml").write_text(
        "a: {source: {kind: builtin, scene: tiny}, prior: {kind: simulated}}\n"
    )
    levels = "{base.ridge: [1, 2, 3, 4], prior.samples: [1, 2, 3, 4]}"
    design = f"{{trajectories: {count}, factors: {levels}, runs: {json.dumps(runs)}}}"
    (tmp_path / "lab/config/studies/s.yaml").write_text(f"title: T\nscenes: [a]\ndesign: {design}\n")
    monkeypatch.chdir(tmp_path)
    return load_study("s")


def test_runs_become_variants_and_a_run_that_is_there_twice_is_one(tmp_path, monkeypatch):
    found = study(tmp_path, monkeypatch, ["00", "20", "22", "22", "02", "00"])
    assert list(found.variants) == ["00", "20", "22", "02"]
    assert found.variants["20"].overrides == {"base": {"ridge": 3}, "prior": {"samples": 1}}


@pytest.mark.parametrize("runs", [["00", "10", "12"], ["00", "22", "20"], ["00", "20", "00"], ["00", "00", "02"]])
def test_runs_that_are_no_trajectories_are_refused(tmp_path, monkeypatch, runs):
    with refused("lab/config/studies/s.yaml", "design.runs", f"'{runs[0]}'"):
        study(tmp_path, monkeypatch, [*runs, "00", "20", "22"])


def test_too_few_runs_for_the_trajectories_are_refused(tmp_path, monkeypatch):
    with refused("s.yaml", "design.trajectories", 3, 9, 6):
        study(tmp_path, monkeypatch, ["00", "20", "22"] * 2, 3)
    with refused(20, 2, 19):
        trajectories(FACTORS, 20)


@pytest.mark.filterwarnings("error")
def test_trajectories_with_an_unknown_score_are_left_out():
    runs = trajectories(FACTORS, 4)
    at = np.array([[int(digit) for digit in run] for run in runs]) / (LEVELS - 1)
    values = 5 * at[:, 3]
    values[7] = np.nan
    assert round(elementary_effects(FACTORS, runs, values)["d"].mean, 9) == 5
    assert all(np.isnan(effect.mean_size) for effect in elementary_effects(FACTORS, runs, np.full(len(runs), np.nan)).values())
