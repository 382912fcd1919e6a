"""The search for the light of a room, on photographs in memory whose light is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.light.emission import emitters, photographs
from iif_core.light.emission import response as light_response
from iif_core.light.emission.cache import RadianceVoxels
from iif_core.light.emission.emitters import METAL
from iif_core.light.emission.find import find_light, look_around
from iif_core.light.emission.groups import EmitterGroups
from iif_core.light.emission.odds import ObjectLooks
from iif_core.light.emission.photographs import choose_rows, escaping_light, radiance_cache, rays_from_surface
from iif_core.light.emission.response import calibrated
from iif_core.light.emission.see_through import seen_through, translucent_objects
from iif_core.light.emission.sun_search import _Rows, find_sun
from iif_core.light.environment import solid_angles
from tests.unit.photographed_room import neighbours, of_views, photographed
from tests.workflow.light_room import BULB, LAMP, SIZE, Room, _quad


class NoTracer:
    """No ray may be traced."""


class Holes:
    """All rays leave the mesh."""

    def meets(self, origins, directions):
        return np.full(len(directions), -1, np.int32), np.full(len(directions), np.inf, np.float32)


@pytest.fixture(scope="module")
def closed(llvm):
    return photographed(Room())


def _found(photos, **asked):
    look = look_around(photos, neighbours(photos))
    return look, find_light(photos, look, **{"environment": False, "is_open": False, **asked})


def _known(photos, threshold):
    return ObjectLooks.of(photos, threshold).known(photos.scene, photos.options.min_observations)


def test_lamps_of_a_closed_room(closed):
    photos, said = closed
    look, light = _found(photos)
    assert (look.primary, look.secondary, look.brightness) == (0, 0, None)
    assert light.outside is None and light.sun is None and not light.is_open
    groups = light.found.groups
    shining = [photos.names[photos.scene.object_id[np.flatnonzero(groups.of_face == g)[0]]] for g in range(groups.size)]
    assert sorted(shining) == ["bulb", "lamp"]
    truth = np.array([{"lamp": [1, 0.95, 0.85], "bulb": [1, 0.8, 0.6]}[name] for name in shining])
    truth *= np.array([{"lamp": LAMP, "bulb": BULB}[name] for name in shining])[:, None]
    np.testing.assert_allclose(light.solution.radiance, truth, rtol=0.05)
    assert light.candidates >= 2 and len(light.reasons) == light.left_out.size and not light.transmittance.any()
    assert any("candidate faces" in line for line in said)
    # Rows on a lamp are anchors and count in no misfit.
    assert light.misfit(np.zeros(len(photos.names), bool)) == pytest.approx(light.found.misfit)
    assert light.misfit(np.ones(len(photos.names), bool)) == np.inf


def test_the_same_light_twice_and_after_forgetting(closed):
    photos, _ = closed
    first = _found(photos)[1]
    photos.forget()
    again = _found(photos)[1]
    np.testing.assert_array_equal(first.solution.radiance, again.solution.radiance)
    np.testing.assert_array_equal(first.found.cache.radiance, again.found.cache.radiance)


def test_a_lamp_that_nobody_sees(llvm):
    parts = {"baffle": _quad((0.5, 0.5, SIZE[2] - 0.4), (3, 0, 0), (0, 2, 0), 4), "bulb": None}
    photos, _ = photographed(Room(parts=parts, lights={"lamp": np.full(3, 50.0)}))
    assert not _known(photos, 1.0)[photos.scene.object_id == photos.names.index("lamp")].any()
    _, light = _found(photos)
    own = np.flatnonzero(light.found.groups.is_hidden)
    assert len(own) == 1 and light.hidden == 1 and "unseen lamp" in " ".join(light.notes)
    assert set(photos.scene.object_id[light.found.groups.of_face == own[0]]) == {photos.names.index("lamp")}


@pytest.mark.parametrize("shines", [True, False])
def test_a_lamp_that_too_few_pixels_show(llvm, shines):
    """It is no candidate; as surface that nobody sees it may shine if what shows it is bright."""
    photos, _ = photographed(Room(lights={"bulb": BULB} if shines else {"lamp": LAMP}))
    bulb = photos.scene.object_id == photos.names.index("bulb")
    shown = sum(int((photos.records[v].pixels.valid & bulb[photos.records[v].pixels.face]).sum()) for v in photos.views)
    photos = replace(photos, options=replace(photos.options, min_observations=shown + 1))
    look, light = _found(photos)
    assert (look.groups.of_face[bulb] < 0).all()
    assert _known(photos, look.threshold)[bulb].any() != shines
    assert light.hidden == shines
    if shines:
        (own,) = np.flatnonzero(light.found.groups.is_hidden)
        assert (light.found.groups.of_face[bulb] == own).all()


def test_light_through_an_open_mesh(llvm):
    photos, _ = photographed(Room(parts=dict.fromkeys(("ceiling", "wall_a", "wall_b", "lamp", "bulb")), lights={}), sky=1.0)
    look, light = _found(photos, environment=True, is_open=True)
    assert look.secondary > 0.3 and look.primary > 0 and look.brightness > 0
    assert light.is_open and light.sun is None and light.outside.size == 12
    assert "twelve directions" in " ".join(light.notes)
    _, dark = _found(photos)
    assert dark.outside is None and dark.misfit(np.zeros(len(photos.names), bool)) > light.misfit(
        np.zeros(len(photos.names), bool)
    )


def test_rays_that_all_leave(closed):
    photos = replace(closed[0], tracer=Holes())
    met = rays_from_surface(photos)
    assert len(met) == 4 * (65536 // 4) and (met == -1).all()


def test_rays_from_no_surface(closed):
    nothing = of_views(closed[0], lambda record: replace(record, pixels=record.pixels.take(np.zeros(0, int))))
    assert rays_from_surface(replace(nothing, tracer=NoTracer())).tolist() == [-1]


def test_light_that_no_camera_ray_brings_has_no_brightness(closed):
    _, share, brightness = escaping_light(closed[0])
    assert share == 0 and brightness is None


def test_share_and_brightness_of_escaping_light():
    """Two views: of 20 and 30 rays, 4 and 6 escape, of radiance 3; the valid pixels of surface show 0.5 and 1."""

    def record(count, escaping, level):
        pixels = SimpleNamespace(valid=np.arange(count - escaping) > 1, value=np.full((count - escaping, 3), level), index=None)
        empty = {"escaping": None, "escaping_share": None, "escaping_direction": np.tile([0, 0, 1.0], (escaping, 1))}
        return SimpleNamespace(pixels=pixels, counted=count, escaping_value=np.full((escaping, 3), 3.0), **empty)

    log = SimpleNamespace(progress=lambda *_: None)
    records = [record(20, 4, 0.5), record(30, 6, 1.0)]
    photos = SimpleNamespace(views=[0, 1], records=records, log=log, radiance=lambda view, value, index: (value, value > 9))
    sky, share, brightness = escaping_light(photos)
    assert sky.pixels == 10 and share == 10 / 50
    assert brightness == pytest.approx(3 * (14 + 22) / (14 * 0.5 + 22 * 1.0))


def test_rows_are_of_pixels_that_show_one_thing(closed):
    """No border pixels of ordinary surface, none on the dark side of a lamp, none that may not be used."""
    photos, _ = closed
    look = look_around(photos, neighbours(photos))
    blind = of_views(photos, lambda r: replace(r, pixels=replace(r.pixels, valid=np.zeros_like(r.pixels.valid))), [1])
    pixels, rows = choose_rows(blind, look.groups, look.threshold)
    assert len(pixels.base) == len(pixels.index) == len(rows.radiance) and set(rows.view) == {0, 2, 3}
    assert pixels.interior[rows.group < 0].all() and rows.rest == look.threshold
    thin = choose_rows(blind, look.groups, look.threshold, thin=4)[1]
    assert 0 < (thin.group < 0).sum() <= 3 * -(-photos.options.rows // 16) < (rows.group < 0).sum()
    again = choose_rows(blind, look.groups, look.threshold)[0]
    np.testing.assert_array_equal(again.number, pixels.number)


def test_a_pixel_of_the_cache_is_a_bound_if_any_channel_is_saturated(monkeypatch):
    monkeypatch.setattr(photographs, "cache_origin", lambda scene, edge: np.zeros(3))
    value = np.array([[0.2, 0.2, 0.2], [0.2, 1.0, 0.2], [1.0, 1.0, 1.0], [0.2, 0.3, np.nan]])
    pixels = SimpleNamespace(
        value=value, index=None, points=np.arange(4)[:, None] + 0.5 * np.ones(3), face=np.arange(4),
        valid=np.ones(4, bool), interior=np.ones(4, bool),
    )  # fmt: skip
    photos = SimpleNamespace(
        options=SimpleNamespace(cache_edge=1.0), views=[0], records=[SimpleNamespace(pixels=pixels)], scene=None,
        radiance=lambda view, value, index: (2 * value, value >= 1), log=SimpleNamespace(progress=lambda *_: None),
    )  # fmt: skip
    voxels, face = photographs.Photographs.cache_pixels.func(photos)
    np.testing.assert_array_equal(face, [0, 1, 2])
    np.testing.assert_array_equal(voxels.censored, [False, True, True])
    np.testing.assert_array_equal(voxels.radiance, 2 * value[:3])


def test_lamps_are_in_no_voxel_of_the_cache(closed):
    photos, _ = closed
    none = EmitterGroups.none(len(photos.scene.faces))
    whole, rest = (radiance_cache(photos, groups) for groups in (none, look_around(photos, neighbours(photos)).groups))
    assert isinstance(rest, RadianceVoxels) and rest.radiance.max() < 0.5 * LAMP < whole.radiance.max()


def test_bounds_are_raised_to_what_surface_reflects_and_at_most_to_the_light(closed, monkeypatch):
    """Albedos are `gain` times the base, or 1: what is shown is `gain` times the traced light, or the light over the base."""
    photos, _ = closed
    groups = look_around(photos, neighbours(photos)).groups
    cache = radiance_cache(photos, groups)
    cache = replace(cache, censored=np.ones(len(cache.radiance), bool))
    traced = []

    def trace_rows(photos, pixels, *_):
        traced.append(1.0 / pixels.base[:, :3])
        n = len(pixels.base)
        return SimpleNamespace(matrix=np.full((2, 1, n, groups.size, 3), 100.0), cached=np.full((2, 1, n, 3), 200.0))

    monkeypatch.setattr(emitters, "trace_rows", trace_rows)
    light = 100.0 * 3 * groups.size + 200.0
    for gain in (0.5, 1e9):
        gains = SimpleNamespace(gain=np.full((len(photos.names), 3), gain))
        found = SimpleNamespace(groups=groups, cache=cache, gains=gains)
        shown = emitters._raised(photos, None, found, cache, np.full((groups.size, 3), 3.0), None).radiance
        expected = np.minimum(gain, traced[-1]) * light
        changed = (shown != cache.radiance).any(1)
        assert changed.sum() > 20 and shown[changed].min() >= expected.min() * 0.999
        assert shown.max() == pytest.approx(expected.max(), rel=1e-5)


def test_no_place_for_a_sun_traces_nothing(closed):
    sky = look_around(closed[0], neighbours(closed[0])).sky
    way = np.random.default_rng(0).normal(size=(20_000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    sky.add(way, np.full(way.shape, 2.0), np.zeros(way.shape, bool))
    known = sky.groups()
    same, evidence = find_sun(replace(closed[0], tracer=NoTracer()), known, 1.0)
    assert same is known and evidence is None and solid_angles(*known.columns.shape).sum() == pytest.approx(4 * np.pi)


def test_what_points_reflect_of_a_white_sky_is_their_albedo():
    """Twice with rays of its own; nothing of the half that a wall hides, and nothing of what is surely a metal."""
    normals, base = np.tile([0.0, 0.0, 1.0], (4, 1)), np.tile([0.2, 0.4, 0.8, 0.5, 0.0], (4, 1))
    base[:, 4] = 0.0, 0.0, METAL, 1.0

    def meets(origins, directions):
        return np.where((origins[:, 0] > 0) & (directions[:, 0] > 0), 0, -1), None

    log = SimpleNamespace(progress=lambda *_: None)
    photos = SimpleNamespace(options=SimpleNamespace(seed=0), tracer=SimpleNamespace(meets=meets), log=log)
    pixels = SimpleNamespace(points=np.eye(4, 3, k=-1), normals=normals, base=base)
    found = _Rows(photos, None, pixels, None, None)._direct(np.arange(16 * 32), (16, 32)).sum(2)
    share = np.array([1.0, 0.5, 1.0, 0.0])
    np.testing.assert_allclose(found, np.broadcast_to(share[:, None] * base[:, :3], (2, 4, 3)), rtol=0.05)
    assert not np.array_equal(*found)


def test_linear_photographs_have_no_response(closed):
    photos, said = closed
    found, camera = calibrated(photos, ("identity",), None, given=True)
    assert camera.response.params.size == 0 and found.gains is photos.gains
    assert any(line.startswith("camera response") for line in said)


def test_patches_that_views_share_have_the_size_of_the_pixels_that_are_looked_at(closed, monkeypatch):
    photos, asked = closed[0], []
    monkeypatch.setattr(light_response, "patch_edge", lambda footprint, extent: asked.append(footprint) or 0.2)
    for share in (1.0, 0.25):
        kept = type(photos.records)(photos.records)
        kept.share = share
        light_response._shared_surface(replace(photos, records=kept))
    sizes = [photos.records[view].median_depth / view.fx for view in photos.views]
    np.testing.assert_allclose(asked, [np.median(sizes), 2 * np.median(sizes)])


def test_a_measured_response_is_taken_as_it_is(closed):
    photos = replace(closed[0], sensor=replace(closed[0].sensor, is_hdr=False))
    curve = photos.sensor.curve
    found, camera = calibrated(photos, (), (curve, "measured: here"), given=True)
    assert found.sensor.curve is curve and camera.reason == "measured: here"


class CurtainRoom(Room):
    """Nothing shines inside; a wall has an opening behind a curtain that lets half of the light through."""

    def __init__(self):
        x, y, _ = SIZE
        curtain = _quad((x - 0.1, 0.3, 0.3), (0, 0, 1.8), (0, y - 0.6, 0), 10)
        super().__init__(parts={"wall_b": None, "curtain": curtain, "lamp": None, "bulb": None}, lights={})
        self.transmittance[self.object_id == self.names.index("curtain")] = 0.5


def test_photographs_of_what_is_behind_a_curtain(llvm):
    photos, _ = photographed(CurtainRoom(), size=32, sky=6.0)
    curtain = np.array([name == "curtain" for name in photos.names])
    through = seen_through(photos, curtain)
    assert photos.scene.transmittance is None and through.scene.transmittance[curtain] == 0.5
    assert through.tracer.scene is through.scene
    shown = 0
    for view in photos.views:
        before, after = photos.records[view], through.records[view]
        on = curtain[before.pixels.object_id] & (before.pixels.object_id >= 0)
        assert not after.pixels.valid[on].any()
        np.testing.assert_array_equal(after.pixels.valid[~on], before.pixels.valid[~on])
        added = after.escaping[len(before.escaping) :]
        assert set(added) <= set(before.pixels.index[on & before.pixels.interior])
        assert (after.escaping_share[len(before.escaping) :] == 0.5).all()
        shown += len(added)
    assert shown > 20
    # Seen from inside, light leaves where the curtain hangs.
    assert escaping_light(through)[1] > escaping_light(photos)[1]


def test_nothing_lets_light_through_where_nothing_glows(closed):
    photos, _ = closed
    dark = np.full(len(photos.scene.faces), -1)
    assert not translucent_objects(replace(photos, tracer=NoTracer()), dark).any()
    assert not translucent_objects(replace(photos, tracer=NoTracer()), np.zeros_like(dark)).any()  # nothing else is left
