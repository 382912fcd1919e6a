"""Source `folder`: cameras, pictures and meshes of users, and the check that they belong together."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from iif_core.camera.distortion import Distortion, pinhole_inside
from iif_core.errors import InputError
from iif_core.surface.axes import turn_of
from tests.errors import misset, missing, named, refused
from tests.unit import own_scene as own
from workflow.artifacts import StageReader
from workflow.exporters.camera_files import cameras_json
from workflow.exporters.glb import rotation_to_y
from workflow.scene.normal_form import View, stated_exposures, widest
from workflow.settings.source import FolderSource
from workflow.sources import folder
from workflow.sources.folder_scene import alignment, images, mesh, transforms
from workflow.sources.folder_scene.camera import opencv_pose
from workflow.sources.folder_scene.entries import evenly_spread


def read(path, source=None, capture=None):
    document = own.settings_of(path, source, capture)
    return transforms.read(document["source"], document["capture"])


# ----------------------------------------------------------------------------------------------------------------
# cameras


def test_opengl_poses_become_opencv(tmp_path):
    own.bare(tmp_path)
    frames = read(tmp_path).frames
    for frame, pose in zip(frames, own.poses(3), strict=True):
        np.testing.assert_allclose(opencv_pose(frame.matrix, "opengl", 1.0), pose, atol=1e-12)
        in_mm = opencv_pose(frame.matrix, "opengl", 0.001)
        np.testing.assert_allclose(in_mm[:3, 3], pose[:3, 3] * 0.001)
        np.testing.assert_allclose(in_mm[:3, :3], pose[:3, :3], atol=1e-12)
    assert [f.name for f in frames] == ["000", "001", "002"]
    assert frames[0].camera == own.CAMERA


@pytest.mark.parametrize(
    ("stated", "setting", "offset"),
    [
        (None, "auto", 0),
        ("integer coordinates", "auto", 0.5),
        ("half-integer", "auto", 0),
        (None, "integer", 0.5),
    ],
)
def test_pixel_centres(tmp_path, stated, setting, offset):
    document = own.bare(tmp_path)
    if stated:
        document["pixel_centres_at"] = stated
    own.write_transforms(tmp_path, document)
    camera = read(tmp_path, {"pixel_centre": setting}).frames[0].camera
    assert (camera.cx, camera.cy) == (33.0 + offset, 23.0 + offset)


def test_intrinsics_from_an_angle_and_per_frame(tmp_path):
    document = own.bare(tmp_path)
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        del document[key]
    document["camera_angle_x"] = 2 * np.arctan(0.5)
    document["frames"][1] |= {"fl_x": 70.0, "w": 64, "h": 48}
    own.write_transforms(tmp_path, document)
    first, second, _ = read(tmp_path).frames
    assert (first.camera.fx, first.camera.fy) == (pytest.approx(64), pytest.approx(64))
    assert (first.camera.cx, first.camera.cy) == (32, 24)
    assert second.camera.fx == 70.0


def test_paths_without_extension_globs_and_spread(tmp_path):
    document = own.bare(tmp_path, 8)
    for entry in document["frames"]:
        entry["file_path"] = "./" + entry["file_path"].removesuffix(".png")
    own.write_transforms(tmp_path, document)
    found = read(tmp_path, capture={"views": 4})
    assert [f.name for f in found.frames] == ["001", "003", "005", "007"] and not read(tmp_path).notes
    named(found.notes[0], "4 of the 8 photographs", "`capture.views: 4`")
    assert [f.name for f in read(tmp_path, {"frames": "images/00[0-2]"}).frames] == ["000", "001", "002"]
    assert evenly_spread(3, 5) == [0, 1, 2] and evenly_spread(100, 1) == [50]
    got = folder.raw_inputs(own.settings_of(tmp_path, capture={"views": 4}))
    assert [p.name for p in got] == [
        "transforms.json",
        "mesh.ply",
        "001.png",
        "003.png",
        "005.png",
        "007.png",
    ]


@pytest.mark.parametrize(
    ("keys", "kind", "k"),
    [
        ({"camera_model": "OPENCV", "k1": -0.1, "p1": 0.001}, "radial_tangential", (-0.1, 0, 0, 0)),
        ({"k1": -0.1}, "radial_tangential", (-0.1, 0, 0, 0)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": -0.1, "k4": 0.01}, "fisheye", (-0.1, 0, 0, 0.01)),
        ({"is_fisheye": True, "k1": -0.1}, "fisheye", (-0.1, 0, 0, 0)),
    ],
)
def test_lenses(tmp_path, keys, kind, k):
    document = own.bare(tmp_path)
    own.write_transforms(tmp_path, document | keys)
    lens = read(tmp_path).frames[0].lens
    assert (lens.kind, lens.k) == (kind, k)


# ---------------------------------------------------------------------------------------------------------------
# pictures


def png16(path, values):
    """A 16-bit PNG of any channel count (Pillow writes none in colour)."""
    import struct
    import zlib

    height, width, channels = values.shape
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    colour = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    header = struct.pack(">IIBBBBB", width, height, 16, colour, 0, 0, 0)
    data = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + data)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bits_are_kept(tmp_path, channels):
    values = np.random.default_rng(channels).integers(0, 65536, (5, 7, channels)).astype(np.uint16)
    png16(tmp_path / "a.png", values)
    photo = images.load_photo(tmp_path / "a.png")
    grey = channels < 3
    expected = np.repeat(values[..., :1], 3, -1) if grey else values[..., :3]
    np.testing.assert_allclose(photo.pixels, expected / 65535.0, atol=1e-7)
    alpha = values[..., -1] / 65535 if channels in (2, 4) else np.ones((5, 7))
    np.testing.assert_array_equal(photo.valid, alpha >= 0.5)
    assert photo.transparent == int((alpha < 0.5).sum())


def test_eight_bits_grey_palette_and_alpha(tmp_path):
    from PIL import Image

    rng = np.random.default_rng(0)
    rgba = rng.integers(0, 256, (6, 9, 4)).astype(np.uint8)
    Image.fromarray(rgba, "RGBA").save(tmp_path / "rgba.png")
    photo = images.load_photo(tmp_path / "rgba.png")
    np.testing.assert_allclose(photo.pixels, rgba[..., :3] / 255.0, atol=1e-7)
    np.testing.assert_array_equal(photo.valid, rgba[..., 3] >= 128)
    Image.fromarray(rgba[..., 0], "L").save(tmp_path / "grey.jpg", quality=100)
    grey = images.load_photo(tmp_path / "grey.jpg").pixels
    assert grey.shape == (6, 9, 3) and np.abs(grey[..., 0] - rgba[..., 0] / 255).max() < 0.02
    flat = Image.fromarray(np.full((4, 4, 3), (10, 200, 30), np.uint8)).convert("P", palette=Image.Palette.ADAPTIVE)
    flat.save(tmp_path / "p.png")
    np.testing.assert_allclose(images.load_photo(tmp_path / "p.png").pixels[0, 0], np.array([10, 200, 30]) / 255, atol=1e-6)


def test_exr_pictures_and_bad_pixels(tmp_path):
    value = np.full((4, 5), 2.5, np.float32)
    bad = value.copy()
    bad[0, 0], bad[1, 1], bad[2, 2] = np.nan, np.inf, -1
    own.save_raw_exr(tmp_path / "a.exr", {"R": bad, "G": value, "B": value})
    photo = images.load_photo(tmp_path / "a.exr")
    assert (photo.non_finite, photo.negative) == (2, 1)
    assert np.argwhere(~photo.valid).tolist() == [[0, 0], [1, 1]]
    assert np.isfinite(photo.pixels).all() and photo.pixels.min() == 0
    alpha = np.full((4, 5), 0.75, np.float32)
    alpha[0] = 0.2
    own.save_exr(tmp_path / "b.exr", {**dict.fromkeys("RGB", value * 0.75), "A": alpha})
    photo = images.load_photo(tmp_path / "b.exr")
    np.testing.assert_allclose(photo.pixels[1:], 2.5)  # multiplied by alpha in the file
    assert photo.transparent == 5 and not photo.valid[0].any()
    own.save_exr(tmp_path / "c.exr", {"Y": value})
    assert images.load_photo(tmp_path / "c.exr").pixels.shape == (4, 5, 3)
    own.save_exr(tmp_path / "d.exr", {"diffuse.R": value, "diffuse.G": value})
    with refused("d.exr", "diffuse.G, diffuse.R", "R G B"):
        images.load_photo(tmp_path / "d.exr")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turns_agree_with_pillow(orientation):
    from PIL import Image, ImageOps

    stored = np.arange(12, dtype=np.uint8).reshape(3, 4)
    image = Image.fromarray(stored)
    image.getexif()[274] = orientation
    upright = np.asarray(ImageOps.exif_transpose(image))
    np.testing.assert_array_equal(images.TURNS[orientation](stored), upright)


def _stating(path, time=None, speed=None, number=None):
    """Save a small photograph whose file states how it was taken; return what is read."""
    from PIL import Image

    exif = Image.Exif()
    tags = {33434: time, 34855: speed, 33437: number}
    exif.get_ifd(0x8769).update({tag: value for tag, value in tags.items() if value is not None})
    Image.new("RGB", (8, 6)).save(path, exif=exif)
    return images.header(path).stated


def test_exposures_that_files_state(tmp_path):
    assert _stating(tmp_path / "a.jpg", 1 / 50, 200, 2.0) == pytest.approx((200 / 50, 2.0), rel=1e-3)
    assert _stating(tmp_path / "b.jpg", 1 / 50, 200) == (pytest.approx(200 / 50, rel=1e-3), None)
    for number, wrong in enumerate([(), (0.02,), (0.02, 0, 2.0), (0.02, 65535), (0.0, 100), (0.02, 100, 0.0), (1e6, 100, 2.0)]):
        assert _stating(tmp_path / f"wrong{number}.jpg", *wrong) is None
    from PIL import Image

    beyond, itself = b"II*\0\xff\xff\xff\xff", b"MM\0*\0\0\0\x08\0\x01\x87\x69\0\x04\0\0\0\x01\0\0\0\x08"
    for broken in (b"Exif\0\0", b"Exif\0\0" + beyond, b"Exif\0\0" + itself):
        Image.new("RGB", (8, 6)).save(tmp_path / "broken.jpg", exif=broken)
        assert images.header(tmp_path / "broken.jpg").stated is None


def _stated_by_capture(folder, photographs):
    """Exposures in the capture of photographs whose files state time, ISO speed and f number; None = no EXIF."""
    from PIL import Image

    document = own.bare(folder / "data/own", len(photographs))
    for frame, tags in zip(document["frames"], photographs, strict=True):
        path = folder / "data/own" / frame["file_path"]
        if tags is None:
            continue
        exif = Image.Exif()
        exif.get_ifd(0x8769).update(dict(zip((33434, 34855, 33437), tags, strict=False)))
        Image.open(path).convert("RGB").save(path.with_suffix(".jpg"), exif=exif, quality=95)
        frame["file_path"] = str(path.with_suffix(".jpg").relative_to(folder / "data/own"))
    own.write_transforms(folder / "data/own", document)
    own.project(folder)
    return own.run(folder, "capture")


def test_stated_exposures_stand_in_the_capture(tmp_path):
    capture = _stated_by_capture(tmp_path, [(0.01, 100), (0.02, 200), None])
    stated = stated_exposures(capture.facts, capture.views)
    np.testing.assert_allclose(stated, [1.0, 4.0, np.nan], rtol=1e-3)
    assert stated_exposures(capture.facts, capture.views[1:2]) == pytest.approx([4.0], rel=1e-3)


def test_photographs_without_an_f_number_state_nothing_beside_others_with_one(tmp_path):
    capture = _stated_by_capture(tmp_path, [(0.01, 100, 2.0), (0.02, 200), (0.04, 100, 4.0)])
    np.testing.assert_allclose(stated_exposures(capture.facts, capture.views), [0.25, np.nan, 0.25], rtol=1e-3)


def test_without_exif_nothing_is_stated(tmp_path):
    capture = _stated_by_capture(tmp_path, [None, None, None])
    assert stated_exposures(capture.facts, capture.views) is None


def test_exif_turned_picture_is_turned_when_the_cameras_say_so(tmp_path):
    from PIL import Image

    document = own.bare(tmp_path, 1)
    path = tmp_path / document["frames"][0]["file_path"]
    exif = Image.Exif()
    exif[274] = 6
    stored = np.zeros((64, 48, 3), np.uint8)  # 48 wide as stored, 64 wide when turned
    stored[0, 0] = 255
    Image.fromarray(stored).save(path, exif=exif)
    frame = read(tmp_path).frames[0]
    assert frame.turn == 6
    photo = images.load_photo(frame.image, frame.turn)
    assert photo.pixels.shape == (48, 64, 3) and photo.pixels[0, -1].min() == 1
    document |= {"w": 48, "h": 64, "cx": 24, "cy": 32}
    own.write_transforms(tmp_path, document)
    assert read(tmp_path).frames[0].turn == 1
    del document["w"], document["h"]
    own.write_transforms(tmp_path, document)
    with refused("images/000.png", "EXIF", 6, 1):
        read(tmp_path)


def test_area_reduction():
    rng = np.random.default_rng(3)
    image = rng.random((12, 20, 3)).astype(np.float32)
    every = np.ones((12, 20), bool)
    whole, seen = images.reduce_area(image, every, 5, 4)
    np.testing.assert_allclose(whole, image.reshape(4, 3, 5, 4, 3).mean((1, 3)), rtol=1e-6)
    assert seen.all()
    odd, _ = images.reduce_area(image, every, 7, 5)  # not a divisor: the total must still be right
    np.testing.assert_allclose(odd.mean((0, 1)), image.mean((0, 1)), rtol=1e-6)
    integral = np.concatenate([[0], np.cumsum(image[0, :, 0], dtype=np.float64)])  # of the steps that pixels are
    edges = np.interp(np.arange(8) * 20 / 7, np.arange(21), integral)
    row, _ = images.reduce_area(image, every, 7, 12)
    np.testing.assert_allclose(row[0, :, 0], np.diff(edges) / (20 / 7), rtol=1e-6)
    mask = every.copy()
    mask[:3, :2] = False
    mask[3:6, :3] = False
    out, seen = images.reduce_area(image, mask, 5, 4)
    np.testing.assert_allclose(out[0, 0], image[:3, 2:4].mean((0, 1)), rtol=1e-6)
    assert seen[0, 0] and not seen[1, 0] and (out[1, 0] == 0).all()
    assert images.fitted_size(640, 480, 160, 160) == (160, 120)
    assert images.fitted_size(30, 20, 160, 160) == (30, 20)
    assert images.fitted_size(4000, 3, 100, 100) == (100, 1)


def test_ids(tmp_path):
    from PIL import Image

    wide = np.array([[0, 1, 300], [65535, 7, 2]], np.uint16)
    Image.fromarray(wide).save(tmp_path / "a.png")
    np.testing.assert_array_equal(images.load_ids(tmp_path / "a.png"), [[0, 1, 300], [-1, 7, 2]])
    own.save_exr(tmp_path / "b.exr", {"id": np.array([[5, 0xFFFFFFFF]], np.uint32)})
    np.testing.assert_array_equal(images.load_ids(tmp_path / "b.exr"), [[5, -1]])
    own.save_raw_exr(tmp_path / "c.exr", {"id": np.array([[3.0, np.nan, -1.0]], np.float32)})
    np.testing.assert_array_equal(images.load_ids(tmp_path / "c.exr"), [[3, -1, -1]])
    own.save_exr(tmp_path / "d.exr", {"id": np.array([[3.5]], np.float32)})
    with refused("d.exr", 1):
        images.load_ids(tmp_path / "d.exr")
    own.save_png(tmp_path / "e.png", np.zeros((2, 2, 3)))
    with refused("e.png", "EXR"):
        images.load_ids(tmp_path / "e.png")


# -------------------------------------------------------------------------------------------------------------------
# mesh


def test_ply_with_instances_units_and_waste(tmp_path):
    vertices, faces, thing = own.room_mesh()
    vertices = np.concatenate([vertices * 1000, [[np.nan, 0, 0], [5e5, 0, 0]]])
    faces = np.concatenate([faces, [[0, 0, 1], [3, 4, 4], [0, 1, 16]]])
    own.save_mesh(tmp_path / "mesh.ply", vertices, faces, np.concatenate([np.where(thing == 1, 700, -1), [9, 9, 9]]))
    got = mesh.load(tmp_path / "mesh.ply", 0.001)
    assert len(got.faces) == 24 and len(got.vertices) == 16  # the unused far vertex does not count
    assert got.diagonal == pytest.approx(np.linalg.norm([4, 3, 2.5]))
    np.testing.assert_array_equal(got.instance, np.where(thing == 1, 0, -1))
    assert got.names == ["instance 700"]
    assert got.notes == ["mesh: 1 faces with NaN vertices removed", "mesh: 2 zero-area triangles removed"]


def test_glb_nodes_are_moved_and_kept_apart(tmp_path):
    import trimesh

    part = trimesh.creation.box((1, 1, 1))
    scene = trimesh.Scene()
    scene.add_geometry(part, node_name="left")
    scene.add_geometry(part, node_name="right", transform=trimesh.transformations.translation_matrix((3, 0, 0)))
    mirrored = np.diag([-1.0, 1, 1, 1])
    mirrored[0, 3] = 6
    scene.add_geometry(part, node_name="mirror", transform=mirrored)
    scene.export(tmp_path / "mesh.glb")
    got = mesh.load(tmp_path / "mesh.glb", 1.0)
    assert sorted(got.names) == ["left", "mirror", "right"] and got.from_nodes
    np.testing.assert_allclose(got.bounds, [[-0.5, -0.5, -0.5], [6.5, 0.5, 0.5]])
    for name, x in (("left", 0), ("right", 3), ("mirror", 6)):
        corners = got.vertices[got.faces[got.instance == got.names.index(name)]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outward = ((corners.mean(1) - [x, 0, 0]) * normal).sum(1)
        assert len(corners) == 12 and (outward > 0).all()


def test_obj(tmp_path):
    vertices, faces, _ = own.room_mesh()
    text = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    (tmp_path / "mesh.obj").write_text("\n".join(text))
    got = mesh.load(mesh.find(tmp_path, None), 1.0)
    np.testing.assert_allclose(np.sort(got.vertices[got.faces].mean(1), 0), np.sort(vertices[faces].mean(1), 0))


# ----------------------------------------------------------------------------------------------------------------
# capture


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A photographed room and its capture at half size."""
    root = tmp_path_factory.mktemp("plain")
    path = own.project(root, capture={"width": 32, "height": 32, "test_every": 4})
    _, shots = own.photographed(path)
    return root, shots, own.run(root, "capture")


