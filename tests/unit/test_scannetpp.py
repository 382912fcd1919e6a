"""Source `scannetpp`: a miniature release against the truth that it was made from, and against the same scene as a folder."""

import json
import shutil

import numpy as np
import pytest

from iif_core.camera.distortion import pinhole_inside
from iif_core.errors import InputError
from tests.errors import named, refused
from tests.unit import own_scene as own
from tests.unit import scannetpp_scene as mini
from workflow import settings
from workflow.sources import scannetpp
from workflow.sources.folder_scene import mesh

SETTINGS = {"width": 320, "height": 320}  # larger than any view: nothing is reduced


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """The room, its views, the folder of the release."""
    room = mini.room()
    views = mini.photographs(room)
    return room, views, mini.release(tmp_path_factory.mktemp("release") / "2a1b555966", room, views)


def project(root, home, **source):
    own.project(root, {"kind": "scannetpp", "path": str(home), **source}, SETTINGS, {"kind": "given"})


@pytest.fixture(scope="module")
def captured(release, tmp_path_factory):
    root = tmp_path_factory.mktemp("captured")
    project(root, release[2])
    return own.run(root, "capture")


@pytest.fixture
def copy(release, tmp_path):
    home = tmp_path / "scene"
    shutil.copytree(release[2], home)
    return home


def refusal(home, capture=None, **source):
    source = {"kind": "scannetpp", "path": str(home), **source}
    tree = {"source": source, "capture": capture or {}, "segmentation": {"kind": "given"}}
    document = settings.dump(settings.SceneSettings.model_validate(tree))
    with pytest.raises(InputError) as caught:
        scannetpp.raw_inputs(document)
    return str(caught.value)


def test_the_turn_of_the_world_is_a_rotation_and_its_own_inverse():
    turn = scannetpp.MESH_FROM_NERFSTUDIO
    np.testing.assert_array_equal(turn @ turn, np.eye(4))
    assert np.linalg.det(turn) == pytest.approx(1)
    # docs/method/camera.md#axes-and-pixels: rows (T'_row1, T'_row0, -T'_row2), with columns 1 and 2 of T negated.
    pose = own.poses(1)[0]
    np.testing.assert_allclose(turn @ mini.nerfstudio_matrix(pose) @ np.diag([1, -1, -1, 1]), pose, atol=1e-15)


def test_cameras_lists_and_bad_photographs(release, captured):
    _, views, _ = release
    target = pinhole_inside(mini.LENS, mini.CAMERA)
    assert [v.name for v in captured] == ["DSC00000", "DSC00001", "DSC00002", "DSC00003", "DSC00005"]
    assert [v.split for v in captured] == ["train", "train", "test", "train", "test"]
    for view in captured:
        pose = views[int(view.name[3:])][0]
        np.testing.assert_allclose(view.world_from_camera, pose, atol=1e-9)
        assert (view.width, view.height, view.fx, view.cx) == (target.width, target.height, target.fx, target.cx)
    notes = captured.facts["notes"]
    assert "1 photographs that the release marks as bad are left out" in notes
    assert "lists of the source keep 2 of 5 views for testing" in notes
    assert captured.facts["source"] == "scannetpp" and not captured.has_truth


