"""COLMAP models and nerfstudio folders through `folder`: the miniature room's cameras in every form they are written."""

import json
import re
import struct

import numpy as np
import pytest

from iif_core.errors import InputError
from tests.errors import named
from tests.unit import own_scene as own
from tests.unit import scannetpp_scene as mini
from workflow.sources.folder_scene import colmap
from workflow.sources.folder_scene.camera import opencv_pose
from workflow.sources.folder_scene.inputs import find_inputs

CAPTURE = {"width": 320, "height": 320}


@pytest.fixture(scope="module")
def room():
    return mini.room()


@pytest.fixture(scope="module")
def views(room):
    return mini.photographs(room, 4)


def scene(path, room, views, subfolder=""):
    """images/, mesh.ply and sparse/0 as text."""
    own.save_mesh(path / "mesh.ply", room.vertices, room.faces)
    for i, (_, picture) in enumerate(views):
        mini.save_jpeg(path / "images" / subfolder / mini.name(i), picture)
    mini.colmap_text(path / "sparse/0", room, [pose for pose, _ in views], subfolder)
    return path


def listed(path, capture=None, points=False, **source):
    document = own.settings_of(path, source, {**CAPTURE, **(capture or {})})
    return find_inputs(document["source"], document["capture"], points).cameras


def refused(path, **keys):
    with pytest.raises(InputError) as caught:
        listed(path, **keys)
    return str(caught.value)


