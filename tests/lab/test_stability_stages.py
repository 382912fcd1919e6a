"""Relations and digits through the stages: the changes show the same room, and the stages find it again."""

from dataclasses import replace

import numpy as np
import pytest

from lab.stability import chain, digits, extremes, relations, sensitivity
from lab.stability.accuracy import accuracy
from lab.stability.relations import RELATIONS, Distance, Relation


@pytest.fixture(scope="module")
def room(tmp_path_factory, llvm):
    """The tiny room, captured and fitted once: (capture, result, folder)."""
    folder = tmp_path_factory.mktemp("stability")
    capture = chain.make_capture(folder / "capture", chain.ROOMS["tiny"])
    return capture, chain.run(capture, folder / "reference"), folder


def _off_surface(capture):
    """Largest distance of a pixel's point from the face that it shows, relative to the distance from the camera."""
    worst = 0.0
    for view in capture.views:
        face, depth = capture.face[view.name], capture.depth[view.name].astype(np.float64)
        hit = face >= 0
        point = view.world_from_camera[:3, 3] + depth[..., None] * view.directions().astype(np.float64)
        corners = capture.vertices[capture.faces[face[hit]]].astype(np.float64)
        inside = relations._barycentric(point[hit], corners)
        on_plane = (inside[..., None] * corners).sum(1)
        scale = depth[hit] + np.abs(point[hit]).max() * 1e-3  # coordinates are rounded
        apart = np.linalg.norm(on_plane - point[hit], axis=1) / scale
        worst = max(worst, float(apart.max()), float(-inside.min()) - 1e-2)
    return worst


def _shown(capture):
    """Numbers of the objects that photographs show."""
    faces = np.unique(np.concatenate([capture.face[view.name].ravel() for view in capture.views]))
    return set(capture.instance[faces[faces >= 0]].tolist()) - {-1}


@pytest.mark.long
@pytest.mark.parametrize("relation", RELATIONS, ids=lambda relation: relation.name)
def test_changed_captures_show_the_same_room(room, relation):
    capture, result, _ = room
    changed = relation.change(capture, np.random.default_rng(0))
    assert _off_surface(changed) < 1e-3
    assert len(changed.views) >= len(capture.views)
    assert len(_shown(changed)) == len(_shown(capture))
    if changed.names:
        assert {changed.names[i] for i in _shown(changed)} == {capture.names[i] for i in _shown(capture)}
    assert len(np.unique(changed.instance)) >= len(np.unique(capture.instance))
    shapes = {name: raster.shape[:2] for name, raster in changed.photo.items()}
    assert all(shapes[view.name] == (view.height, view.width) for view in changed.views)
    assert all(maps.shape[1:3] == shapes[name] for name, maps in changed.maps.items())


def test_pictures_and_colours_are_turned_back(room):
    capture, result, _ = room
    for name in ("cameras rolled by 90 degrees", "world mirrored", "colour channels permuted"):
        relation = next(one for one in RELATIONS if one.name == name)
        changed = relation.change(capture, np.random.default_rng(0))
        as_if = replace(result, maps={view: _five(changed.photo[view]) for view in changed.photo}, seen=_seen(changed))
        back = relation.undo(as_if)
        for view in capture.views:
            np.testing.assert_array_equal(back.maps[view.name][..., :3], capture.photo[view.name])
            np.testing.assert_array_equal(back.seen[view.name], capture.face[view.name] >= 0)


def _five(photo):
    return np.concatenate([photo, np.zeros((*photo.shape[:2], 2), photo.dtype)], -1)


def _seen(capture):
    return {view.name: capture.face[view.name] >= 0 for view in capture.views}


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "allowed"),
    [
        ("three threads", 1e-12),
        ("faces share no vertices", 1e-6),
        ("vertices permuted", 1e-6),
        ("radiance times 1e+06", 1e-4),
        ("world turned and tilted", 0.1),
    ],
)
def test_stages_find_the_same_room_again(room, name, allowed):
    capture, reference, folder = room
    relation = next(one for one in RELATIONS if one.name == name)
    result = relation.undo(chain.run(relation.change(capture, np.random.default_rng(0)), folder / "changed"))
    found = relations.distance(replace(result, power=result.power / relation.power), reference)
    assert found.albedo < allowed and found.light < max(allowed, 1e-5), found


@pytest.mark.long
def test_the_last_bit_of_the_mesh_does_not_draw_the_light_anew(room):
    capture, reference, folder = room
    result = chain.run(digits.one_ulp(capture, np.random.default_rng(3)), folder / "moved")
    apart = np.concatenate([(result.diffuse[name] - reference.diffuse[name])[reference.seen[name]] for name in reference.diffuse])
    light = np.concatenate([reference.diffuse[name][reference.seen[name]] for name in reference.diffuse])
    assert 0 < np.sqrt((apart**2).mean()) < 2e-3 * np.sqrt((light**2).mean())  # 6e-2 with the noise of other paths
    assert relations.distance(result, reference).albedo < 1e-3