def test_capture_matches_the_known_room(scene):
    root, shots, capture = scene
    assert [v.split for v in capture] == ["train", "train", "train", "test"]
    small = alignment.scaled(own.CAMERA, 32, 24)
    for view, (pose, picture, _, _) in zip(capture, shots, strict=True):
        assert (view.width, view.height, view.fx, view.cx, view.cy) == (32, 24, 30.0, 16.5, 11.5)
        np.testing.assert_allclose(view.world_from_camera, pose, atol=1e-9)
        photo, valid = capture.photo(view, held_out=True)
        assert valid.all()
        np.testing.assert_allclose(photo, picture.reshape(24, 2, 32, 2, 3).mean((1, 3)), atol=0.003)
        _, z, face = own.shoot(own.geometry(), pose, small)
        depth, face_id = capture.gbuffer(view)
        np.testing.assert_allclose(depth, z, rtol=1e-5)
        np.testing.assert_array_equal(face_id, face)
        # Surface points from the normal form carry the colours of the photograph: axes and pixel centres agree.
        error = np.abs(own.pattern(capture.points(view, depth)) - photo)
        assert np.median(error) < 0.004
        assert np.quantile(error, 0.95) < 0.08  # the rest are silhouettes, where a photograph's pixel sees two surfaces
    facts = capture.facts["alignment"]
    assert facts["depth_median_disagreement"] < 0.01 and facts["depth_samples"] > 5000
    assert capture.facts["source"] == "folder" and not capture.has_truth
    assert any("reduced to 32x24" in note for note in capture.facts["notes"])


