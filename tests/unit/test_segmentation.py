"""Stage segmentation: objects from given ids or from shape, and the tables and maps derived from them."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from tests.errors import refused
from tests.unit import own_scene as own
from workflow.artifacts import StageReader
from workflow.artifacts.store import ids_from_disk
from workflow.intake.ply import face_properties
from workflow.segmentations import given
from workflow.segmentations.face_colour import mean_face_colour


def tables(root):
    reader = StageReader(root / "results/own/segmentation", "segmentation", "own")
    return (
        reader,
        reader.table("faces.parquet")["object_id"],
        reader.table("objects.parquet"),
        reader.table("segments.parquet"),
    )


def check_consistent(root, capture):
    """Check what must hold for every kind: maps, segments and objects are consistent."""
    reader, object_of_face, objects, segments = tables(root)
    count = len(objects["object_id"])
    np.testing.assert_array_equal(objects["object_id"], np.arange(count))
    np.testing.assert_array_equal(objects["faces"], np.bincount(object_of_face, minlength=count))
    vertices, faces = capture.mesh()
    corners = vertices[faces].astype(float)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert objects["area_m2"].sum() == pytest.approx(area.sum(), rel=1e-5)
    pixels, views = np.zeros(count, int), np.zeros(count, int)
    np.testing.assert_array_equal(segments["segment_id"], np.arange(len(segments["segment_id"])))
    for view in capture:
        channels = reader.exr(f"maps/{view.name}.exr")
        _, face = capture.gbuffer(view)
        objects_here = ids_from_disk(channels["object.id"])
        np.testing.assert_array_equal(objects_here, np.where(face >= 0, object_of_face[face], -1))
        segment = ids_from_disk(channels["segment.id"])
        hit = segment >= 0
        np.testing.assert_array_equal(hit, face >= 0)
        np.testing.assert_array_equal(segments["object_id"][segment[hit]], objects_here[hit])
        assert (segments["view_id"][segment[hit]] == view.view_id).all()
        rows = segments["view_id"] == view.view_id
        np.testing.assert_array_equal(np.bincount(segment[hit], minlength=len(rows))[rows], segments["pixels"][rows])
        seen = np.bincount(objects_here[hit], minlength=count)
        pixels += seen
        views += seen > 0
        inside = channels["interior"] > 0.5
        assert not (inside & ~hit).any() and inside.sum() < hit.sum()
    np.testing.assert_array_equal(objects["pixels"], pixels)
    np.testing.assert_array_equal(objects["views"], views)
    return object_of_face, objects


def test_given_by_face_keeps_what_nobody_sees(tmp_path):
    path = own.project(tmp_path, segmentation={"kind": "given"})
    own.photographed(path, 3, depth=False)
    vertices, faces, thing = own.room_mesh()
    hidden, box = own.box((2.6, -0.7, 0.6), (2.9, -0.4, 0.9), inward=False)  # inside the block
    ids = np.concatenate([np.where(thing == 1, 40, -1), np.full(12, 7)])
    own.save_mesh(
        path / "mesh.ply",
        np.concatenate([vertices, hidden]),
        np.concatenate([faces, box + len(vertices)]),
        ids,
    )
    capture = own.run(tmp_path, "capture", "segmentation")
    labels, objects = check_consistent(tmp_path, capture)
    assert objects["name"].tolist() == ["instance 7", "instance 40", "unlabelled"]
    assert objects["pixels"].tolist()[0] == 0 and objects["views"].tolist() == [0, 3, 3]
    np.testing.assert_array_equal(labels, np.concatenate([np.where(thing == 1, 1, 2), np.zeros(12)]))
    assert (objects["agreement"] == 1).all()


def test_given_by_view_votes(tmp_path):
    path = own.project(tmp_path, segmentation={"kind": "given"})
    _, shots = own.photographed(path, 3, depth=False)
    (path / "instances").mkdir()
    rng = np.random.default_rng(0)
    for i, (_, _, _, face) in enumerate(shots[:2]):  # the third view has no file
        ids = np.where(face // 12 == 1, 300, 5)
        ids = np.where(rng.random(ids.shape) < 0.1, 9, ids)  # noise that must lose the vote
        Image.fromarray(ids.astype(np.uint16)).save(path / f"instances/{i:03d}.png")
    capture = own.run(tmp_path, "capture", "segmentation")
    labels, objects = check_consistent(tmp_path, capture)
    assert objects["name"].tolist() == ["instance 5", "instance 300"]
    np.testing.assert_array_equal(labels[:12], 0)
    np.testing.assert_array_equal(labels[12:], 1)
    assert (objects["agreement"] > 0.8).all() and (objects["agreement"] < 1).all()
    assert any("instances are given for 2 of 3 views" in note for note in capture.facts["notes"])


def test_geometry(tmp_path):
    path = own.project(tmp_path, segmentation={"kind": "geometry", "min_faces": 1, "colour": 0.0})
    own.photographed(path, 3, depth=False)
    capture = own.run(tmp_path, "capture", "segmentation")
    labels, objects = check_consistent(tmp_path, capture)
    assert len(objects["name"]) == 12  # the six sides of the room and of the block
    pairs = labels.reshape(12, 2)
    assert (pairs[:, 0] == pairs[:, 1]).all()  # the two triangles of a side


def test_given_without_ids_says_what_to_do(tmp_path):
    path = own.project(tmp_path, segmentation={"kind": "given"})
    own.photographed(path, 2, depth=False)
    with refused("segmentation: {kind: given}", "segmentation: {kind: geometry}"):
        own.run(tmp_path, "capture", "segmentation")


def test_given_without_ids_is_refused_before_any_work_where_files_tell(tmp_path):
    """A PLY of which faces have no `instance` and no maps beside the photographs, and photographs alone."""
    own.photographed(tmp_path, 2, depth=False)
    settings = own.settings_of(tmp_path)
    with refused("segmentation: {kind: given}", "segmentation: {kind: geometry}"):
        given.raw_inputs(settings)
    with refused("segmentation: {kind: given}"):
        given.raw_inputs(settings | {"source": settings["source"] | {"kind": "photographs"}})
    (tmp_path / "instances").mkdir()
    Image.fromarray(np.zeros((own.CAMERA.height, own.CAMERA.width), np.uint8)).save(tmp_path / "instances/000.png")
    assert given.raw_inputs(settings) == []


@pytest.mark.parametrize("faces", ["property list uchar int vertex_indices\nproperty int instance", "property int instance"])
def test_properties_of_faces_are_those_of_the_header(tmp_path, faces):
    path = tmp_path / "mesh.ply"
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 0\nproperty float instance_of_vertex\nelement face 0\n{faces}\nend_header\n"
    )
    assert face_properties(path) - {"vertex_indices"} == {"instance"}


@pytest.mark.parametrize(
    ("is_hdr", "scale", "expected"), [(True, 10.0, [0.4, 2 / 3]), (False, 1.0, [0.2 / 2**0.45, 0.6 / 2**0.45])]
)
def test_colour_of_a_face_is_alike_in_dark_and_bright_photographs(is_hdr, scale, expected):
    """Radiance is relative to the mean of its photograph, sensor values are relative to the exposure."""
    every = np.ones(4, bool)
    value = scale * np.array([0.2, 0.2, 0.2, 0.6])[:, None] * np.ones(3)
    maps = SimpleNamespace(valid=every, hit=every, value=value, face=np.array([0, 0, 0, 1]))
    surface = SimpleNamespace(
        prior=None,
        faces=np.zeros((3, 3)),
        capture=SimpleNamespace(is_hdr=is_hdr),
        views=lambda fold: [SimpleNamespace(exposure=2.0)],
        decoded=SimpleNamespace(maps=lambda view: maps),
    )
    colour, pixels = mean_face_colour(surface)
    np.testing.assert_allclose(colour, np.array([*expected, 0.0])[:, None] * np.ones(3), rtol=1e-12)
    assert pixels.tolist() == [3, 1, 0]