def test_surface_points_land_on_their_own_colour(release, captured):
    """Check axes, undistortion and pixel centres together: a point of the mesh is projected by the true fisheye into the released
    photograph and by the captured pinhole into the captured one, and both show its colour."""
    _, views, home = release
    for view in captured:
        photo, valid = captured.photo(view, held_out=True)
        depth, face = captured.gbuffer(view)
        points = captured.points(view, depth)
        error = np.abs(own.pattern(points) - photo)[valid & (face >= 0)]
        assert np.median(error) < 0.004 and np.quantile(error, 0.95) < 0.03
        # The released picture, looked up where the scalar fisheye formula sends every 11th captured pixel.
        from PIL import Image

        released = np.asarray(Image.open(home / "dslr/resized_images" / f"{view.name}.JPG")) / 255.0
        pose = views[int(view.name[3:])][0]
        rows, columns = np.nonzero(valid & (face >= 0))
        pixels = np.array([mini.fisheye_pixel(points[r, c], pose) for r, c in zip(rows[::11], columns[::11], strict=True)])
        u, v = pixels.T - 0.5
        inner = (u > 0) & (u < mini.CAMERA.width - 1) & (v > 0) & (v < mini.CAMERA.height - 1)
        assert inner.mean() > 0.97  # the others lie in the outer half of the border's pixels
        i, j = np.clip(v.astype(int), 0, 95), np.clip(u.astype(int), 0, 144)
        a, b = (u - j)[:, None], (v - i)[:, None]
        upper = (1 - a) * released[i, j] + a * released[i, j + 1]
        lower = (1 - a) * released[i + 1, j] + a * released[i + 1, j + 1]
        looked_up = (1 - b) * upper + b * lower
        assert np.abs(looked_up - photo[rows[::11], columns[::11]])[inner].max() < 1e-4
    facts = captured.facts["alignment"]
    assert facts["edge_correlation"] > 0.05 and facts["depth_median_disagreement"] < 0.01  # edges; sparse points of colmap/


def test_objects_come_from_the_segments(release, captured):
    room, _, _ = release
    instance = captured.faces()["instance_id"]
    table = captured.reader.table("instances.parquet")
    names = dict(zip(table["instance_id"].tolist(), table["name"].tolist(), strict=True))
    found = [names.get(i, mini.UNLABELLED) for i in instance.tolist()]
    expected = [room.names[o] if room.names[o] == mini.UNLABELLED else f"{room.names[o]} {o + 1}" for o in room.object_id]
    assert found == expected
    assert (instance == -1).sum() == (room.object_id == room.names.index(mini.UNLABELLED)).sum()


def test_masked_pixels_do_not_count(release, captured, tmp_path):
    room, views, home = release
    assert sum("masked pixels are ignored" in note for note in captured.facts["notes"]) == 1
    hidden = np.zeros((mini.CAMERA.height, mini.CAMERA.width), bool)
    hidden[mini.HIDDEN] = True
    for view in captured:
        photo, valid = captured.photo(view, held_out=True)
        depth, _ = captured.gbuffer(view)
        rows, columns = np.mgrid[0 : view.height : 3, 0 : view.width : 3].reshape(2, -1)
        points = captured.points(view, depth)[rows, columns]
        pixels = np.array([mini.fisheye_pixel(p, views[int(view.name[3:])][0]) for p in points]).astype(int)
        covered = hidden[pixels[:, 1].clip(0, 96), pixels[:, 0].clip(0, 145)] & (int(view.name[3:]) in mini.MASKED)
        assert not valid[rows, columns][covered].any()
        assert (photo[~valid] == 0).all()
    # Pixels under a mask have no influence: with other values there the counts are equal (JPEG blocks around differ a little).
    other = mini.release(tmp_path / "other", room, views, garbage=0.0)
    project(tmp_path, other)
    again = own.run(tmp_path, "capture")
    for view in captured:
        photo, valid = captured.photo(view, held_out=True)
        photo_again, valid_again = again.photo(view, held_out=True)
        np.testing.assert_array_equal(valid, valid_again)
        assert np.abs(photo - photo_again).max() < 0.02


def test_the_same_scene_as_a_folder_gives_the_same_capture(release, captured, tmp_path):
    """Everything that later stages read is equal; as every stage is deterministic, so are their results."""
    room, views, home = release
    path = own.project(tmp_path, None, SETTINGS, {"kind": "given"})
    mini.twin(home, path, room, views)
    folder = own.run(tmp_path, "capture")
    manifests = [json.loads((c.reader.directory / "manifest.json").read_text()) for c in (captured, folder)]
    ours, theirs = ({name: entry["sha256"] for name, entry in m["files"].items()} for m in manifests)
    different = {name for name in ours if ours[name] != theirs.get(name)}
    assert set(ours) == set(theirs) and different == {"capture.json", "instances.parquet"}  # notes; names of objects