def to_binary(place):
    """The text model again in COLMAP's binary layout; the text is removed."""
    lines = [line.split() for line in (place / "cameras.txt").read_text().splitlines() if not line.startswith("#")]
    data = struct.pack("<Q", len(lines))
    for number, _, width, height, *values in lines:
        data += struct.pack("<iiQQ", int(number), 5, int(width), int(height)) + struct.pack("<8d", *map(float, values))
    (place / "cameras.bin").write_bytes(data)
    lines = [line.split() for line in (place / "images.txt").read_text().splitlines() if not line.startswith("#")]
    data = struct.pack("<Q", len(lines) // 2)
    for first, second in zip(lines[::2], lines[1::2], strict=True):
        data += struct.pack("<i7di", int(first[0]), *map(float, first[1:8]), int(first[8])) + first[9].encode() + b"\0"
        data += struct.pack("<Q", len(second) // 3)
        for x, y, number in zip(second[::3], second[1::3], second[2::3], strict=True):
            data += struct.pack("<ddq", float(x), float(y), int(number))
    (place / "images.bin").write_bytes(data)
    rows = [line.split() for line in (place / "points3D.txt").read_text().splitlines() if not line.startswith("#")]
    data = struct.pack("<Q", len(rows))
    for number, x, y, z, *_ in rows:
        data += struct.pack("<Q3d3BdQ", int(number), float(x), float(y), float(z), 1, 2, 3, 0.5, 2) + struct.pack(
            "<4i", 1, 2, 3, 4
        )
    (place / "points3D.bin").write_bytes(data)
    for part in colmap.PARTS:
        (place / f"{part}.txt").unlink()


def test_text_and_binary_hold_the_true_cameras(room, views, tmp_path):
    path = scene(tmp_path, room, views)
    text = listed(path, points=True)
    assert text.axes == "opencv" and text.path.name == "images.txt" and len(text.also) == 3
    to_binary(path / "sparse/0")
    binary = listed(path, points=True)
    assert binary.path.name == "images.bin"
    for frame, other, (pose, _) in zip(text.frames, binary.frames, views, strict=True):
        np.testing.assert_allclose(frame.matrix, pose, atol=1e-12)
        np.testing.assert_array_equal(frame.matrix, other.matrix)
        np.testing.assert_array_equal(frame.seen, other.seen)
        assert len(frame.seen) > 50
        assert (frame.camera, frame.lens) == (other.camera, other.lens) == (mini.CAMERA, mini.LENS)
    # Planning reads neither points nor keypoints.
    assert all(len(frame.seen) == 0 for frame in listed(path).frames) and len(listed(path).also) == 2


def test_capture_of_a_model_matches_the_room(room, views, tmp_path):
    path = scene(own.project(tmp_path, None, CAPTURE), room, views)
    capture = own.run(tmp_path, "capture")
    assert len(capture.views) == 4
    for view in capture:
        photo, valid = capture.photo(view, held_out=True)
        depth, face = capture.gbuffer(view)
        error = np.abs(own.pattern(capture.points(view, depth)) - photo)[valid & (face >= 0)]
        assert np.median(error) < 0.004 and np.quantile(error, 0.95) < 0.03
    facts = capture.facts["alignment"]
    assert facts["depth_median_disagreement"] < 0.01 and facts["depth_samples"] > 200
    assert any("mesh depth differs from the sparse points" in note for note in capture.facts["notes"])
    assert path.is_dir()


@pytest.mark.parametrize(
    ("change", "settings"),
    [
        (lambda v: v * 1.3, ["alignment: warn"]),
        (lambda v: v * 1000, ["unit: m"]),
        (lambda v: np.stack([v[:, 0], v[:, 2], -v[:, 1]], 1), ["mesh_up: y", "alignment: warn"]),
    ],
)
def test_sparse_points_tell_a_wrong_mesh(room, views, tmp_path, change, settings):
    """What would help is named, and nothing else."""
    path = scene(own.project(tmp_path, None, CAPTURE), room, views)
    own.save_mesh(path / "mesh.ply", change(room.vertices.astype(float)), room.faces)
    with pytest.raises(InputError) as caught:
        own.run(tmp_path, "capture")
    assert re.findall(r"`source\.(.+?)`", str(caught.value)) == settings


def cameras(path, line):
    (path / "sparse/0/cameras.txt").write_text(line + "\n")


def test_changed_intrinsics_are_found_by_the_keypoints(room, views, tmp_path):
    path = scene(tmp_path, room, views)
    k = " ".join(map(repr, mini.LENS.k))
    cameras(path, f"1 OPENCV_FISHEYE 146 97 72.4 48.9 65.8 66.1 {k}")  # focal lengths and principal point exchanged
    named(refused(path, points=True), "images.txt", "1.0%", "fx", "cx")
    cameras(path, f"1 OPENCV_FISHEYE 146 97 65.8 66.1 48.9 72.4 {k}")
    named(refused(path), "image 'DSC00000.JPG'", "(48.9, 72.4)", "cx", "cy")
    listed(path, alignment="off")
    cameras(path, f"1 PINHOLE 146 97 {mini.CAMERA.fx} {mini.CAMERA.fy} {mini.CAMERA.cx} {mini.CAMERA.cy}")
    named(refused(path, points=True), "images.txt", "1.0%", "fx", "cx")


@pytest.mark.parametrize(
    ("line", "kind", "k", "p"),
    [
        ("SIMPLE_PINHOLE 146 97 60 73 48", "radial_tangential", (0, 0, 0, 0), (0, 0)),
        ("PINHOLE 146 97 60 61 73 48", "radial_tangential", (0, 0, 0, 0), (0, 0)),
        ("SIMPLE_RADIAL 146 97 60 73 48 0.1", "radial_tangential", (0.1, 0, 0, 0), (0, 0)),
        ("RADIAL 146 97 60 73 48 0.1 0.02", "radial_tangential", (0.1, 0.02, 0, 0), (0, 0)),
        ("OPENCV 146 97 60 61 73 48 0.1 0.02 0.003 0.004", "radial_tangential", (0.1, 0.02, 0, 0), (0.003, 0.004)),
        (
            "FULL_OPENCV 146 97 60 61 73 48 0.1 0.02 0.003 0.004 0.005 0 0 0",
            "radial_tangential",
            (0.1, 0.02, 0.005, 0),
            (0.003, 0.004),
        ),
        ("OPENCV_FISHEYE 146 97 60 61 73 48 0.1 0.02 0.003 0.004", "fisheye", (0.1, 0.02, 0.003, 0.004), (0, 0)),
        ("SIMPLE_RADIAL_FISHEYE 146 97 60 73 48 0.1", "fisheye", (0.1, 0, 0, 0), (0, 0)),
        ("RADIAL_FISHEYE 146 97 60 73 48 0.1 0.02", "fisheye", (0.1, 0.02, 0, 0), (0, 0)),
    ],
)
def test_lens_models(room, views, tmp_path, line, kind, k, p):
    path = scene(tmp_path, room, views[:1])
    cameras(path, f"1 {line}")
    frame = listed(path).frames[0]
    assert (frame.lens.kind, frame.lens.k, frame.lens.p) == (kind, k, p)
    assert (frame.camera.fx, frame.camera.cx, frame.camera.cy) == (60, 73, 48)
    assert frame.camera.fy == (60 if "f" in colmap.MODELS[line.split()[0]][2] else 61)


def test_refused_models(room, views, tmp_path):
    path = scene(tmp_path, room, views[:2], "cam/")
    place = path / "sparse/0"
    cameras(path, "1 FOV 146 97 60 60 73 48 0.9")
    named(refused(path), "cameras.txt", "camera 1", "FOV", "SIMPLE_PINHOLE", "colmap image_undistorter")
    cameras(path, "1 FULL_OPENCV 146 97 60 60 73 48 0 0 0 0 0 0.1 0 0")
    named(refused(path), "cameras.txt", "camera 1", "k4, k5, k6", "colmap image_undistorter")
    cameras(path, "1 PINHOLE 146 97 60")
    named(refused(path), "cameras.txt", "camera 1, PINHOLE", 1, 4)
    cameras(path, "2 PINHOLE 146 97 60 60 73 48")
    named(refused(path), "images.txt", "camera 1", "cameras.txt")
    cameras(path, "1 PINHOLE 292 194 120 120 146 96")
    named(refused(path), "images.txt", "146x97", "w", "h", "292x194", "0.5")
    cameras(path, "1 OPENCV_FISHEYE 146 97 65.8 66.1 72.4 48.9 0 0 0 0")
    assert [f.name for f in listed(path).frames] == ["DSC00000", "DSC00001"]
    text = (place / "images.txt").read_text()
    (place / "images.txt").write_text(text.replace("cam/DSC00001.JPG", "cam/DSC00000.png"))
    named(refused(path), "'cam/DSC00000.JPG'", "'cam/DSC00000.png'", "view 'DSC00000'")
    (place / "images.txt").write_text("# empty\n")
    named(refused(path), "images.txt", "sparse/1")
    (place / "images.txt").write_text(text)
    to_binary(place)
    data = (place / "images.bin").read_bytes()
    (place / "images.bin").write_bytes(data[:-60])
    named(refused(path, points=True), "images.bin", "cam/DSC00001.JPG", "keypoints")
    (path / "images").rename(path / "photos")
    (place / "images.bin").write_bytes(data)
    named(refused(path), path / "images", "source.images", "images.bin")
    assert len(listed(path, images="photos").frames) == 2
    named(refused(path, cameras="sparse/1", images="photos"), path / "sparse/1", "source.cameras: sparse/1", ".bin", ".txt")


def test_images_without_pose_masks_and_places(room, views, tmp_path):
    path = scene(tmp_path, room, views)
    mini.save_jpeg(path / "images/DSC00099.JPG", views[0][1])
    mask = np.full((97, 146), 7, np.uint8)
    mask[:10] = 0
    mini.save_mask(path / "masks/DSC00001.JPG.png", mask)
    mini.save_mask(path / "masks/DSC00002.JPG.png", mask)
    mini.save_mask(path / "masks/DSC00003.png", mask)  # the form of a segmentation's masks: not of what counts
    found = listed(path)
    assert any("1 of 5 images have no pose" in note and "DSC00099" in note for note in found.notes)
    assert [f.mask.name if f.mask else None for f in found.frames] == [None, "DSC00001.JPG.png", "DSC00002.JPG.png", None]
    (path / "sparse/0").rename(path / "elsewhere")
    named(refused(path), path, "transforms.json", "COLMAP", "docs/guide/programs.md")
    assert len(listed(path, cameras="elsewhere").frames) == 4
    assert len(listed(path, cameras="elsewhere/images.txt").frames) == 4
    root = tmp_path / "run"
    own.project(root, {"path": str(path), "cameras": "elsewhere"}, CAPTURE)
    capture = own.run(root, "capture")
    hidden = [float((~capture.photo(view, held_out=True)[1]).mean()) for view in capture]
    assert hidden[0] == hidden[3] < 0.01 and min(hidden[1:3]) > 0.02
    assert any("masked pixels are ignored (2 masks)" in note for note in capture.facts["notes"])


# ------------------------------------------------------------------------------------------------------------ nerfstudio


def nerfstudio(path, room, views):
    """What ns-process-data writes: the world turned by applied_transform, a mask, lists of file names."""
    own.save_mesh(path / "mesh.ply", room.vertices, room.faces)
    applied = np.array([[0.0, 1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, -1, 0.1]])
    document = {**own.intrinsics(mini.CAMERA), "camera_model": "OPENCV_FISHEYE", "applied_transform": applied.tolist()}
    document |= {f"k{i + 1}": k for i, k in enumerate(mini.LENS.k)} | {"frames": []}
    for i, (pose, picture) in enumerate(views):
        mini.save_jpeg(path / "images" / mini.name(i), picture)
        matrix = np.concatenate([applied @ pose @ np.diag([1.0, -1, -1, 1]), [[0, 0, 0, 1.0]]])
        document["frames"].append({"file_path": f"images/{mini.name(i)}", "transform_matrix": matrix.tolist()})
    mask = np.ones((97, 146), np.uint8)
    mask[50:] = 0
    mini.save_mask(path / "masks/one.png", mask)
    document["frames"][1]["mask_path"] = "masks/one.png"
    files = [f["file_path"] for f in document["frames"]]
    document |= {"train_filenames": files[:2], "val_filenames": files[2:3], "test_filenames": files[2:3]}
    own.write_transforms(path, document)
    return document


def test_nerfstudio_lists_masks_and_applied_transform(room, views, tmp_path):
    path = own.project(tmp_path, {"applied_transform": "undo"}, CAPTURE)
    nerfstudio(path, room, views)
    capture = own.run(tmp_path, "capture")
    assert [(v.name, v.split) for v in capture] == [("DSC00000", "train"), ("DSC00001", "train"), ("DSC00002", "test")]
    for view, (pose, _) in zip(capture, views, strict=False):
        np.testing.assert_allclose(view.world_from_camera, pose, atol=1e-12)
    # A mask of ones and zeros, not 255: what is not 0 counts.
    shares = [float(capture.photo(view, held_out=True)[1].mean()) for view in capture]
    assert shares[0] > 0.99 and shares[2] > 0.99 and 0.4 < shares[1] < 0.6


def test_nerfstudio_refusals(room, views, tmp_path):
    document = nerfstudio(tmp_path, room, views)

    def changed(source=None, **keys):
        own.write_transforms(tmp_path, {k: v for k, v in (document | keys).items() if v is not None})
        return refused(tmp_path, **(source or {}))

    both = [document["frames"][0]["file_path"]]
    named(changed(test_filenames=both), f"'{both[0]}'", "train_filenames", "test_filenames")
    named(changed(test_filenames=["images/none.JPG"]), "transforms.json", "images/none.JPG", "file_path")
    all_of_them = [f["file_path"] for f in document["frames"]]
    named(changed(train_filenames=None, val_filenames=all_of_them), "transforms.json", "4 photographs")
    undo = {"applied_transform": "undo"}
    named(
        changed(undo, applied_transform=None),
        "source.applied_transform: undo",
        "applied_transform",
        "source.applied_transform: keep",
    )
    stretched = [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0]]
    named(changed(undo, applied_transform=stretched), "applied_transform", "determinant 2")
    named(changed(undo, applied_scale=-1), "applied_scale", -1)
    (tmp_path / "masks/one.png").unlink()
    named(changed(), "transforms.json", tmp_path / "masks/one.png", 1)


def test_applied_scale_moves_cameras_without_stretching_them(room, views, tmp_path):
    document = nerfstudio(tmp_path, room, views)
    for entry in document["frames"]:
        matrix = np.array(entry["transform_matrix"])
        matrix[:3, 3] *= 0.25
        entry["transform_matrix"] = matrix.tolist()
    own.write_transforms(tmp_path, document | {"applied_scale": 0.25})
    for frame, (pose, _) in zip(listed(tmp_path, applied_transform="undo").frames, views, strict=False):
        np.testing.assert_allclose(opencv_pose(frame.matrix, "opengl", 1.0), pose, atol=1e-12)


def test_cameras_may_be_another_json(room, views, tmp_path):
    document = nerfstudio(tmp_path, room, views)
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    assert len(listed(tmp_path, cameras="transforms_train.json").frames) == 3
    assert json.loads((tmp_path / "transforms_train.json").read_text())["frames"] == document["frames"]
