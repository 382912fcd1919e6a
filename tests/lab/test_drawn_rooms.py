"""The bed of drawn rooms: rooms, the lamps that are found in them, and the tables over many of them."""

from __future__ import annotations

import numpy as np
import pytest

from iif_core.surface.triangles import face_geometry
from lab.benchmarks import drawn_rooms
from lab.prior import drawn, rooms
from lab.prior.shards import is_held_out
from lab.rooms.lamps_found import lamps_found
from lab.rooms.shapes import sheet
from lab.studies.files import load_study
from lab.studies.variants import scene_overrides
from tests.errors import refused


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
    chosen, reported = (load_study(name).scenes for name in drawn_rooms.STUDIES)
    assert [*chosen, *reported] == [f"{drawn.PREFIX}{number}" for number in numbers] and len(reported) == drawn.REPORTED
    assert drawn_rooms.scene_of(119, "ours").startswith("drawn-119--drawn-") and "--drawn_report-" in drawn_rooms.scene_of(
        120, "ours"
    )


def test_lamps_that_are_found_exactly_miss_nothing_and_are_not_false(room):
    shines = room.emission.any(1)
    found = lamps_found(room, room.vertices, room.faces[shines], room.emission[shines].mean(1))
    assert found.false_m2() == 0 and found.missed_power() == 0
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
    assert found.false_m2() == pytest.approx(3.0) and found.false_power() == pytest.approx(0.5, rel=1e-3)
    sheet_alone = np.arange(len(shining)) >= first.sum()
    assert found.false_m2(~sheet_alone) == 0 and found.false_power(sheet_alone) == found.false_power()
    missed = dict(zip(found.lamp, found.missed, strict=True))
    assert missed.pop(room.object_id[first][0]) == 0 and set(missed.values()) == {1.0}
    others = found.lamp[found.missed > 0]
    assert found.missed_power(others) == 1.0 and np.isnan(found.missed_power(np.array([], int)))
    # In another frame, such as a scan in feet, areas and powers are those of the true room.
    feet = lamps_found(room, every / 0.3048, shining, radiance, back=np.diag([0.3048] * 3 + [1.0]))
    assert feet.false_m2() == pytest.approx(3.0) and feet.false_power() == pytest.approx(0.5, rel=1e-3)


def test_light_through_closed_cloth_is_no_false_lamp_but_a_wall_is(room):
    """Every part of the room shines; those that light passes through, and lamps, are not false."""
    walls = [i for i, name in enumerate(room.names) if name.split(" ")[0] in ("north", "floor")]
    scan = room.scan
    shines = np.isin(scan.material_id, walls)
    area = face_geometry(scan.vertices, scan.faces[shines])[1].sum()
    found = lamps_found(room, scan.vertices, scan.faces[shines], np.ones(shines.sum()))
    assert 0.9 * area < found.false_m2() <= area  # but for what lies within 0.1 m of a lamp
    assert lamps_found(room, scan.vertices, scan.faces[shines], np.ones(shines.sum()), walls).false_m2() == 0


def row(room: int, status: str = "done", **numbers: object) -> dict[str, str]:
    facts = {"room": str(room), "variant": "ours", "fingerprint": f"f{room}", "status": status}
    return dict.fromkeys((*drawn_rooms.HEAD, *drawn_rooms.COLUMNS), "") | facts | {k: str(v) for k, v in numbers.items()}


def test_a_comparison_is_of_pairs_and_tells_who_is_lost():
    before = [row(1, albedo=20.0, false_power=0.1), row(2, albedo=22.0), row(3, albedo=9.0), row(5, "failed: base: no")]
    after = [row(2, albedo=25.0, false_power=0.2), row(1, albedo=21.0, false_power=0.05), row(3, "failed: emission: x")]
    by = {line[0]: line[1:] for line in drawn_rooms.compare(before, after)}
    assert by["rooms with a result"][:3] == ["2", "3", "2"] and by["rooms with a result"][-2:] == ["lost: 3", "new: none"]
    assert by["albedo as it is, dB"] == [
        *("2", "21.00", "23.00", "2.00", "1.00", "1.50", "2.00", "2.50"),
        *("+1.00 (room 1)", "+3.00 (room 2)"),
    ]
    # Less is better, and a room without the number does not count.
    false = by["false lamps, share of the power found"]
    assert false[0] == "1" and false[-1] == false[-2] == "-0.050 (room 1)"


def test_rooms_that_went_wrong_are_counted_among_those_that_tell():
    rows = [
        row(1, base=20.2, gain=-0.5, false_power=0.5, missed_seen=0, false_metal=0.01, metal_found=0.2),
        row(2, base=19.0, gain=0.2, false_power=0.01, missed_seen="nan", metal_found=0.9),
        row(3, "failed: base: no"),
        row(4, "not made"),
    ]
    table = {line[0]: line[1:] for line in drawn_rooms.distribution(rows)}
    assert table["rooms with a result"][0] == "2" and table["rooms with a result"][-1] == "1 of 4 failed"
    assert table["base, as it is, dB"] == ["2", "19.6", "19.0", "19.1", "19.3", "19.6", "19.9", "20.1", "20.2", ""]
    wrong = {name: (line[0], line[-1]) for name, line in table.items() if line[-1]}
    assert wrong["result above base, the lesser of both, dB"] == wrong["false lamps, share of the power found"] == ("2", "1")
    assert wrong["seen lamps missed, share of their power"] == ("1", "0") and wrong["metal found, share of it"] == ("2", "1")


def test_rows_are_kept_where_nothing_changed(monkeypatch, tmp_path, capsys):
    """Of two rooms one has failed: it is looked at again, the other is not, until what measures it changes."""
    asked, marks = [], {0: "a", 1: "b"}

    def row_of(number, variant):
        asked.append(number)
        return row(number, "failed: base: no" if number else "done", albedo=20.0) | {"fingerprint": marks[number]}

    monkeypatch.setattr(drawn, "COUNT", 2)
    monkeypatch.setattr(drawn, "REPORTED", 0)
    monkeypatch.setattr("workflow.runtime.device.mitsuba", lambda: None)
    monkeypatch.setattr(drawn_rooms, "room_row", row_of)
    monkeypatch.setattr(drawn_rooms, "mark", lambda scene: marks[int(scene.split("--")[0].removeprefix(drawn.PREFIX))])
    for expected in ([0, 1], [1], [0, 1]):
        asked.clear()
        drawn_rooms.keep(tmp_path / "rows.csv", "drawn", "ours")
        assert asked == expected
        assert [r["status"][:6] for r in drawn_rooms.read_rows(tmp_path / "rows.csv")] == ["done", "failed"]
        if expected == [1]:
            marks[0] = "changed"
    (tmp_path / "old.csv").write_text("room,albedo\n1,20\n")
    with refused("old.csv"):
        drawn_rooms.read_rows(tmp_path / "old.csv")


def test_rooms_have_different_cameras():
    curves = [drawn.build(number).response for number in range(2, 8)]
    values = [curve(np.linspace(0, 1, 33)[:, None] * np.ones(3)) for curve in curves]
    assert all((np.diff(value, axis=0) > 0).all() and np.allclose(value[[0, -1]], [[0.0] * 3, [1.0] * 3]) for value in values)
    assert len({curve.name for curve in curves}) > 1 and len({value.tobytes() for value in values}) > 3