def test_undistorted_images_of_the_toolbox(release, copy, tmp_path):
    """A pinhole picture and PINHOLE cameras, with k = 0 left in the file as the toolbox leaves them."""
    room, views, _ = release
    camera = pinhole_inside(mini.LENS, mini.CAMERA)
    document = json.loads((copy / "dslr/nerfstudio/transforms.json").read_text())
    document |= {**own.intrinsics(camera), "camera_model": "PINHOLE"} | dict.fromkeys(("k1", "k2", "k3", "k4"), 0.0)
    (copy / "dslr/nerfstudio/transforms_undistorted.json").write_text(json.dumps(document))
    shape = mini.geometry(room)
    for i, (pose, _) in enumerate(views):
        mini.save_jpeg(copy / "dslr/undistorted_images" / mini.name(i), own.shoot(shape, pose, camera)[0])
    project(tmp_path, copy, images="undistorted")
    capture = own.run(tmp_path, "capture")
    for view in capture:
        photo, valid = capture.photo(view, held_out=True)
        error = np.abs(own.pattern(capture.points(view, capture.gbuffer(view)[0])) - photo)
        assert valid.all() and np.median(error) < 0.004 and np.quantile(error, 0.95) < 0.03
    assert "no undistorted_anon_masks/: nothing is masked" in capture.facts["notes"]


def test_wrong_world_is_named_by_colmap(copy):
    both = (copy / "dslr/nerfstudio/transforms.json", copy / "dslr/colmap/images.txt")
    named(refusal(copy, world="mesh"), *both, "source.world: nerfstudio")
    path = copy / "dslr/nerfstudio/transforms.json"
    document = json.loads(path.read_text())
    for entry in document["frames"] + document["test_frames"]:
        entry["transform_matrix"][0][3] += 0.5
    path.write_text(json.dumps(document))
    named(refusal(copy), *both, "0.5 m", "0.0 degrees")


@pytest.mark.parametrize(
    ("gone", "names"),
    [
        ("dslr/nerfstudio/transforms.json", ["source.images", "dslr, undistorted"]),
        ("scans/mesh_aligned_0.05.ply", ["scans"]),
        ("scans/segments.json", ["segmentation: {kind: given}", "segmentation: {kind: geometry}"]),
        ("scans/segments_anno.json", ["segmentation: {kind: given}", "segmentation: {kind: geometry}"]),
        ("dslr/resized_images/DSC00001.JPG", [1, "file_path"]),
        ("dslr/resized_anon_masks/DSC00001.png", [1]),
    ],
)
def test_missing_files_are_named(copy, gone, names):
    (copy / gone).unlink()
    named(refusal(copy), copy / gone, *names)


@pytest.mark.parametrize(
    ("damaged", "keep", "names"),
    [
        ("scans/mesh_aligned_0.05.ply", b"<!DOCTYPE html>", ["PLY", "b'<!DOCTYPE html>'"]),
        ("scans/mesh_aligned_0.05.ply", 0, [0]),
        ("scans/mesh_aligned_0.05.ply", 0.1, ["vertex", "face"]),
        ("dslr/resized_anon_masks/DSC00001.png", 0, ["empty"]),
        ("dslr/resized_anon_masks/DSC00001.png", 0.5, []),
    ],
)
def test_damaged_downloads_are_refused_while_planning(copy, damaged, keep, names):
    data = (copy / damaged).read_bytes()
    (copy / damaged).write_bytes(keep if isinstance(keep, bytes) else data[: int(len(data) * keep)])
    message = refusal(copy)
    assert message.startswith(f"{copy / damaged}: ")
    named(message, *names)


