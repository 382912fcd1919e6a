"""The measurement of intervals: rooms that follow the model, rooms left out, and the file that the product reads."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from iif_core.errors import InputError
from iif_core.fitting.intervals import MeasuredErrors
from iif_core.fitting.problem import Kinds
from lab.benchmarks import object_intervals as measurement
from tests.lab import gates
from workflow.decisions.held import FILE

TRUE = MeasuredErrors(0.01, 0.4, 0.05, dielectric=0.1, metal=0.25, albedo=1.0, roughness=1.0, metallic=1.0)


def room(seed: int, scale: float = 1.0, objects: int = 200) -> measurement.Room:
    """Errors of a room that follow the model, times `scale`."""
    rng = np.random.default_rng(seed)
    truth = np.c_[rng.uniform(0.03, 0.7, (objects, 3)), rng.uniform(0.2, 0.8, objects), np.zeros(objects)]
    level, pixels = rng.uniform(0.03, 0.1, objects), 10 ** rng.uniform(2, 5, objects)
    of_level = level / stats.t.ppf(stats.norm.cdf(1), 4) * rng.standard_t(4, objects)
    hue, additive = TRUE.hue * rng.normal(size=(objects, 3)), np.hypot(TRUE.additive, TRUE.border / np.sqrt(pixels))
    albedo = truth[:, :3] * np.exp(scale * (of_level[:, None] + hue)) + scale * additive[:, None] * rng.normal(size=(objects, 3))
    metal = rng.random(objects) < 0.3
    error = np.hypot(0.04, np.where(metal, TRUE.metal, TRUE.dielectric)) / stats.t.ppf(stats.norm.cdf(1), 4)
    roughness = truth[:, 3] + scale * error * rng.standard_t(4, objects)
    none = np.zeros((objects, 3))
    kinds = Kinds(np.c_[~metal, metal, none[:, 0]].astype(float), none, none + 0.5, none + 0.04, np.ones(objects), none)
    estimate = np.c_[np.clip(albedo, 0, 1), roughness, metal]
    truth[:, 4] = metal
    return measurement.Room(f"r{seed}", estimate, truth, level, 1e-3, np.full(objects, 100.0), pixels, kinds)


def test_errors_of_the_model_are_found_again():
    found = measurement.fitted([room(seed) for seed in range(8)])
    assert found.hue == pytest.approx(TRUE.hue, rel=0.25)
    assert found.additive == pytest.approx(TRUE.additive, rel=0.35) and found.border == pytest.approx(TRUE.border, rel=0.35)
    assert found.dielectric == pytest.approx(TRUE.dielectric, rel=0.25) and found.metal == pytest.approx(TRUE.metal, rel=0.25)
    assert found.albedo == pytest.approx(1.0, abs=0.2) and found.metallic == 1.0


@pytest.mark.long
def test_a_room_is_judged_by_the_others_alone():
    """The room of larger errors is not held by what others say, however many variants of it there are."""
    rooms = [room(seed, objects=80) for seed in range(5)]
    odd = replace(room(9, scale=8.0, objects=80), scene="odd--intervals-small-s0")
    every = [*rooms, odd, replace(odd, scene="odd--intervals-other-s0")]
    shares = [row["albedo"] for row in measurement.left_out(every, every)]
    assert min(shares[:5]) > 0.9 and max(shares[5:]) < 0.7
    assert np.mean([row["albedo"] for row in measurement.left_out(rooms, rooms)]) == pytest.approx(0.95, abs=0.025)


def test_neither_ideal_captures_nor_the_rooms_of_the_gates_set_a_constant():
    names = ("sky--rooms_learned-raw-s0", "sky--intervals-small-s0", "gloss--rooms_learned-raw-s0", "tiny--intervals-captured-s0")
    rooms = [replace(room(seed), scene=name) for seed, name in enumerate(names)]
    assert [told.scene for told in measurement.that_set(rooms)] == [names[0]]
    assert set(measurement.KEPT_BACK) == set(gates.ROOMS)


def test_factors_are_rounded_up():
    assert [measurement._up(value) for value in (1.41306, 2.0, 0.99991, 12.3449)] == [1.414, 2.0, 1.0, 12.35]


def test_too_few_objects_make_no_constants():
    with pytest.raises(InputError):
        measurement.fitted([room(0, objects=5)])


def test_rows_of_a_scene_replace_those_that_it_had(tmp_path, monkeypatch):
    monkeypatch.setattr(measurement, "ROWS", tmp_path / "rows.csv")
    rows = [dict.fromkeys(measurement.COLUMNS, 1.0) | {"scene": scene, "object": 3} for scene in ("b", "a")]
    for row in rows:
        measurement.keep(row["scene"], [row])
    measurement.keep("b", [rows[0] | {"object": 10}, rows[0] | {"object": 9}])
    found = measurement._table()
    assert [(row["scene"], row["object"]) for row in found] == [("a", "3"), ("b", "9"), ("b", "10")]
    first, second = measurement.rooms_of(found)
    assert first.estimate.shape == (1, 5) and second.kinds.brightness.shape == (2, 3) and second.room_error == 1.0


def test_the_constants_of_the_product_are_what_the_table_says():
    rooms = measurement.rooms_of(measurement._table())
    told = measurement.that_set(rooms)
    numbers = (*measurement.HELD, *(f"{name}_width" for name in measurement.HELD), "metals", "metals_held")
    nothing_held = [dict.fromkeys(numbers, 1)]
    found = measurement.document(told, nothing_held, measurement.fitted(told))
    shipped = json.loads(FILE.read_text())
    assert shipped["told_by"] == found["told_by"]
    assert found["errors"] == pytest.approx(shipped["errors"], rel=1e-3, abs=1e-3)


@pytest.mark.long
def test_the_file_of_the_product_is_what_the_table_says():
    """Also how often intervals hold in rooms left out, each of which is fitted anew."""
    rooms = measurement.rooms_of(measurement._table())
    told, captured = measurement.that_set(rooms), [room for room in rooms if measurement.IDEAL not in room.scene]
    found = measurement.document(told, measurement.left_out(captured, told), measurement.fitted(told))
    shipped = json.loads(FILE.read_text())
    assert shipped["rooms"] == found["rooms"]
    for name in found["held"]:
        assert found["held"][name] == pytest.approx(shipped["held"][name], rel=1e-3, abs=1e-3), name
