"""The built-in rooms: geometry, textures, cameras, and their capture."""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from iif_core.camera.pinhole import look_at
from iif_core.numerics.xp import NUMPY
from lab import rooms
from lab.rooms import patterns, shapes
from lab.rooms.coverage import seen_from, surface_points
from lab.rooms.patterns import Material, MaterialTable
from tests.errors import refused

OPEN = {
    "tiny": {"floor", "walls"},
    "kitchen": {
        *("floor", "ceiling", "north wall", "south wall", "west wall", "east wall", "window panes"),
        *("ceiling panel 1", "ceiling panel 2", "cabinet light"),
    },
}
NAMES = tuple(OPEN)


def is_emitter(room):
    """(objects,) bool."""
    return np.isin(np.arange(len(room.names)), room.object_id[room.emission.any(1)])


@pytest.fixture(scope="module", params=NAMES)
def room(request):
    return rooms.build(request.param)


@pytest.fixture(scope="module")
def kitchen():
    return rooms.build("kitchen")


@pytest.fixture(scope="module")
def traced(llvm, room):
    from iif_core.light.transport.geometry import build_geometry

    return build_geometry(room.vertices, room.faces, room.object_id)


# ------------------------------------------------------------------------------------------- shapes


def _volume(shape):
    """Signed volume; positive when closed and outward."""
    a, b, c = (shape[0][shape[1][:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def _is_closed(shape):
    directed = shape[1][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = {tuple(edge) for edge in directed.tolist()}
    return len(edges) == len(directed) and all((b, a) in edges for a, b in edges)


@pytest.mark.parametrize(
    "shape, volume, tolerance",
    [
        (shapes.box((0, 1, 2), (1, 3, 5)), 6.0, 1e-12),
        (shapes.box((0, 0, 0), (1, 1, 1), 0.1), 1 - 12 * 0.005 * 0.8 - 8 * 0.1**3 * 5 / 6, 1e-12),
        (shapes.wedge((0, 0, 0), (2, 2, 0), (0.5, 0.5, 3), (1.5, 1.5, 3)), 3 / 3 * (4 + 1 + 2), 1e-12),
        (shapes.tub((0, 0, 0), (1, 1, 1), 0.1, 0.2), 1 - 0.8 * 0.8 * 0.8, 1e-12),
        (shapes.cylinder((1, 1, 1), 0.5, 2, segments=256), np.pi / 2, 1e-3),
        (shapes.sphere((1, 2, 3), 0.7, 64), 4 / 3 * np.pi * 0.343, 1e-2),
        (
            shapes.ring((0, 0, 0), 1.0, 0.1, (1, 0, 0), (0, 1, 0), 128),
            2 * np.pi * 5 * np.sin(np.pi / 5) * 0.01,
            1e-3,
        ),
        (shapes.tube([(0, 0, 0), (0, 0, 1), (1, 0, 1)], 0.1, 128), 2 * np.pi * 0.01, 2e-3),
        (
            shapes.lathe([(0, 0), (1, 0), (1, 1), (0.9, 1), (0.9, 0.1), (0, 0.1)], segments=256),
            np.pi * (1 - 0.81 * 0.9),
            1e-3,
        ),
        (shapes.move(shapes.box((0, 0, 0), (1, 2, 3)), (5, 6, 7), 33, 21), 6.0, 1e-12),
        (shapes.stretch(shapes.box((0, 0, 0), (1, 1, 1)), (2, 3, 4)), 24.0, 1e-12),
    ],
)
def test_shapes_are_closed_outward_and_of_the_right_volume(shape, volume, tolerance):
    assert _is_closed(shape)
    np.testing.assert_allclose(_volume(shape), volume, rtol=tolerance)


def test_tube_around_three_corners_keeps_its_radius():
    path = [(0, 0, 0), (0, -1, 0), (0, -1, 1), (0, 0, 1), (1, 0, 1)]
    vertices, faces = shapes.tube(path, 0.05, 64)
    assert _is_closed((vertices, faces))
    np.testing.assert_allclose(_volume((vertices, faces)), 4 * np.pi * 0.05**2, rtol=5e-3)
    for middle in (
        (0, -0.5, 0),
        (0, -1, 0.5),
        (0, -0.5, 1),
        (0.5, 0, 1),
    ):  # all vertices lie on the cylinders
        assert np.linalg.norm(vertices - middle, axis=1).min() > 0.05


def test_impossible_box_is_refused():
    with refused("[0. 0. 0.]", "[ 1. -1.  1.]", kind=ValueError):
        shapes.box((0, 0, 0), (1, -1, 1))


def test_sheet_faces_its_normal_and_hole_is_open():
    vertices, faces = shapes.grid_sheet(
        (0, 0, 0),
        (4, 0, 0),
        (0, 3, 0),
        np.linspace(0, 1, 5),
        np.linspace(0, 1, 4),
        (0.25, 0.75, 1 / 3, 2 / 3),
    )
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert (normal[:, 2] > 0).all()
    np.testing.assert_allclose(normal[:, 2].sum() / 2, 12 - 2)


# ------------------------------------------------------------------------------------------- mesh


def _components(room):
    f, n = room.faces, len(room.vertices)
    links = coo_matrix((np.ones(2 * len(f)), (np.r_[f[:, 0], f[:, 1]], np.r_[f[:, 1], f[:, 2]])), (n, n))
    count, label = connected_components(links, directed=False)
    return count, label[f[:, 0]]


def test_kitchen_is_furnished_and_moderate(kitchen):
    assert len(kitchen.names) >= 40 and len(kitchen.faces) < 60_000
    seen = kitchen.materials.materials
    assert sum(m.kind != "plain" for m in seen) >= 20
    assert sum(m.metallic == 1 for m in seen) >= 10
    assert sum(m.metallic == 0 and m.roughness[0] < 0.2 for m in seen) >= 10
    assert sum(m.roughness[0] > 0.7 for m in seen) >= 10
    assert 4 <= is_emitter(kitchen).sum() <= 8
    assert len(rooms.build("tiny").names) == 8 and is_emitter(rooms.build("tiny")).sum() == 2


def test_mesh_is_sound(room):
    assert len(set(room.names)) == len(room.names) == len(room.materials.materials)
    assert np.isfinite(room.vertices).all()
    assert room.faces.min() == 0 and room.faces.max() == len(room.vertices) - 1
    assert np.array_equal(np.unique(room.object_id), np.arange(len(room.names)))
    corner = room.vertices[room.faces].astype(float)
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
    assert area.min() > 1e-7
    bright = room.emission.any(1)
    assert bright.any() and (room.emission >= 0).all()


def test_everything_but_the_shell_is_closed_and_outward(room):
    count, part = _components(room)
    n = len(room.vertices)
    edge = room.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    lonely = ~np.isin(edge[:, 0] * n + edge[:, 1], edge[:, 1] * n + edge[:, 0])
    is_open = np.zeros(count, bool)
    is_open[np.repeat(part, 3)[lonely]] = True
    owner = np.zeros(count, int)
    owner[part] = room.object_id
    assert {room.names[i] for i in owner[is_open]} == OPEN[room.name]
    middle = np.zeros((count, 3))
    for axis in range(3):
        middle[:, axis] = np.bincount(part, room.vertices[room.faces[:, 0], axis], count) / np.bincount(part, minlength=count)
    a, b, c = (room.vertices[room.faces[:, k]].astype(float) - middle[part] for k in range(3))
    volume = np.bincount(part, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6, count)
    wrong = {room.names[i] for i in owner[~is_open & (volume <= 0)]}
    assert not wrong


def _random_rays(room, per_camera, cameras=50, seed=0):
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(cameras * per_camera, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.repeat([pose[:3, 3] for pose in room.cameras(cameras)], per_camera, axis=0)
    return origin, direction


def test_no_ray_escapes_and_nobody_sees_a_back_side(room, traced):
    """Trace 20 000 rays from 50 cameras; a camera inside an object would see back sides only."""
    from iif_core.light.transport.geometry import trace

    origin, direction = _random_rays(room, 400)
    face, t = trace(traced, origin, direction)
    assert (face >= 0).all()
    cosine = (traced.normals[face] * direction).sum(1)
    assert (cosine >= 0).mean() <= 1e-4
    point = origin + t[:, None] * direction
    assert (point > -0.01).all() and (point < room.size + [0.2, 0.01, 0.01]).all()  # the window lies 0.15 m outside


def test_no_two_surfaces_lie_in_one_plane(room, traced):
    """Behind no visible point is another parallel surface nearer than 0.3 mm."""
    from iif_core.light.transport.geometry import trace

    origin, direction = _random_rays(room, 2000, seed=1)
    face, t = trace(traced, origin, direction)
    cosine = np.abs((traced.normals[face] * direction).sum(1))
    step = 2e-5 / np.maximum(cosine, 1e-3)
    behind, t2 = trace(traced, origin + (t + step)[:, None] * direction, direction)
    parallel = np.abs((traced.normals[behind] * traced.normals[face]).sum(1)) > 0.99
    other = room.object_id[behind] != room.object_id[face]
    assert not ((behind >= 0) & other & parallel & (t2 * cosine < 3e-4)).any()


# ------------------------------------------------------------------------------------------- cameras


def test_cameras_are_many_different_and_free(room):
    poses = room.cameras(200)
    centres = np.array([p[:3, 3] for p in poses])
    assert len(poses) == 200
    assert all(room.is_free(c, 0.05) for c in centres)
    keys = {tuple(np.round(p, 4).ravel()) for p in poses}
    assert len(keys) == 200
    np.testing.assert_array_equal(poses[:5], room.cameras(5))
    for pose in poses:
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert pose[2, 1] < 0.05  # image y points down


def test_kitchen_cameras_stand_where_a_person_would(kitchen):
    assert len(kitchen.shots) >= 40
    height = np.array([position[2] for position, _ in kitchen.shots])
    assert 0.8 < height.min() and height.max() < 2.3 and 1.3 < np.median(height) < 1.7
    assert 70 <= kitchen.field_of_view <= 75


def test_too_many_cameras_are_refused():
    room = rooms.build("tiny")
    with refused("capture.views", 9, "tiny"):
        # a room whose every corner is taken
        type(room)(**{**vars(room), "parts": np.array([[[0.0, 0, 0], [3, 3, 3]]])}).cameras(9)


def test_free_means_outside_of_everything(kitchen):
    assert kitchen.is_free((2.9, 2.9, 1.5))
    assert not kitchen.is_free((1.75, 1.75, 0.73))  # in the table top
    assert not kitchen.is_free((0.4, 3.6, 1.0))  # in the fridge
    assert not kitchen.is_free((2.5, 2.0, -0.5)) and not kitchen.is_free((6.0, 2.0, 1.0))


def test_first_views_cover_the_kitchen(llvm, kitchen):
    from iif_core.light.transport.geometry import build_geometry

    geometry = build_geometry(kitchen.vertices, kitchen.faces, kitchen.object_id)
    points = surface_points(kitchen, 2500)
    seen = np.array([seen_from(geometry, points, kitchen.field_of_view, 1.0, p) for p in kitchen.cameras(54)])
    visible = seen.any(0)
    count = np.cumsum(seen, 0)[:, visible]
    assert (count[7] >= 1).mean() > 0.82 and (count[7] >= 2).mean() > 0.6
    assert (count[15] >= 1).mean() > 0.90 and (count[15] >= 2).mean() > 0.78
    assert (count[31] >= 2).mean() > 0.86


def test_seen_from_knows_front_behind_and_hidden(llvm):
    from iif_core.light.transport.geometry import build_geometry

    wall = shapes.sheet((-5, 2, -5), (10, 0, 0), (0, 0, 10))
    geometry = build_geometry(*wall, np.zeros(len(wall[1]), int))
    points = np.array([[0, 2, 0], [0, 3, 0], [0, -1, 0], [1.9, 2, 0], [2.1, 2, 0], [0, 2, 1.1]])
    pose = look_at((0, 0, 0), (0, 1, 0), (0, 0, 1))
    assert seen_from(geometry, points, 90, 0.5, pose).tolist() == [True, False, False, True, False, False]


# ------------------------------------------------------------------------------------------- textures


def test_hash_is_exact_in_float32():
    i, j, k = np.meshgrid(*[np.arange(-700, 700, 17)] * 3)

    def permute(x):
        return (34 * x + 1) * x % 289

    expected = permute(permute(permute(i % 289) + j % 289) + k % 289) / 288
    found = patterns._hash(NUMPY, *(a.astype(np.float32) for a in (i, j, k)))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-7)


def test_noise_is_continuous_centred_and_uses_its_range():
    rng = np.random.default_rng(0)
    p = rng.uniform(-50, 50, (3, 200_000)).astype(np.float32)
    value = patterns.noise(NUMPY, *p)
    assert value.dtype == np.float32 and value.min() >= 0 and value.max() <= 1
    assert abs(value.mean() - 0.5) < 0.01 and 0.15 < value.std() < 0.35
    near = patterns.noise(NUMPY, *(p + np.float32(1e-3)))
    assert np.abs(near - value).max() < 0.02


def test_truth_and_renderer_see_the_same_material(llvm, room):
    """NumPy and Dr.Jit agree except at the edges of cells, where rounding decides."""
    corner = room.vertices[room.faces]
    rng = np.random.default_rng(3)
    face = np.repeat(np.arange(len(corner)), 1 + 20_000 // len(corner))
    bary = rng.dirichlet((1, 1, 1), len(face)).astype(np.float32)
    point = np.einsum("ni,nij->nj", bary, corner[face])
    object_id = room.object_id[face]
    expected = np.column_stack(room.materials.numpy(point, object_id))
    base, roughness, metallic = room.materials.drjit()(
        llvm.Point3f(point.T), llvm.UInt32(face), llvm.Int32(object_id), llvm.Bool(True)
    )
    found = np.column_stack([np.array(base).T, np.array(roughness), np.array(metallic)])
    difference = np.abs(found - expected).max(1)
    assert np.median(difference) < 1e-6
    assert (difference > 1e-4).mean() < 1e-3
    assert expected.dtype == np.float32 and expected.min() >= 0 and expected.max() <= 1 and expected[:, 3].min() >= 0.02
    assert not expected[is_emitter(room)[object_id], :3].any()


def test_every_kind_of_pattern_shows_its_colours():
    red, green, blue = (0.8, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.1, 0.8)
    point = np.random.default_rng(4).uniform(-1, 1, (20_000, 3))
    for kind in patterns.KINDS:
        size = (1.3, 0.14) if kind == "cells" else (0.3, 0.5)
        table = MaterialTable((Material(red, green, blue, roughness=(0.3, 0.1, 0.2), kind=kind, size=size),))
        albedo, roughness, metallic = table.numpy(point, np.zeros(len(point), int))
        assert albedo.std(0).max() > 0.05, kind
        assert albedo.min() > 0.099 and albedo.max() < 0.801, kind
        assert roughness.min() >= 0.3 - 1e-6 and roughness.max() <= 0.6 + 1e-6 and not metallic.any()


def test_unknown_kind_is_refused():
    with refused("'houndstooth'", "plain", "rug", kind=ValueError):
        MaterialTable((Material((1, 1, 1), kind="houndstooth"),))


def test_textures_survive_a_draft_pixel(llvm, kitchen):
    """Truth at the pixel centre is near the mean over the pixel: detail is coarser than its footprint."""
    from iif_core.camera.pinhole import pixel_directions
    from iif_core.light.transport.geometry import build_geometry, trace

    geometry = build_geometry(kitchen.vertices, kitchen.faces, kitchen.object_id)
    width, fine = 160, 3
    for pose in kitchen.cameras(3):
        n = width * fine
        focal = n / 2 / np.tan(np.radians(kitchen.field_of_view / 2))
        rays = pixel_directions(focal, focal, n / 2, n / 2, n, n, pose).reshape(-1, 3)
        face, t = trace(geometry, pose[:3, 3], rays)
        albedo, *_ = kitchen.materials.numpy(pose[:3, 3] + t[:, None] * rays, kitchen.object_id[face])

        def blocks(a):
            return a.reshape(width, fine, width, fine, -1).swapaxes(1, 2).reshape(width * width, fine * fine, -1)

        ids, values = blocks(kitchen.object_id[face])[..., 0], blocks(albedo)
        whole = (ids == ids[:, :1]).all(1)
        gap = np.abs(values[whole, fine * fine // 2] - values[whole].mean(1)).max(1)
        assert np.median(gap) < 0.01 and np.quantile(gap, 0.9) < 0.10
        assert values[whole, 4].std(0).max() > 0.1


# ------------------------------------------------------------------------------------------- capture

SCENE = """
source: {kind: builtin, scene: tiny}
capture: {dynamic_range: %s, views: 4, width: 48, height: 40, samples: 16, test_every: 3}
prior: {kind: simulated}
seed: %d
"""


def _run(folder, monkeypatch, dynamic_range="ldr", seed=0):
    from workflow.artifacts import StageReader
    from workflow.runtime import fingerprint
    from workflow.runtime.job import run_stage
    from workflow.scene.normal_form import CaptureReader

    (folder / "config/scenes").mkdir(parents=True, exist_ok=True)
    (folder / "config/scenes/tiny.yaml").write_text(SCENE % (dynamic_range, seed))
    monkeypatch.chdir(folder)
    for cached in (fingerprint.resolved, fingerprint.fingerprint):
        cached.cache_clear()
    try:
        run_stage("capture", "tiny")
    finally:
        for cached in (fingerprint.resolved, fingerprint.fingerprint):
            cached.cache_clear()
    directory = folder / "results/tiny/capture"
    return CaptureReader(StageReader(directory, "capture", "tiny"))


@pytest.fixture(scope="module")
def captured(llvm, tmp_path_factory):
    with pytest.MonkeyPatch.context() as monkeypatch:
        yield _run(tmp_path_factory.mktemp("builtin"), monkeypatch)


def _digests(capture):
    folder = capture.reader.directory
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def test_capture_is_the_same_to_the_last_byte(captured, tmp_path, monkeypatch):
    again = _run(tmp_path / "again", monkeypatch)
    assert _digests(again) == _digests(captured)


def test_a_killed_capture_goes_on_where_it_was(captured, tmp_path, monkeypatch):
    from iif_core.light.transport import render

    whole, calls = render.render, []

    def killed(*arguments, **options):
        calls.append(len(calls))
        if len(calls) == 2:
            raise KeyboardInterrupt
        return whole(*arguments, **options)

    monkeypatch.setattr(render, "render", killed)
    with pytest.raises(KeyboardInterrupt):
        _run(tmp_path, monkeypatch)
    resumed = _run(tmp_path, monkeypatch)
    assert len(calls) == 1 + len(resumed.views)  # the killed view twice, the first one once
    assert _digests(resumed) == _digests(captured)


def test_another_seed_gives_other_noise_alone(captured, tmp_path, monkeypatch):
    other = _run(tmp_path / "other", monkeypatch, seed=5)
    for a, b in zip(captured, other, strict=True):
        ta, tb = captured.truth(a), other.truth(b)
        assert not np.array_equal(ta.radiance, tb.radiance)
        np.testing.assert_array_equal(ta.albedo, tb.albedo)
        np.testing.assert_allclose(ta.radiance.mean(), tb.radiance.mean(), rtol=0.15)


def test_photographs_are_what_the_camera_made_of_the_radiance(captured):
    from lab.simulated.photographs import expose, response_curve

    assert captured.has_truth and not captured.is_hdr
    assert captured.facts["source"] == "builtin"
    curve = response_curve("filmic")
    np.testing.assert_allclose(captured.facts["response_truth"], curve.samples(), atol=1e-8)
    assert len({view.exposure for view in captured}) > 1
    assert [view.split for view in captured] == ["train", "train", "test", "train"]
    for view in captured:
        photo, valid = captured.photo(view, held_out=True)
        assert photo.shape == (40, 48, 3) and valid.all()
        np.testing.assert_array_equal(photo, expose(captured.truth(view).radiance, view.exposure, curve))
        truth = captured.truth(view)
        lamp = truth.emission.any(-1)
        assert (photo[~lamp].max(-1) >= 1).mean() < 0.06
        assert 0.15 < np.median(photo) < 0.85


def test_geometry_and_truth_of_a_view(captured, llvm):
    room = rooms.build("tiny")
    vertices, faces = captured.mesh()
    np.testing.assert_array_equal(vertices, room.vertices)
    np.testing.assert_array_equal(faces, room.faces)
    np.testing.assert_array_equal(captured.faces()["instance_id"], room.object_id)
    columns = captured.faces()
    np.testing.assert_array_equal(np.stack([columns[f"emission_{c}"] for c in "rgb"], 1), room.emission)
    assert captured.reader.table("instances.parquet")["name"].tolist() == list(room.names)
    for view in captured:
        depth, face = captured.gbuffer(view)
        truth = captured.truth(view)
        assert (face >= 0).all() and truth.valid.all()
        point = captured.points(view, depth)
        corner = vertices[faces[face]].astype(float)
        normal = np.cross(corner[..., 1, :] - corner[..., 0, :], corner[..., 2, :] - corner[..., 0, :])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        assert np.abs(((point - corner[..., 0, :]) * normal).sum(-1)).max() < 1e-4
        # truth is the mean over a pixel: at pixels that no edge cuts, that of sixteen points of the plane of their face
        steps, total = (np.arange(4) + 0.5) / 4 - 0.5, 0.0
        inside = np.all([np.roll(face, step, axis) == face for axis in (0, 1) for step in (1, -1)], axis=0)
        inside[[0, -1]] = inside[:, [0, -1]] = False
        for right in steps:
            for down in steps:
                ray = replace(view, cx=view.cx - right, cy=view.cy - down).directions().astype(np.float64)
                eye = view.world_from_camera[:3, 3]
                t = ((corner[..., 0, :] - eye) * normal).sum(-1) / (ray * normal).sum(-1)
                at = (eye + t[..., None] * ray)[inside]
                albedo, roughness, metallic = room.materials.numpy(at, room.object_id[face[inside]])
                total = total + np.column_stack([albedo, roughness, metallic]) / 16
        found = np.column_stack([truth.albedo[inside], truth.roughness[inside], truth.metallic[inside]])
        assert inside.mean() > 0.2
        gap = np.abs(found - total).max(-1)
        assert np.median(gap) < 1e-6 and (gap > 1e-3).mean() < 5e-3
        lamp = room.emission[face].any(-1)
        np.testing.assert_array_equal(truth.emission, room.emission[face])  # every lamp is seen from its front
        inner = lamp & np.roll(lamp, 1, 0) & np.roll(lamp, -1, 0) & np.roll(lamp, 1, 1) & np.roll(lamp, -1, 1)
        if inner.any():  # emission plus the reflection of a black dielectric
            extra = truth.radiance[inner] - truth.emission[inner]
            assert extra.min() > -1e-5 and extra.max() < 0.5
        assert np.isfinite(truth.radiance).all() and (truth.radiance > 0).all()


def test_coverage_is_reported(captured):
    coverage = captured.facts["coverage"]
    assert 0 < coverage["seen_twice"] <= coverage["seen_once"] <= 1


def test_hdr_photographs_are_radiance(llvm, tmp_path, monkeypatch):
    capture = _run(tmp_path / "hdr", monkeypatch, "hdr")
    assert capture.is_hdr and "response_truth" not in capture.facts
    for view in capture:
        assert view.exposure == 1.0
        np.testing.assert_array_equal(capture.photo(view, held_out=True)[0], capture.truth(view).radiance)


def test_unknown_room_is_refused():
    with refused("source.scene", "'cellar'", "kitchen, matte, tiny"):
        rooms.build("cellar")


def test_source_is_light_to_ask(repository):
    """Snakemake imports the source while it parses, so the import must load neither the renderer nor SciPy."""
    code = (
        "import sys, json; from lab.sources import builtin; assert builtin.raw_inputs({}) == [];"
        "print(json.dumps([m for m in ('mitsuba', 'drjit', 'scipy', 'torch', 'open3d') if m in sys.modules]))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=repository, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []
