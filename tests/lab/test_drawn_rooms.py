"""The bed of drawn rooms: rooms, the lamps that are found in them, and the tables over many of them."""

from __future__ import annotations

import numpy as np
import pytest

from iif_core.surface.triangles import face_geometry
from lab.benchmarks import drawn_rooms
from lab.prior import rooms
from lab.prior.shards import is_held_out
from lab.rooms import drawn
from lab.rooms.lamps_found import lamps_found
from lab.rooms.shapes import sheet
from lab.studies.variants import scene_overrides


@pytest.fixture(scope="module")
def room():
    return drawn.build(0)


def test_a_number_is_a_room_that_training_never_saw(room, monkeypatch):
    seeds = []
    build = rooms.build
    monkeypatch.setattr(rooms, "build", lambda seed: seeds.append(seed) or build(seed))
    again, other = drawn.build(0), drawn.build(1)
    for name in ("vertices", "faces", "object_id", "emission", "shots", "environment"):
        np.testing.assert_array_equal(getattr(room, name), getattr(again, name))
    assert len(set(room.names)) == len(room.names) == room.object_id.max() + 1
    assert len(room.cameras(14)) == 14 and other.size.tolist() != room.size.tolist()
    assert len(set(seeds)) == 2 and all(is_held_out(seed) and seed >= drawn.FIRST for seed in seeds)


def test_every_drawn_room_is_a_scene_of_studies():
    scenes = scene_overrides()
    numbers = [scenes[f"{drawn.PREFIX}{number}"]["source"]["room"] for number in range(drawn.COUNT)]
    assert numbers == list(range(drawn.COUNT)) and f"{drawn.PREFIX}{drawn.COUNT}" not in scenes
    assert scenes["drawn-0"]["capture"]["realism"] == "as_captured"
    assert [*drawn_rooms.CHOOSE, *drawn_rooms.REPORT] == numbers and len(drawn_rooms.REPORT) == drawn.REPORTED


def test_lamps_that_are_found_exactly_miss_nothing_and_are_not_false(room):
    shines = room.emission.any(1)
    found = lamps_found(room, room.vertices, room.faces[shines], room.emission[shines].mean(1))
    assert found.false_m2 == 0 and found.missed_power() == 0
    area = face_geometry(room.vertices, room.faces)[1]
    np.testing.assert_allclose(found.power.sum(), (area * room.emission.mean(1)).sum(), rtol=1e-6)


def test_a_lamp_alone_leaves_the_others_missed_and_a_false_one_has_its_area(room):
    """The first lamp is found, and a sheet of 2 m x 1.5 m in the middle of the room that emits as much."""
    first = room.object_id == np.unique(room.object_id[room.emission.any(1)])[0]
    area = face_geometry(room.vertices, room.faces)[1]
    true = float((area * room.emission.mean(1))[first].sum())
    vertices, faces = sheet((*(room.size[:2] / 2 - 1), 1.2), (2, 0, 0), (0, 1.5, 0))
    every = np.concatenate([room.vertices, vertices])
    shining = np.concatenate([room.faces[first], faces + len(room.vertices)])
    radiance = np.r_[room.emission[first].mean(1), np.full(len(faces), true / 3.0)]
    found = lamps_found(room, every, shining, radiance)
    assert found.false_m2 == pytest.approx(3.0) and found.false_power == pytest.approx(0.5, rel=1e-3)
    missed = dict(zip(found.lamp, found.missed, strict=True))
    assert missed.pop(room.object_id[first][0]) == 0 and set(missed.values()) == {1.0}
    others = found.lamp[found.missed > 0]
    assert found.missed_power(others) == 1.0 and np.isnan(found.missed_power(np.array([], int)))
    # In another frame, such as a scan in feet, areas and powers are those of the true room.
    feet = lamps_found(room, every / 0.3048, shining, radiance, np.diag([0.3048] * 3 + [1.0]))
    assert feet.false_m2 == pytest.approx(3.0) and feet.false_power == pytest.approx(0.5, rel=1e-3)


def row(room: int, **numbers: object) -> dict[str, str]:
    return {"room": str(room), "variant": "ours", "status": "done"} | {name: str(value) for name, value in numbers.items()}


def test_a_comparison_is_of_pairs():
    before = [row(1, albedo=20.0, false_power=0.1), row(2, albedo=22.0, false_power=""), row(3, albedo=9.0)]
    after = [row(2, albedo=25.0, false_power=0.2), row(1, albedo=21.0, false_power=0.05), row(4, albedo=99.0)]
    by = {line[0]: line[1:] for line in drawn_rooms.compare(before, after)}
    assert by["albedo as it is, dB"] == [
        *("2", "21.00", "23.00", "2.00", "1.00", "1.50", "2.00", "2.50"),
        *("+1.00 (room 1)", "+3.00 (room 2)"),
    ]
    # Less is better, and a room without the number does not count.
    assert by["false lamps, share of the power"][0] == "1"
    assert by["false lamps, share of the power"][-1] == by["false lamps, share of the power"][-2] == "-0.050 (room 1)"


def test_rooms_that_went_wrong_are_counted():
    rows = [
        row(1, albedo=20.0, base=20.2, albedo_scaled=21, base_scaled=20, false_power=0.5, missed_seen=0, false_metal=0.01),
        row(2, albedo=20.0, base=19.0, albedo_scaled=20, base_scaled=20.4, false_power=0.01, missed_seen="nan"),
    ]
    assert [line[1] for line in drawn_rooms.counts(rows)] == ["1 of 2", "1 of 2", "0 of 2", "1 of 2"]
    table = {line[0]: line[1:] for line in drawn_rooms.distribution(rows)}
    assert table["base, as it is, dB"] == ["2", "19.6", "19.0", "19.1", "19.3", "19.6", "19.9", "20.1", "20.2"]


def test_rooms_that_only_report_are_run_on_demand(monkeypatch, tmp_path):
    ran = []
    monkeypatch.setattr(drawn_rooms, "run", lambda folder, numbers, *rest: ran.append(list(numbers)))
    last = len(drawn_rooms.CHOOSE)
    for more in ([], ["--report"]):
        monkeypatch.setattr("sys.argv", ["drawn_rooms.py", str(tmp_path), "--rooms", f"{last - 1}:{last + 2}", *more])
        drawn_rooms.main()
    assert ran == [[last - 1], [last - 1, last, last + 1]]