def test_distances_count_what_they_say(room):
    _, reference, _ = room
    assert relations.distance(reference, reference) == Distance(0, 0, 0, 0, 0, 0)
    first = next(iter(reference.maps))
    moved = dict(reference.maps) | {first: reference.maps[first] + np.float32([0.1, 0.1, 0.1, 0.2, 0])}
    found = relations.distance(replace(reference, maps=moved, power=2 * reference.power), reference)
    share = reference.seen[first].sum() / sum(seen.sum() for seen in reference.seen.values())
    assert found.albedo == pytest.approx(0.1 * np.sqrt(share), rel=1e-3) and found.light == pytest.approx(np.log(2))
    assert found.flipped == pytest.approx(share)
    decided = {**reference.decisions, "specular": not reference.decisions["specular"]}
    assert relations.distance(replace(reference, decisions=decided), reference).decisions == 1


def test_a_relation_that_does_not_hold_is_seen(room, monkeypatch):
    capture, reference, folder = room
    monkeypatch.setattr(chain, "make_capture", lambda *_: capture)
    monkeypatch.setattr(chain, "run", lambda changed, _: replace(reference, power=reference.power * changed.emission.sum()))
    monkeypatch.setattr(relations, "SEEDS", 2)
    bad = Relation("lamps twice as bright", lambda c, rng: replace(c, emission=2 * c.emission), relations.EXACT)
    *_, found = relations.measure("tiny", (bad,))
    assert found.beyond == ["light"]


def test_digits_of_known_spreads():
    rng = np.random.default_rng(0)
    values = 5.0 + 1e-4 * rng.standard_normal((400, 3))
    np.testing.assert_allclose(digits.digits_of(values), np.log10(5e4), atol=0.1)
    exact = np.stack([np.ones(4), np.ones(4)])
    assert (digits.digits_of(exact) == digits.MOST_DIGITS).all()
    assert (digits.digits_of(np.array([[-1.0], [1.0]])) == 0).all()


def test_extremes_are_scored_and_what_is_lost_is_counted(room):
    capture, reference, _ = room
    found = accuracy(reference, capture)
    assert found.albedo > 25 and found.albedo >= found.albedo_as_is - 1e-6 and found.lost == 0 and found.light < 0.05
    first = capture.views[0].name
    broken = dict(reference.maps) | {first: np.full_like(reference.maps[first], np.nan)}
    pixels = int((capture.known[first] & reference.seen[first]).sum())
    assert accuracy(replace(reference, maps=broken), capture).lost == 5 * pixels
    twice = accuracy(replace(reference, power=2 * reference.power), capture)
    assert twice.light == pytest.approx(np.log(2), abs=0.05)


SLOW = ("20 million faces hidden",)
CASES = [
    pytest.param(case, id=case.name, marks=[pytest.mark.long] if case.name in SLOW else [])
    for case in extremes.CASES
    if not case.settings
]


@pytest.mark.parametrize("case", CASES)
def test_extreme_captures_are_captures(room, case):
    capture, _, folder = room
    changed = case.change(capture)
    assert changed.faces.max() < len(changed.vertices) and len(changed.instance) == len(changed.faces) == len(changed.emission)
    assert all(np.isfinite(changed.photo[view.name]).all() for view in changed.views)
    if changed.names:
        assert changed.instance.max() < len(changed.names)
    chain._write(changed, folder / "written")


def test_errors_of_the_input_change_what_they_say(room):
    capture, _, _ = room
    rng = np.random.default_rng(0)
    by_name = {factor.name: factor for factor in sensitivity.FACTORS}
    for factor in sensitivity.FACTORS:
        assert len(factor.levels) == 4
        if factor.name not in (sensitivity.PRIOR, sensitivity.SHARED, "number of predictions") and factor.levels[0] == 0.0:
            same = factor.change(capture, 0.0, np.random.default_rng(0))
            assert _off_surface(same) < 1e-3 and len(np.unique(same.instance)) == len(np.unique(capture.instance))
    moved = by_name["poses"].change(capture, 3.0, rng)
    view, other = capture.views[0], moved.views[0]
    turn = other.world_from_camera[:3, :3].T @ view.world_from_camera[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert 0.1 < np.degrees(np.arccos((np.trace(turn) - 1) / 2)) * np.pi / 180 * view.fx < 10
    assert _off_surface(moved) > 1e-3 > _off_surface(sensitivity._retraced(moved))
    holes = by_name["holes in the mesh"].change(capture, 0.2, rng)
    assert 0.7 < len(holes.faces) / len(capture.faces) < 0.9 and holes.emission.sum() == capture.emission.sum()
    parted = by_name["objects parted"].change(capture, 1.0, rng)
    joined = by_name["objects joined"].change(capture, 0.6, rng)
    assert len(np.unique(joined.instance)) < len(np.unique(capture.instance)) < len(np.unique(parted.instance))
    shaken = by_name["vertices of the mesh"].change(capture, 10.0, rng)
    assert (shaken.vertices - capture.vertices).std() == pytest.approx(0.01, rel=0.1)
    same_place = np.unique(capture.vertices, axis=0, return_inverse=True)[1].reshape(-1)
    assert len(np.unique(shaken.vertices, axis=0)) == same_place.max() + 1  # seams stay closed