def test_the_view_that_shows_most_is_the_widest(tmp_path):
    """A camera close to the block shows little, whatever comes first; a held-out photograph is not chosen."""
    path = own.project(tmp_path, source={"registration": "off", "alignment": "off"}, capture={"test_every": 3})
    document, _ = own.photographed(path, 4, depth=False)
    for i in (0, 1, 3):  # into a corner of the floor
        matrix = np.array(document["frames"][i]["transform_matrix"])
        matrix[:3, 3] = matrix[:3, 3] * 0.1 + np.array([2.9, -0.5, 1.45]) * 0.9
        document["frames"][i]["transform_matrix"] = matrix.tolist()
    own.write_transforms(path, document)
    capture = own.run(tmp_path, "capture")
    assert capture.views[2].split == "test" and widest(capture).name != "002"
    capture.views[2] = replace(capture.views[2], split="train")
    assert widest(capture).name == "002"


def test_same_input_same_bytes(scene):
    root, _, capture = scene
    before = (root / "results/own/capture/manifest.json").read_text()
    own.run(root, "capture")
    assert (root / "results/own/capture/manifest.json").read_text() == before


@pytest.mark.parametrize(
    "lens",
    [
        Distortion("radial_tangential", (-0.25, 0.05, 0.0, 0.0), (1e-3, -5e-4)),
        Distortion("fisheye", (-0.03, 0.002, 0.0, 0.0)),
    ],
)
def test_distortion_is_removed(tmp_path, lens):
    path = own.project(tmp_path, capture={"width": 200, "height": 200})
    document, shots = own.photographed(path, 2, depth=False, lens=lens)
    document |= {"camera_model": "OPENCV_FISHEYE" if lens.kind == "fisheye" else "OPENCV"}
    document |= {f"k{i + 1}": c for i, c in enumerate(lens.k)} | {f"p{i + 1}": c for i, c in enumerate(lens.p)}
    own.write_transforms(path, document)
    capture = own.run(tmp_path, "capture")
    target = pinhole_inside(lens, own.CAMERA)
    assert len(capture.views) == len(shots)
    for view in capture:
        assert (view.width, view.height, view.fx) == (target.width, target.height, target.fx)
        photo, valid = capture.photo(view, held_out=True)
        depth, _ = capture.gbuffer(view)
        error = np.abs(own.pattern(capture.points(view, depth)) - photo)[valid]
        assert valid.mean() > 0.98
        assert np.median(error) < 0.004
        assert np.quantile(error, 0.95) < 0.03
    assert any("lens distortion" in n for n in capture.facts["notes"])
    assert any("equally exposed" in n for n in capture.facts["notes"]) and not capture.facts["exposure_estimated"]