@pytest.mark.parametrize("gone", [("segments.json",), ("segments_anno.json",), ("segments.json", "segments_anno.json")])
def test_a_scene_without_annotation_needs_another_segmentation(copy, gone):
    for name in gone:
        (copy / "scans" / name).unlink()
    named(refusal(copy), "segmentation: {kind: geometry}")
    source = {"kind": "scannetpp", "path": str(copy)}
    tree = {"source": source, "segmentation": {"kind": "geometry"}}
    document = settings.dump(settings.SceneSettings.model_validate(tree))
    assert not any("segments" in path.name for path in scannetpp.raw_inputs(document))
    found = scannetpp.find_inputs(document["source"], document["capture"])
    assert found.of_vertices is None
    assert f"no {' and '.join(gone)}: the scene comes without object ids" in found.cameras.notes


def test_other_refusals(copy, tmp_path):
    (tmp_path / "data").mkdir()
    shutil.copytree(copy / "dslr", tmp_path / "data/scene/dslr")
    named(refusal(tmp_path / "data"), "dslr/", "source.path", tmp_path / "data/scene")
    named(refusal(copy, images="undistorted"), "transforms_undistorted.json", "dslr.undistort", "source.images")
    lists = copy / "dslr/train_test_lists.json"
    stated = json.loads(lists.read_text())
    lists.write_text(json.dumps(stated | {"test": stated["train"][:1]}))
    named(refusal(copy), lists, "DSC00000.JPG", 1)
    lists.write_text("{}")
    named(refusal(copy), lists, '{"train": [names], "test": [names]}')
    assert "8-bit" not in refusal(copy, {"dynamic_range": "hdr"})


def test_lists_without_pose_and_hidden_tests(copy, tmp_path):
    lists = copy / "dslr/train_test_lists.json"
    stated = json.loads(lists.read_text())
    lists.write_text(json.dumps(stated | {"train": [*stated["train"], "DSC09999.JPG"]}))
    (copy / "dslr/resized_images/DSC00005.JPG").unlink()
    tree = {"source": {"kind": "scannetpp", "path": str(copy)}, "prior": {"kind": "retinex"}}
    document = settings.dump(settings.SceneSettings.model_validate(tree))
    both = scannetpp.find_inputs(document["source"], document["capture"]).cameras
    assert [f.name for f in both.frames] == ["DSC00000", "DSC00001", "DSC00002", "DSC00003"]
    assert any("1 listed photographs have no pose" in note and "DSC09999" in note for note in both.notes)
    assert any("1 test photographs are not in resized_images/" in note for note in both.notes)


def test_overlapping_groups_and_foreign_segments(tmp_path):
    """Of two objects with the same segment the smaller one gets it; segments without vertices are ignored; 0 is no object."""
    (tmp_path / "s.json").write_text(json.dumps({"segIndices": [7, 7, 7, 9, 9, 4, 5]}))
    groups = [
        {"objectId": 3, "label": "sofa", "segments": [7, 9]},
        {"objectId": 12, "label": "cushion", "segments": [9, 1000]},
        {"objectId": 0, "label": "remove", "segments": [4]},
    ]
    (tmp_path / "a.json").write_text(json.dumps({"segGroups": groups}))
    found = scannetpp.vertex_ids(tmp_path / "s.json", tmp_path / "a.json")
    assert found.ids.tolist() == [3, 3, 3, 12, 12, -1, -1]
    assert found.names[12] == "cushion 12"
    np.testing.assert_array_equal(mesh.majority_id(np.array([[3, 3, 12], [3, 12, 12], [12, 3, 12], [3, 12, 4]])), [3, 12, 12, -1])
    (tmp_path / "a.json").write_text(json.dumps({"groups": []}))
    with refused("a.json", "segGroups"):
        scannetpp.vertex_ids(tmp_path / "s.json", tmp_path / "a.json")
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(tmp_path / "mesh.ply", vertices, faces)
    with refused("s.json", 7, "mesh.ply", 16):
        mesh.load(tmp_path / "mesh.ply", 1.0, found)
