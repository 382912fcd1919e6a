"""How likely objects are to be lamps before their light is asked for."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.light.emission import emitters
from iif_core.light.emission.odds import (
    LEAST_PIXELS,
    LIKELY,
    OVERHEAD,
    SATURATED,
    UNLIKELY,
    LampEvidence,
    LampOdds,
    ObjectLooks,
    heights,
)
from tests.unit.photographed_room import of_views, photographed
from tests.workflow.light_room import LAMP, SIZE, Room, _quad
from workflow.scene.light_files import emitter_columns

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def closed(llvm):
    return photographed(Room())[0]


def _number(photos, name):
    return photos.names.index(name)


def _heights(photos, up=UP):
    found, room = heights(photos.tracer, photos.scene, np.arange(photos.scene.n_objects), up)
    assert (room > 0).all() and (room <= np.ptp(photos.scene.vertices @ (up / np.linalg.norm(up))) + 0.1).all()
    return dict(zip(photos.names, found, strict=True))


def test_heights_in_a_closed_room(closed):
    found = _heights(closed)
    assert found["floor"] == pytest.approx(0.0, abs=0.01) and found["ceiling"] == pytest.approx(1.0, abs=0.01)
    assert found["lamp"] > OVERHEAD
    assert all(0.4 < found[name] < 0.6 for name in ("wall_a", "wall_b"))
    # The other way up, and in other units of length.
    turned = _heights(closed, -3.0 * UP)
    assert turned["lamp"] == pytest.approx(1.0 - found["lamp"], abs=1e-6)


def test_heights_where_rays_meet_nothing(llvm):
    """Without a ceiling the highest point of the mesh stands for it: what hangs there is overhead."""
    photos = photographed(Room(parts=dict.fromkeys(("ceiling", "floor"))))[0]
    found = _heights(photos)
    assert found["lamp"] > OVERHEAD and 0.4 < found["wall_a"] < 0.6


@pytest.mark.parametrize("below", [0.002, 0.03])
def test_a_lamp_that_is_flush_with_the_ceiling_is_overhead(llvm, below):
    """Also under an attic, which must not count as its room."""
    spot = _quad((1.0, 1.0, SIZE[2] - below), (0, 0.2, 0), (0.2, 0, 0), 1)
    attic = _quad((0.0, 0.0, SIZE[2] + 1.0), (SIZE[0], 0, 0), (0, SIZE[1], 0), 1)
    found = _heights(photographed(Room(parts={"spot": spot, "attic": attic}))[0])
    assert found["spot"] > OVERHEAD and found["floor"] < 0.1


def test_a_ceiling_of_its_own_counts(llvm):
    """Under a canopy in the lower half of the room, what hangs below it is overhead."""
    canopy = {
        "canopy": _quad((0.5, 0.5, 1.0), (2, 0, 0), (0, 2, 0), 4),
        "spot": _quad((1.0, 1.0, 0.97), (0.2, 0, 0), (0, 0.2, 0), 1),
    }
    photos = photographed(Room(parts=canopy))[0]
    found = _heights(photos)
    assert found["spot"] > OVERHEAD and found["canopy"] < 0.6


def test_looks_count_every_pixel(closed):
    looks = ObjectLooks.of(closed, threshold=1e9)
    total = sum(int(closed.records[view].pixels.valid.sum()) for view in closed.views)
    assert looks.pixels.sum() == total and (looks.inside <= looks.pixels).all()
    assert not looks.bright.any() and not looks.bounded.any() and not looks.is_saturated.any()
    lamp = _number(closed, "lamp")
    bright = ObjectLooks.of(closed, threshold=0.5 * LAMP)
    assert bright.bright[lamp] > 0.9 * bright.pixels[lamp] and bright.bright[_number(closed, "floor")] == 0


def test_surface_of_no_object_is_counted_apart(closed):
    owner = np.where(closed.scene.object_id == 0, -1, closed.scene.object_id)

    def without(record):
        pixels = record.pixels
        return replace(record, pixels=replace(pixels, object_id=np.where(pixels.object_id == 0, -1, pixels.object_id)))

    photos = of_views(replace(closed, scene=replace(closed.scene, object_id=owner)), without)
    before, after = ObjectLooks.of(closed, 1e9), ObjectLooks.of(photos, 1e9)
    assert after.pixels[0] == 0 and after.pixels[-1] == before.pixels[0]
    known = after.known(photos.scene, 8)
    np.testing.assert_array_equal(known, after.faces)


def _saturated(photos, level):
    """The photographs with a sensor that saturates."""
    return replace(photos, sensor=replace(photos.sensor, is_hdr=False, saturation=level))


def test_odds(closed):
    """The lamp hangs at the ceiling and is saturated; the bulb is, and hangs lower; the floor is as usual."""
    photos = _saturated(closed, 0.5)
    looks = ObjectLooks.of(photos, 0.5)
    lamp, bulb, floor = (_number(photos, name) for name in ("lamp", "bulb", "floor"))
    assert looks.is_saturated[lamp]
    odds = LampOdds.of(photos, looks)
    assert odds.odds[lamp] == LIKELY and odds.is_likely[lamp] and odds.is_likely.sum() == 1
    assert odds.odds[floor] == 1.0 and odds.odds[bulb] == 1.0
    # What is seen unsaturated is as likely as is usual.
    assert not LampOdds.of(closed, ObjectLooks.of(closed, 0.5)).is_likely.any()


def test_unseen_surface_is_unlikely_unless_it_is_overhead(closed):
    hidden = {_number(closed, name) for name in ("lamp", "bulb")}

    def without(record):
        seen = ~np.isin(record.pixels.object_id, [*hidden])
        return replace(record, pixels=record.pixels.take(np.flatnonzero(seen)))

    photos = of_views(closed, without)
    odds = LampOdds.of(photos, ObjectLooks.of(photos, 0.5))
    assert odds.odds[_number(photos, "lamp")] == 1.0 and odds.odds[_number(photos, "bulb")] == UNLIKELY
    assert (np.delete(odds.odds, [*hidden]) == 1.0).all()


def test_what_was_built_around_a_scan_is_likely_wherever_it_is(closed):
    made_up = np.isin(np.arange(closed.scene.n_objects), [_number(closed, "bulb"), _number(closed, "wall_a")])
    photos = replace(closed, scene=replace(closed.scene, made_up=made_up))
    assert LampOdds.of(photos, ObjectLooks.of(photos, 0.5)).is_likely.tolist() == made_up.tolist()


@pytest.mark.parametrize(
    "pixels, bounded, is_saturated", [(10, 9, True), (10, 8, False), (4, 4, True), (3, 3, False), (0, 0, False)]
)
def test_saturated_as_a_whole(pixels, bounded, is_saturated):
    assert SATURATED == 0.85 and LEAST_PIXELS == 4
    counts = (np.array([value, 0]) for value in (pixels, 0, bounded, bounded))
    assert ObjectLooks(np.zeros(1, bool), *counts).is_saturated.tolist() == [is_saturated]


def test_a_group_belongs_to_the_object_with_most_of_its_surface():
    scene = SimpleNamespace(object_id=np.array([2, 0, 0, 1, -1]), areas=np.array([1.0, 0.3, 0.3, 5.0, 1.0]))
    groups = SimpleNamespace(of_face=np.array([0, 0, 0, -1, 1]), size=3)
    assert emitters._objects(SimpleNamespace(scene=scene), groups).tolist() == [2, -1, -1]


def test_probability_of_a_lamp_by_hand():
    """A spot overhead that 10 % of the misfit need, a white page below it, unseen surface, and surface within the range."""
    needed = np.array([np.log(1.1), 0.0, np.log(1.1), 0.0, np.inf, -np.inf])
    own = LampEvidence(
        is_likely=np.array([True, False, False, False, True, False]),
        is_saturated=np.array([True, True, False, False, True, False]),
        is_hidden=np.array([False, False, True, False, False, True]),
        needed=needed,
    )
    odds = np.log(own.probability / (1.0 - own.probability))
    slope = 4.3 * np.log(1.1)
    np.testing.assert_allclose(odds, [1.3 + slope, -0.85, -1.3 + slope, -3.5, 1.3 + 4.3, -1.3 - 4.3 * 0.05])
    np.testing.assert_array_equal(own.select(needed > 0).probability, own.probability[needed > 0])
    # An unseen object is not saturated, whatever its family is.
    assert replace(own, is_saturated=np.ones(6, bool)).probability[2] == own.probability[2]


def test_evidence_stands_beside_its_emitters_in_the_table():
    """Two emitters, one direction of the sky, one group that was left out: nothing is known of the last two."""
    evidence = LampEvidence(np.array([True, False]), np.array([True, False]), np.array([False, True]), np.array([0.2, 0.1]))
    zeros = np.zeros(4)
    kept = zeros < 1
    table = emitter_columns(zeros, zeros, np.zeros((4, 3)), np.zeros((4, 3)), zeros, kept, [""] * 4, evidence=evidence)
    np.testing.assert_array_equal(table["probability"], [*evidence.probability, -1.0, -1.0])
    for name in ("is_likely", "is_saturated", "is_hidden", "needed"):
        assert table[name].tolist() == [*getattr(evidence, name).tolist(), *[0] * 2], name
    nothing = emitter_columns(zeros, zeros, np.zeros((4, 3)), np.zeros((4, 3)), zeros, kept, [""] * 4)
    assert (nothing["probability"] == -1.0).all() and not nothing["is_hidden"].any()