def test_hdr_exposure_nan_instances_and_truth(tmp_path):
    path = own.project(tmp_path, capture={"dynamic_range": "hdr"})
    document, shots = own.photographed(path, 3, depth=False, hdr=True, gains=[1.0, 4.0, 0.5])
    (path / "exposures.json").write_text(json.dumps({"images/000.exr": 1, "001": 4.0, "./images/002.exr": 0.5}))
    spoilt = shots[0][1].astype(np.float32)
    spoilt[5, 6] = np.nan
    own.save_raw_exr(path / "images/000.exr", {c: np.ascontiguousarray(spoilt[..., k]) for k, c in enumerate("RGB")})
    for i, (_, _, _, face) in enumerate(shots):
        things = np.where(face < 0, 65535, face // 12).astype(np.uint16)
        from PIL import Image

        (path / "instances").mkdir(exist_ok=True)
        Image.fromarray(things).save(path / f"instances/{i:03d}.png")
        ones = np.ones((48, 64), np.float32)
        for kind in ("albedo", "emission"):
            own.save_exr(path / f"truth/{kind}/{i:03d}.exr", dict.fromkeys("RGB", ones * 0.25))
        own.save_exr(path / f"truth/roughness/{i:03d}.exr", {"Y": ones * 0.5})
        own.save_exr(path / f"truth/metallic/{i:03d}.exr", {"V": ones * 0})
    capture = own.run(tmp_path, "capture", "segmentation")
    assert capture.has_truth and capture.is_hdr
    for i, view in enumerate(capture):
        photo, valid = capture.photo(view, held_out=True)
        assert view.exposure == 1.0
        np.testing.assert_allclose(photo[valid], own.pattern(capture.points(view, capture.gbuffer(view)[0]))[valid], atol=2e-5)
        truth = capture.truth(view)
        assert (truth.albedo == 0.25).all() and (truth.roughness == 0.5).all() and (truth.metallic == 0).all()
        np.testing.assert_array_equal(truth.radiance, photo)
        np.testing.assert_array_equal(truth.valid, valid)
        np.testing.assert_array_equal(capture.given_instances(view), shots[i][3] // 12)
    assert not capture.photo(capture.views[0])[1][5, 6]
    assert "photographs: 1 NaN or infinite pixels are ignored" in capture.facts["notes"]
    assert not any("no exposures.json" in note for note in capture.facts["notes"])


def test_estimated_exposure(tmp_path):
    path = own.project(tmp_path, capture={"exposure": "estimate", "dynamic_range": "hdr"})
    gains = np.array([1.0, 2.0, 0.4, 1.2])
    own.photographed(path, 4, depth=False, hdr=True, gains=gains)
    capture = own.run(tmp_path, "capture")
    scale = [np.median(capture.photo(v)[0] / own.pattern(capture.points(v, capture.gbuffer(v)[0]))) for v in capture]
    np.testing.assert_allclose(np.array(scale) / scale[0], 1.0, atol=0.03)


EQUAL, DIFFERENT = (1.0, 1.0, 1.0), (1.0, 0.7, 0.6)


@pytest.mark.parametrize(("gains", "setting"), [(EQUAL, "auto"), (DIFFERENT, "auto"), (DIFFERENT, "given")])
def test_exposures_are_looked_for_only_where_nothing_states_them_and_photographs_differ(tmp_path, gains, setting):
    path = own.project(tmp_path, capture={"exposure": setting} if setting != "auto" else {})
    own.photographed(path, 3, depth=False, gains=gains)
    capture = own.run(tmp_path, "capture")
    estimated = gains == DIFFERENT and setting == "auto"
    assert capture.facts["exposure_estimated"] == estimated
    found = np.array([view.exposure for view in capture.views])
    # Of sensor values f(x), about x^0.45.
    np.testing.assert_allclose(found / found[0], np.array(gains if estimated else EQUAL) ** (1 / 0.449), rtol=0.05)
    assert any("exposure: estimate" in note for note in capture.facts["notes"]) == (setting == "given")
    if estimated:
        (path / "exposures.json").write_text(json.dumps({f"images/{i:03d}.png": 1.0 + i for i in range(3)}))
        capture = own.run(tmp_path, "capture")
        assert [view.exposure for view in capture.views] == [1.0, 2.0, 3.0] and not capture.facts["exposure_estimated"]


# --------------------------------------------------------------------------------------------------------------
# alignment


def fails(root):
    with pytest.raises(InputError) as caught:
        own.run(root, "capture")
    return str(caught.value)


def proposed(message):
    """The settings of the source that a message proposes."""
    return re.findall(r"`source\.(.+?)`", message)


def test_wrong_axes_are_named(tmp_path):
    path = own.project(tmp_path, {"axes": "opencv"})
    own.photographed(path)
    assert proposed(fails(tmp_path)) == ["axes: opengl", "alignment: warn"]
    own.project(tmp_path, {"axes": "opencv", "alignment": "warn"})
    notes = own.run(tmp_path, "capture").facts["notes"]
    assert any(n.startswith("WARNING") and "source.axes: opengl" in n for n in notes)


def test_wrong_scale_is_named(tmp_path):
    path = own.project(tmp_path, {"unit": 3.0})
    own.photographed(path)
    message = fails(tmp_path)
    assert proposed(message) == ["unit: m", "alignment: warn"] and not missing(message, "200.0%", "5%")


def test_inverted_matrices_are_named(tmp_path):
    path = own.project(tmp_path)
    document, _ = own.photographed(path)
    for entry in document["frames"]:
        pose = np.array(entry["transform_matrix"])
        entry["transform_matrix"] = np.linalg.inv(pose).tolist()
    own.write_transforms(path, document)
    named(fails(tmp_path), "transforms.json", "mesh.ply", "world-to-camera", "opengl")


def test_mesh_turned_against_the_poses_is_named(tmp_path):
    path = own.project(tmp_path)
    own.photographed(path)
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(path / "mesh.ply", vertices @ turn_of("x z -y").T, faces)  # as a glTF exporter turns it
    assert proposed(fails(tmp_path)) == ["mesh_up: y", "alignment: warn"]
    own.project(tmp_path, {"mesh_up": "y"})
    np.testing.assert_allclose(own.run(tmp_path, "capture").mesh()[0], vertices, atol=1e-5)
    own.save_mesh(path / "mesh.ply", vertices, faces)
    assert proposed(fails(tmp_path)) == ["mesh_up: as_poses", "alignment: warn"]


def test_any_quarter_turn_of_the_mesh_is_named_and_undone(tmp_path):
    """Phone apps write a mesh with y up; converters of their poses move each axis to the next."""
    path = own.project(tmp_path)
    own.photographed(path)
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(path / "mesh.ply", vertices @ turn_of("y z x").T, faces)
    assert proposed(fails(tmp_path))[0] == "mesh_up: z x y"
    own.project(tmp_path, {"mesh_up": "z x y"})
    np.testing.assert_allclose(own.run(tmp_path, "capture").mesh()[0], vertices, atol=1e-5)
    # A wrong turn: the right one is named, not the one from the wrong to the right.
    own.project(tmp_path, {"mesh_up": "y"})
    assert proposed(fails(tmp_path))[0] == "mesh_up: z x y"


def test_a_convention_that_puts_all_cameras_at_one_point_is_not_proposed(monkeypatch):
    """Whatever is tried seems to fit edges, and the smallest scale best."""
    matrices = [pose @ np.diag([1.0, -1, -1, 1]) for pose in own.poses(4)]
    frames = [SimpleNamespace(matrix=matrix) for matrix in matrices]
    now, size = alignment.Conventions("opengl", 1.0), 5.0
    nearness = []

    def trace(origin, rays):
        nearness.append(1.0 / (1.0 + np.linalg.norm(origin)))
        return np.ones(rays.shape[:2]), np.tile([0.0, 0, 1], (*rays.shape[:2], 1))

    def correlation(seen, mesh):
        return np.full((9, 9), nearness[-1])

    monkeypatch.setattr(alignment, "edge_correlation", correlation)
    trials = [(frame, own.CAMERA, np.full((48, 64, 3), 0.5), np.ones((48, 64), bool)) for frame in frames]
    said = alignment.explain_edges(trials, trace, now, True, 0.01, size)
    assert said and "times" not in said
    assert "times 0.001" in alignment.explain_edges(trials[:1], trace, now, True, 0.01, size)  # of one nothing is known
    assert "times 0.01" in alignment.explain_edges(trials, trace, now, True, 0.01, 0.1)  # a mesh of 10 cm
    assert "mesh_up" in alignment.explain_edges(trials, trace, now, True, 0.01, 1000.0)  # cameras on a wide ground may turn


def test_a_capture_that_leans_in_its_coordinates_stands_upright_in_exports(tmp_path):
    """Photographs, cameras and mesh as before, all turned by 27 degrees about a slanted axis."""
    from workflow.exporters.glb import rotation_to_y

    path = own.project(tmp_path, {"registration": "off"})
    document, _ = own.photographed(path, 4)
    plain = own.run(tmp_path, "capture")
    assert "up" not in plain.facts and not any("leans" in note for note in plain.facts["notes"])
    turn = Rotation.from_rotvec(np.radians(27.0) * np.array([0.8, 0.6, 0.0]))
    moved = np.eye(4)
    moved[:3, :3] = turn.as_matrix()
    for entry in document["frames"]:
        entry["transform_matrix"] = (moved @ np.array(entry["transform_matrix"])).tolist()
    own.write_transforms(path, document)
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(path / "mesh.ply", turn.apply(vertices), faces)
    capture = own.run(tmp_path, "capture")
    np.testing.assert_allclose(capture.up, turn.apply(plain.up), atol=5e-3)
    assert any("leans by 27 degrees" in note for note in capture.facts["notes"])
    np.testing.assert_allclose(Rotation.from_quat(rotation_to_y(capture.up)).apply(capture.up), [0, 1, 0], atol=1e-9)


@pytest.mark.parametrize("mesh_up", ["z x", "x x y", "y x z", "x y w", ""])
def test_what_is_no_turn_of_the_mesh_is_refused(mesh_up):
    with misset("mesh_up", "value_error", "as_poses"):
        FolderSource(kind="folder", path="data/room", mesh_up=mesh_up)


def test_a_finished_scene_fits_itself(tmp_path):
    """cameras.json and scene.glb of a room with z up, as they are delivered."""
    path = own.project(tmp_path, {"cameras": "cameras.json", "mesh": "scene.glb", "mesh_up": "y"}, {"exposure": "estimate"})
    document, shots = own.photographed(path, depth=False)
    (path / "transforms.json").unlink()
    (path / "mesh.ply").unlink()
    up, names = np.array([0.0, 0.0, 1.0]), [frame["file_path"] for frame in document["frames"]]
    sizes = [own.intrinsics()[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")]
    views = [View(i, f"{i:03d}", *sizes, shot[0]) for i, shot in enumerate(shots)]
    (path / "cameras.json").write_bytes(cameras_json(views, names, np.ones((4, 3)), up))
    vertices, faces, _ = own.room_mesh()
    trimesh.Trimesh(Rotation.from_quat(rotation_to_y(up)).apply(vertices), faces, process=False).export(path / "scene.glb")
    assert own.run(tmp_path, "capture").facts["alignment"]["edge_correlation"] > 0.2


@pytest.mark.parametrize(("factor", "by"), [(100.0, "0.01"), (1000.0, "0.001")])
def test_a_mesh_in_another_unit_than_the_poses_is_told_the_factor_that_fits(factor, by):
    """Never one that would make the room smaller than the space in which its photographs were taken."""
    vertices, faces, _ = own.room_mesh()
    centres = np.array([pose[:3, 3] for pose in own.poses(5)])
    with refused("mesh.ply", f"by {by}"):
        mesh.check_size(Path("mesh.ply"), mesh.Mesh(vertices * factor, faces), "m", 1.0, centres)


def test_a_factor_between_mesh_and_poses_is_named():
    room = mesh.Mesh(*own.room_mesh()[:2])
    centres = np.array([pose[:3, 3] for pose in own.poses(5)])
    mesh.check_size(Path("mesh.ply"), room, "m", 1.0, centres)
    with refused("mesh.ply", "5 of 5", "0.01", "transform_matrix"):
        mesh.check_size(Path("mesh.ply"), room, "m", 1.0, 100 * centres)
    with refused("mesh.ply", "5 of 5", "docs/guide/own-data.md") as shifted:
        mesh.check_size(Path("mesh.ply"), room, "m", 1.0, 100 + centres)
    low, high = room.bounds
    around = mesh.Mesh(room.vertices - (low + high) / 2, room.faces)  # any small factor leads into it
    with refused("mesh.ply", "5 of 5", "docs/guide/own-data.md") as centred:
        mesh.check_size(Path("mesh.ply"), around, "m", 1.0, 100 + centres)
    assert all("0.01" in missing(str(caught.value), "0.01") for caught in (shifted, centred))  # no factor is proposed


def test_unrelated_depth_is_refused_without_advice(tmp_path):
    path = own.project(tmp_path)
    _, shots = own.photographed(path)
    rng = np.random.default_rng(0)
    for i in range(len(shots)):
        own.save_depth(path / f"depth/{i:03d}.png", rng.uniform(0.3, 6, (48, 64)))
    assert proposed(fails(tmp_path)) == ["alignment: warn"]


def test_one_bad_pose_is_named(tmp_path):
    path = own.project(tmp_path)
    document, _ = own.photographed(path, 6)
    pose = np.array(document["frames"][4]["transform_matrix"])
    pose[:3, 3] += [0.9, 0.5, 0.3]
    document["frames"][4]["transform_matrix"] = pose.tolist()
    own.write_transforms(path, document)
    notes = own.run(tmp_path, "capture").facts["notes"]
    assert any("view 004 left out: badly posed?" in note for note in notes), notes
    own.project(tmp_path, {"registration": "off"})
    notes = own.run(tmp_path, "capture").facts["notes"]
    assert any("disagree in view(s) 004: is the pose right?" in note for note in notes), notes


def test_agreement_of_a_few_pixels_by_chance_does_not_count():
    assert alignment.disagreement(np.ones(50)) == 0
    assert alignment.disagreement(np.r_[np.ones(5), np.full(45, np.nan)]) == np.inf
    assert alignment.disagreement(np.zeros(0)) == np.inf


def test_depth_of_another_camera(tmp_path):
    """A depth sensor 5 cm to the right of the camera, with other intrinsics, is compared at the points that it sees."""
    from iif_core.camera.distortion import Pinhole

    path = own.project(tmp_path)
    document, shots = own.photographed(path)
    sensor = Pinhole(45.0, 45.0, 26.0, 19.0, 52, 38)
    document["depth_intrinsics"] = {"fl_x": 45.0, "fl_y": 45.0, "cx": 26.0, "cy": 19.0}
    document["depth_unit_m"] = 0.0005
    for i, (pose, *_) in enumerate(shots):
        beside = pose.copy()
        beside[:3, 3] += 0.05 * pose[:3, 0]
        own.save_depth(path / f"depth/{i:03d}.png", own.shoot(own.geometry(), beside, sensor)[1], 0.0005)
        document["frames"][i]["depth_c2w_opencv"] = beside.tolist()
    own.write_transforms(path, document)
    assert own.run(tmp_path, "capture").facts["alignment"]["depth_median_disagreement"] < 0.01
    document["depth_unit_m"] = 0.001
    own.write_transforms(path, document)
    assert proposed(fails(tmp_path)) == ["unit: 1.998", "alignment: warn"]


def test_edges_find_a_shift():
    rng = np.random.default_rng(1)
    blocks = np.kron(rng.random((8, 10)), np.ones((12, 14)))
    depth = (1 + blocks).astype(np.float32)
    normal = np.broadcast_to(np.array([0, 0, 1.0]), (*depth.shape, 3))
    photo = np.repeat(blocks[..., None], 3, -1).astype(np.float32)
    valid = np.ones(depth.shape, bool)

    def correlation(photo, rows=slice(None)):
        return alignment.edge_correlation(*alignment.edge_pictures(photo[rows], valid[rows], depth[rows], normal[rows]))

    here = correlation(photo)
    assert np.unravel_index(here.argmax(), here.shape) in {(4, 4), (5, 4), (4, 5), (5, 5)} and here.max() > 0.5
    moved = correlation(np.roll(photo, (3, -2), (0, 1)))
    dy, dx = np.array(np.unravel_index(moved.argmax(), moved.shape)) - np.unravel_index(here.argmax(), here.shape)
    assert (dy, dx) == (3, -2)
    assert (correlation(photo, slice(4)) == 0).all()  # too small


@pytest.mark.parametrize("order, warned", [([0, 1, 2, 3, 4], False), ([1, 2, 3, 4, 0], True)])
def test_photographs_with_the_poses_of_others_are_doubted(order, warned):
    """Rooms of blocks: every photograph has edges where its own depth has them."""
    rng = np.random.default_rng(3)
    blocks = [np.kron(rng.random((n + 3, n + 4)), np.ones((120 // (n + 3), 160 // (n + 4)))) for n in order]
    alike = np.kron(rng.random((2, 2)), np.ones((50, 70)))  # what all rooms have in common
    blocks = [block[:100, :140] + alike for block in blocks]
    normal, valid = np.broadcast_to(np.array([0, 0, 1.0]), (*blocks[0].shape, 3)), np.ones(blocks[0].shape, bool)
    found = alignment.Alignment.empty()
    for i, j in enumerate(order):
        photo = np.repeat(blocks[j][..., None], 3, -1).astype(np.float32)
        found.add_edges(str(i), *alignment.edge_pictures(photo, valid, (1 + blocks[i]).astype(np.float32), normal), True)
    assert (found.edge_warning(0.05) != "") == warned
    # Measured depth that agrees with the mesh says nothing for the photographs.
    found.ratios["0"] = np.ones(1000)
    assert found.depth_disagreement == 0.0 and (found.edge_warning(0.05) != "") == warned
    assert (found.report()["edge_own_pose_standard_errors"] < alignment.CLEARLY_OWN) == warned


def test_stage_reads_back(scene):
    root, _, _ = scene
    reader = StageReader(root / "results/own/capture", "capture", "own")
    assert set(reader.names("photos/")) == {f"photos/{i:03d}.exr" for i in range(4)}


@pytest.mark.long
@pytest.mark.needs_scene
def test_red_kitchen_passes_the_door(tmp_path, test_scene):
    """A real capture: photographs, poses and mesh agree with its depth images and not with a shifted picture."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data/own").symlink_to(test_scene("redkitchen"))
    own.project(tmp_path, capture={"views": 8, "width": 160, "height": 160, "exposure": "estimate"})
    facts = own.run(tmp_path, "capture").facts["alignment"]
    assert facts["depth_median_disagreement"] < 0.01
    assert max(facts["depth_disagreement_of_views"].values()) < 0.03
    assert facts["edge_correlation"] > 0.2
    own.project(tmp_path, {"axes": "opencv"}, {"views": 4, "width": 160, "height": 160})
    assert proposed(fails(tmp_path))[0] == "axes: opengl"


def test_the_ground_around_a_house_does_not_tell_its_size():
    rng = np.random.default_rng(0)
    house = rng.uniform(0, 5, (1000, 3))
    ground = np.array([[-110.0, -110, 0], [110, -110, 0], [110, 110, 0], [-110, 110, 0]])
    every = np.concatenate([house, ground])
    mesh.check_across(Path("scene.xml"), every, "m", 1.0)
    with refused("scene.xml", "cm"):
        mesh.check_across(Path("scene.xml"), 100 * every, "m", 1.0)
    with refused("scene.xml"):
        mesh.check_across(Path("scene.xml"), 0.001 * house, "m", 1.0)
