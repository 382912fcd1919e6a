"""Captures as they are: each error of real captures as a function, its setting, and captures that have them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.camera.pinhole import look_at, project
from iif_core.camera.view import View
from iif_core.surface.closest import closest_points
from iif_core.surface.triangles import face_geometry
from lab import rooms
from lab.loose import Loose, document_of
from lab.rooms import shapes
from lab.settings.capture import IDEAL, REDUCED, Capture, Realism, paths
from lab.simulated import realism, scanned
from lab.simulated.photographs import expose, response_curve
from lab.sources.delivery import taken
from lab.stability.chain import run_stages
from lab.studies import variants
from workflow import settings
from workflow.scene.normal_form import CaptureReader
from workflow.settings.scene import SceneSettings, recorded

Z = 4.5  # standard errors; a correct function fails once in 150,000 runs, and the seeds are fixed
EFFECTS = tuple(name for name in Realism.model_fields if name != "reduced")
OF_PHOTOGRAPHS = ("noise", "blur", "jpeg")


def rng(seed=0):
    return np.random.default_rng(seed)


# ------------------------------------------------------------------------------------------------------- photographs


def test_every_view_is_exposed_by_itself():
    views = [np.full((50, 3), grey) for grey in (0.01, 0.3, 7.0)]
    mask = [np.ones(50, bool)] * 3
    np.testing.assert_allclose(realism.automatic_exposures(views, mask), [0.18 / 0.01, 0.18 / 0.3, 0.18 / 7])
    again = realism.automatic_exposures(views[:1], mask[:1])
    assert again[0] == realism.automatic_exposures(views, mask)[0]  # other views do not matter
    views[1][:10] = 5.0
    assert realism.automatic_exposures(views, mask)[1] * 5.0 <= 1.0  # a fifth of the pixels would saturate
    mask[1] = np.arange(50) >= 10
    assert realism.automatic_exposures(views, mask)[1] == pytest.approx(0.18 / 0.3)


def test_white_balance_has_the_spread_that_it_states():
    one, n = rng(1), 20_000
    gains = np.array([realism.white_balance(one) for _ in range(n)])
    assert (gains.min(1) == 1).all()
    ratio = np.log(gains[:, [0, 2]] / gains[:, 1:2])
    s = realism.WHITE_BALANCE
    assert (np.abs(ratio.mean(0)) < Z * s / np.sqrt(n)).all()
    assert (np.abs(ratio.var(0) - s**2) < Z * s**2 * np.sqrt(2 / n)).all()
    assert abs(np.corrcoef(ratio.T)[0, 1]) < Z / np.sqrt(n)


@pytest.mark.parametrize("sigma", [0.3, 0.5, 1.2])
def test_blur_is_a_gaussian_and_keeps_the_light(sigma):
    image = np.zeros((33, 33, 3))
    image[16, 16] = [1.0, 2.0, 4.0]
    out = realism.lens_blur(image, sigma)
    np.testing.assert_allclose(out.sum((0, 1)), [1, 2, 4], rtol=1e-12)
    for row, column in ((16, 17), (17, 16), (17, 17), (16, 18)):
        squared = (row - 16) ** 2 + (column - 16) ** 2
        if squared <= (4 * sigma) ** 2 / 2:  # inside of the kernel in each direction
            np.testing.assert_allclose(out[row, column] / out[16, 16], np.exp(-squared / (2 * sigma**2)), rtol=1e-9)
    np.testing.assert_allclose(realism.lens_blur(np.full((9, 9, 3), 0.7), sigma), 0.7, rtol=1e-12)


@pytest.mark.parametrize("signal", [0.0, 0.004, 0.18, 1.0, 30.0])
def test_noise_follows_the_photon_transfer(signal):
    n = 200_000
    values = realism.sensor_noise(np.full(n, signal), rng(2))
    gain, read = 1 / realism.ELECTRONS, realism.READ_ELECTRONS / realism.ELECTRONS
    variance = gain * signal + read**2
    assert abs(values.mean() - signal) < Z * np.sqrt(variance / n)
    excess = gain**3 * signal / variance**2  # kurtosis of Poisson plus normal numbers
    assert abs(values.var() - variance) < Z * variance * np.sqrt((2 + excess) / n)


def test_jpeg_loses_detail_and_keeps_flat_surface():
    flat = np.full((16, 16, 3), 100 / 255, np.float32)
    assert np.abs(realism.jpeg(flat) - flat).max() <= 1 / 255 + 1e-7
    rough = (rng(3).integers(0, 256, (64, 64, 3)) / 255).astype(np.float32)
    errors = [np.abs(realism.jpeg(rough, quality) - rough).mean() for quality in (50, 92, 100)]
    assert errors[0] > errors[1] > errors[2] > 0
    out = realism.jpeg(rough)
    assert out.dtype == np.float32 and out.shape == rough.shape
    np.testing.assert_array_equal(out, (np.rint(255 * out) / 255).astype(np.float32))


def _only(*names):
    return SimpleNamespace(**{name: name in names for name in EFFECTS}, reduced=1)


def test_each_effect_of_photographs_is_switched_alone():
    radiance = rng(4).gamma(2.0, 0.1, (24, 32, 3))
    curve, gains = response_curve(), np.array([1.05, 1.0, 1.02])
    ideal = expose(radiance, 1.5, curve)
    np.testing.assert_array_equal(taken(radiance, 1.5, np.ones(3), IDEAL, curve, rng()), ideal)
    found = {name: taken(radiance, 1.5, np.ones(3), _only(name), curve, rng()) for name in OF_PHOTOGRAPHS}
    assert all(not np.array_equal(photo, ideal) for photo in found.values())
    np.testing.assert_array_equal(found["blur"], expose(realism.lens_blur(radiance), 1.5, curve))
    np.testing.assert_array_equal(found["jpeg"], realism.jpeg(ideal))
    tinted = taken(radiance, 1.5, gains, _only("exposure"), curve, rng())
    np.testing.assert_array_equal(tinted, expose(gains * np.minimum(1.5 * radiance, 1), 1.0, curve))
    assert (tinted[(1.5 * radiance >= 1).all(-1)] == 1).all()  # what saturates, stays so
    every = taken(radiance, 1.5, gains, _only(*EFFECTS), curve, rng())
    np.testing.assert_array_equal(np.rint(255 * every), np.rint(255 * every.astype(np.float64)))


def test_a_reduced_photograph_has_less_noise_blur_and_jpeg():
    """The mean of n^2 pixels has 1/n of their noise; nothing that is constant changes."""
    curve, flat = response_curve(), np.full((16, 24, 3), 0.2)
    settings = {times: SimpleNamespace(**{name: name == "noise" for name in EFFECTS}, reduced=times) for times in (1, 4)}
    spread = {times: taken(flat, 1.0, np.ones(3), wanted, None, rng(6)).std() for times, wanted in settings.items()}
    assert spread[4] == pytest.approx(spread[1] / 4, rel=0.1)
    image = rng(7).gamma(2.0, 0.1, (24, 32, 3))
    wrong = {}
    for times in (1, 4):
        wanted = SimpleNamespace(**{name: name in ("blur", "jpeg") for name in EFFECTS}, reduced=times)
        photo = taken(image, 1.0, np.ones(3), wanted, curve, rng())
        assert photo.shape == image.shape
        wrong[times] = np.abs(photo - expose(image, 1.0, curve)).mean()
    assert wrong[4] < 0.5 * wrong[1]


def test_linear_photographs_have_a_scale_only_if_exposures_are_known():
    radiance = rng(5).gamma(2.0, 0.1, (24, 32, 3))
    np.testing.assert_array_equal(taken(radiance, 1.5, np.ones(3), IDEAL, None, rng()), radiance)
    noisy = taken(radiance, 1.5, np.ones(3), _only("noise"), None, rng())
    assert abs(np.mean(noisy - radiance)) < Z * np.sqrt(np.mean(1.5 * radiance) / realism.ELECTRONS / radiance.size) / 1.5
    unknown = taken(radiance, 1.5, np.ones(3), _only("exposure"), None, rng())
    np.testing.assert_allclose(unknown, 1.5 * radiance)


# ------------------------------------------------------------------------------------------------------------ cameras


@pytest.mark.parametrize("width", [48, 640])
def test_a_misplaced_camera_is_off_by_what_is_stated(width):
    points = rng(6).uniform([1, -1, -1], [4, 1, 1], (500, 3))
    lens = (0.7 * width, 0.7 * width, width / 2, width / 2)
    view = View(3, "v", width, width, *lens, look_at((0, 0, 0), (1, 0, 0), (0, 0, 1)))
    seen = [realism.misplaced(view, points, rng(seed)) for seed in range(20)]
    (u, v, _), *others = [project(points, *lens, one.world_from_camera) for one in (view, *seen)]
    for other in others:
        rms = np.sqrt(((u - other[0]) ** 2 + (v - other[1]) ** 2).mean())
        np.testing.assert_allclose(rms, realism.POSE_ERROR, rtol=1e-6)
    for one in seen:
        turn = one.world_from_camera[:3, :3]
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.norm(one.world_from_camera[:3, 3]) > 0 and not np.allclose(
            turn, view.world_from_camera[:3, :3], atol=1e-7
        )
    shifts = np.array([one.world_from_camera[:3, 3] for one in seen])
    assert len(np.unique(shifts.round(9), axis=0)) == 20
    np.testing.assert_array_equal(realism.misplaced(view, points, rng(0)).world_from_camera, seen[0].world_from_camera)
    assert realism.misplaced(view, points[:0], rng(0)) is view


def test_the_focal_length_is_off_to_either_side():
    found = {realism.focal_factor(rng(seed)) for seed in range(20)}
    assert found == {1 - realism.FOCAL_ERROR, 1 + realism.FOCAL_ERROR}


def test_random_numbers_depend_on_seed_effect_and_view_alone():
    first = realism.stream(0, "noise", 1).random(4)
    np.testing.assert_array_equal(first, realism.stream(0, "noise", 1).random(4))
    others = [realism.stream(*key).random(4) for key in ((1, "noise", 1), (0, "pose", 1), (0, "noise", 2))]
    assert all(not np.array_equal(first, other) for other in others)


# --------------------------------------------------------------------------------------------------------------- mesh


def _closed(faces):
    directed = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    return (np.unique(directed, axis=0, return_counts=True)[1] == 2).all()


def test_refining_keeps_a_closed_mesh_closed():
    vertices, faces = shapes.wedge((0, 0, 0), (2, 1.3, 0), (0.5, 0.5, 0.9), (0.7, 0.8, 0.9))
    fine, cut, source = scanned.refined(vertices, faces, 0.15)
    corner = fine[cut]
    assert np.linalg.norm(corner - np.roll(corner, 1, 1), axis=2).max() <= 0.15
    assert _closed(faces) and _closed(cut) and len(cut) > 50 * len(faces)
    normal, area = face_geometry(vertices, faces)
    new_normal, new_area = face_geometry(fine, cut)
    np.testing.assert_allclose(np.bincount(source, new_area), area)
    np.testing.assert_allclose((new_normal * normal[source]).sum(1), 1)
    np.testing.assert_allclose(((corner.mean(1) - vertices[faces[source, 0]]) * normal[source]).sum(1), 0, atol=1e-12)


def test_what_is_far_from_all_cameras_is_scanned_more_coarsely():
    corners, faces = np.array([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    fine, cut, _ = scanned.refined(corners, faces, 0.5, np.array([[0, 0, 1.5]]))
    assert len(cut) < len(scanned.refined(corners, faces, 0.5)[1]) / 3 and face_geometry(fine, cut)[1].sum() == pytest.approx(
        100.0**2
    )
    directed = np.sort(cut[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    ends, times = np.unique(directed, axis=0, return_counts=True)
    length, middle = np.linalg.norm(fine[ends[:, 0]] - fine[ends[:, 1]], axis=1), fine[ends].mean(1)
    distance = np.linalg.norm(middle - [0, 0, 1.5], axis=1)
    assert (length <= 0.5 * np.maximum(distance / scanned.NEAR, 1) + 1e-9).all() and length[distance > 40].max() > 1.0
    assert (times[(np.abs(middle) < 49.9).all(1)] == 2).all()  # no edge is cut on one side alone


def test_near_surface_is_scanned_alike_wherever_the_cameras_are():
    box = shapes.box((0, 0, 0), (3, 2, 2))[:2]
    plain, near = scanned.refined(*box, 0.1), scanned.refined(*box, 0.1, np.array([[1.0, 1, 1], [2, 1, 1]]))
    for one, other in zip(plain, near, strict=True):
        np.testing.assert_array_equal(one, other)


def test_holes_take_their_share_and_no_lamp():
    vertices, faces, _ = scanned.refined(*shapes.box((0, 0, 0), (3, 2, 2)), 0.1)
    area = face_geometry(vertices, faces)[1]
    lamp = vertices[faces][:, :, 2].min(1) > 1.99
    left = scanned.without_holes(vertices, faces, lamp, 0.03, rng(7))
    share = area[~left].sum() / area.sum()
    assert 0.03 <= share <= 0.03 + area.max() / area.sum() and left[lamp].all()
    all_but_lamps = scanned.without_holes(vertices, faces, lamp, 1.0, rng(7))
    np.testing.assert_array_equal(all_but_lamps, lamp)
    far = vertices[faces][:, :, 0].min(1) > 1.5
    left = scanned.without_holes(vertices, faces, lamp, 0.03, rng(7), far)
    assert left[far].all() and 0.03 <= area[~left].sum() / area[~far].sum() <= 0.03 + area.max() / area[~far].sum()


def test_the_bend_has_its_size_and_correlation():
    vertices, faces, _ = scanned.refined(*shapes.box((0, 0, 0), (4, 3, 2.5)), 0.1)
    normal, area = face_geometry(vertices, faces)
    middle = vertices[faces].mean(1)
    at, ratio = rng(8).uniform(0, 3, (2000, 3)), []
    for seed in range(20):
        bend = scanned.drawn_bend(vertices, faces, rng(seed))
        along = np.abs((bend(middle) * normal).sum(1))
        order = np.argsort(along)
        np.testing.assert_allclose(np.interp(0.5, np.cumsum(area[order]) / area.sum(), along[order]), scanned.BULGE, rtol=0.01)
        a, b = bend(at), bend(at + [scanned.CORRELATION, 0, 0])
        ratio.append((a * b).sum() / (a * a).sum())
    assert abs(np.mean(ratio) - np.exp(-0.5)) < Z * np.std(ratio) / np.sqrt(len(ratio))


@pytest.fixture(scope="module")
def scan_of_tiny(llvm):
    room = rooms.build("tiny")
    ids = np.column_stack([room.object_id, room.object_id + 7])
    return room, scanned.scanned(room.vertices, room.faces, ids, room.emission, rng(9))


def test_a_scan_is_bent_has_holes_and_knows_its_objects(scan_of_tiny):
    room, scan = scan_of_tiny
    area, true_area = face_geometry(scan.vertices, scan.faces)[1], face_geometry(room.vertices, room.faces)[1]
    assert set(scan.ids[:, 0]) == set(room.object_id) and (scan.ids[:, 1] == scan.ids[:, 0] + 7).all()
    lamp, true_lamp = scan.emission.any(1), room.emission.any(1)
    assert abs(area[~lamp].sum() / true_area[~true_lamp].sum() - (1 - scanned.HOLES)) < 0.01
    assert abs(area[lamp].sum() / true_area[true_lamp].sum() - 1) < 0.05
    assert {tuple(e) for e in scan.emission} == {tuple(e) for e in room.emission}
    middle = scan.vertices[scan.faces].mean(1)
    off = np.linalg.norm(closest_points(room.vertices, room.faces, middle).points - middle, axis=1)
    order = np.argsort(off)
    median = np.interp(0.5, np.cumsum(area[order]) / area.sum(), off[order])
    assert 0.8 * scanned.BULGE < median < 1.1 * scanned.BULGE  # the nearest surface is nearer than that along the normal
    for number in range(len(room.names)):
        own, true = middle[scan.ids[:, 0] == number], room.faces[room.object_id == number]
        assert np.linalg.norm(closest_points(room.vertices, true, own).points - own, axis=1).max() < 0.1


def test_most_of_the_holes_of_a_scan_are_closed_and_no_lamp_grows(scan_of_tiny):
    room, scan = scan_of_tiny
    closed = scanned.closed(scan)
    n, area = len(scan.faces), face_geometry(closed.vertices, closed.faces)[1]
    missing = face_geometry(room.vertices, room.faces)[1].sum() - area[:n].sum()
    assert 0.5 * missing < area[n:].sum() < 1.2 * missing
    assert not closed.emission[n:].any()
    middle = closed.vertices[closed.faces[n:]].mean(1)
    for number in np.unique(closed.ids[n:, 0]):  # what closes a hole is of the object around it
        own, true = middle[closed.ids[n:, 0] == number], room.faces[room.object_id == number]
        assert np.linalg.norm(closest_points(room.vertices, true, own).points - own, axis=1).max() < 0.15


# ------------------------------------------------------------------------------------------------------------ setting


@pytest.mark.parametrize(
    ("value", "off"),
    [("ideal", EFFECTS), (None, EFFECTS), ("as_captured", ()), ({}, ()), ({"noise": False, "mesh": "off"}, ("noise", "mesh"))],
)
def test_the_setting_switches_effects(value, off):
    found = Capture.model_validate({"realism": value}).realism or IDEAL
    assert {name for name in EFFECTS if not getattr(found, name)} == set(off)


@pytest.mark.parametrize("value", ["real", True, 3, ["noise"], {"nose": False}, {"noise": "some"}])
def test_other_values_are_refused(value):
    with pytest.raises(ValueError) as caught:
        Capture.model_validate({"realism": value})
    assert "realism" in str(caught.value)


def test_ideal_captures_keep_their_fingerprints():
    scene = {"source": {"kind": "builtin", "scene": "tiny"}, "prior": {"kind": "simulated"}}
    kept = {}
    for value in (None, "ideal", "as_captured", {"noise": False}):
        document = settings.dump(SceneSettings.model_validate({**scene, "capture": {"realism": value} if value else {}}))
        kept[str(value)] = recorded(document, ("capture",))["capture"]
    assert kept["None"] == kept["ideal"] and "realism" not in kept["None"]
    assert kept["as_captured"] != kept["ideal"] and kept["as_captured"] != kept["{'noise': False}"]


def test_studies_take_rooms_with_truth_as_they_are(repository):
    for scene in variants.scene_overrides(repository):
        found = settings.load(f"{scene}--s0", root=repository)
        if found.source.kind in ("builtin", "drawn", "mitsuba"):
            assert found.capture.realism == Realism(), scene
    ideal, quiet = (settings.load(f"kitchen--realism-{name}-s0", root=repository).capture for name in ("ideal", "noise"))
    assert ideal.realism is None and not quiet.realism.noise and quiet.realism.mesh


def test_paths_are_three_times_as_many_without_the_guided_denoiser():
    for value, factor in (("ideal", 1), ("as_captured", 3), ({"unguided": False}, 1)):
        assert paths(Capture.model_validate({"samples": 20, "realism": value}).model_dump()) == 20 * factor


# ----------------------------------------------------------------------------------------------------------- captures


def _captured(folder, source, **capture):
    document = document_of({"source": source, "capture": capture, "prior": {"kind": "simulated"}, "seed": 3})
    run_stages(folder, document, ("capture",))
    return CaptureReader(Loose(folder, document).open("capture"))


TINY = {"kind": "builtin", "scene": "tiny"}
SIZE = {"views": 7, "width": 48, "height": 40, "samples": 8, "test_every": 4}
EXACT = dict.fromkeys(EFFECTS, False)


@pytest.fixture(scope="module")
def ideal(llvm, tmp_path_factory):
    return _captured(tmp_path_factory.mktemp("ideal"), TINY, **SIZE)


@pytest.fixture(scope="module")
def real(llvm, tmp_path_factory):
    return _captured(tmp_path_factory.mktemp("real"), TINY, **SIZE, realism="as_captured")


def test_a_capture_without_any_effect_is_ideal(ideal, tmp_path):
    none = _captured(tmp_path, TINY, **SIZE, realism=EXACT)
    for a, b in zip(ideal, none, strict=True):
        assert a.exposure == b.exposure
        np.testing.assert_array_equal(a.world_from_camera, b.world_from_camera)
        np.testing.assert_array_equal(ideal.photo(a, held_out=True)[0], none.photo(b, held_out=True)[0])


def test_exposures_are_estimated_and_the_true_ones_kept_for_scores(ideal, real):
    assert real.facts["exposure_estimated"] and "exposure_estimated" not in ideal.facts
    true = dict(zip((view.name for view in ideal), real.facts["exposure_truth"], strict=True))
    own = [view for view in real if view.split == "train"]
    assert [view.exposure for view in real if view.split == "test"] == [1.0] * (len(real.views) - len(own))
    ratio = np.array([view.exposure / true[view.name] for view in own])
    assert len(np.unique(ratio.round(6))) > 1  # none of them is handed on, not even up to a factor
    assert np.ptp(np.log(ratio)) < 0.5
    assert len(real.facts["white_balance_truth"]) == SIZE["views"]


def test_cameras_are_off_and_shared_by_all(ideal, real):
    true = {view.name: view for view in ideal}
    for view in real:
        assert not np.allclose(view.world_from_camera, true[view.name].world_from_camera, atol=1e-6)
        assert view.fx != true[view.name].fx and view.split == true[view.name].split
    assert len({view.fx for view in real}) == 1
    assert [view.view_id for view in real] == list(range(len(real.views)))
    assert "accepted" in real.facts["registration"] and real.facts["plan"]


def test_surface_is_that_of_the_scan_and_truth_what_the_photograph_shows(ideal, real):
    room = rooms.build("tiny")
    ids = np.column_stack([room.object_id, room.object_id])
    scan = scanned.closed(scanned.scanned(room.vertices, room.faces, ids, room.emission, realism.stream(3, "mesh")))
    vertices, faces = real.mesh()
    np.testing.assert_array_equal(vertices, scan.vertices)
    np.testing.assert_array_equal(faces, scan.faces)
    np.testing.assert_array_equal(real.faces()["instance_id"], scan.ids[:, 0])
    missed, known, true = 0, [], {view.name: view for view in ideal}
    for view in real:
        depth, face = real.gbuffer(view)
        truth, was = real.truth(view), ideal.truth(true[view.name])
        hit = face >= 0
        missed += (~hit).sum()
        corner = vertices[faces[face[hit]]].astype(float)
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        assert np.abs(((real.points(view, depth)[hit] - corner[:, 0]) * normal).sum(-1)).max() < 1e-4
        shown = room.object_id[ideal.gbuffer(true[view.name])[1]]  # this room has no opening
        np.testing.assert_array_equal(truth.valid, hit & (scan.ids[face, 0] == shown))
        known.append(truth.valid.mean())
        for name in ("albedo", "roughness", "metallic", "emission"):
            np.testing.assert_array_equal(getattr(truth, name), getattr(was, name))
    assert 0 < missed / (len(real.views) * 40 * 48) < 0.1 and np.mean(known) > 0.8


def test_photographs_are_spoilt_but_still_of_the_room(ideal, real):
    for view in real:
        photo, valid = real.photo(view, held_out=True)
        assert valid.all()
        steps = 255 * REDUCED**2  # means of squares of pixels of eight bits
        np.testing.assert_allclose(photo, np.rint(steps * photo) / steps, atol=1e-6)
        clean = real.truth(view).radiance
        assert np.corrcoef(np.log(clean.mean(-1).ravel() + 1e-3), photo.mean(-1).ravel())[0, 1] > 0.9


def test_linear_captures_have_no_scale(llvm, tmp_path):
    capture = _captured(tmp_path, TINY, **{**SIZE, "dynamic_range": "hdr"}, realism={**EXACT, "exposure": True})
    scale = []
    for view in capture.used:
        photo, truth = capture.photo(view)[0], capture.truth(view).radiance
        assert view.exposure == 1.0
        scale.append(np.median(photo / truth))
    assert np.ptp(np.log(scale)) < 0.5 and not np.allclose(scale, 1, atol=0.02)


@pytest.mark.long
def test_a_mitsuba_scene_is_captured_as_it_is(llvm, tmp_path):
    from tests.lab.test_mitsuba_source import ROOM, TABLE, write

    source = {"kind": "mitsuba", "path": str(write(tmp_path, ROOM + TABLE))}
    size = {"views": 4, "width": 32, "height": 24, "samples": 8}
    plain = _captured(tmp_path / "ideal", source, **size)
    found = _captured(tmp_path / "real", source, **size, realism="as_captured")
    assert len(found.mesh()[1]) > len(plain.mesh()[1])
    assert set(found.faces()["instance_id"]) == set(plain.faces()["instance_id"])
    lamp, true_lamp = (np.stack([c.faces()[f"emission_{n}"] for n in "rgb"], 1) for c in (found, plain))
    assert {tuple(e) for e in lamp} == {tuple(e) for e in true_lamp}
    true = {view.name: view for view in plain}
    for view in found:
        truth, was = found.truth(view), plain.truth(true[view.name])
        both = truth.valid & was.valid
        assert both.mean() > 0.6 and (np.abs(truth.albedo - was.albedo).max(-1)[both] < 0.05).mean() > 0.8
