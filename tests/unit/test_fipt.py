"""Source `fipt`: both layouts, made from a room whose cameras, materials and colours are known."""

import json
import shutil

import numpy as np
import pytest

from iif_core.errors import InputError
from tests.errors import named
from tests.unit import own_scene as own
from workflow import settings
from workflow.sources import fipt

W, H, ANGLE = 64, 48, 1.2
FOCAL = 0.5 * W / np.tan(0.5 * ANGLE)
CAMERA = own.Pinhole(FOCAL, FOCAL, W / 2, H / 2, W, H)
EXPOSURES = {"train": [0.5, 1.0, 2.0], "val": [4.0, 0.25]}


def obj(path, vertices, faces):
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def colour_exr(path, picture):
    own.save_exr(path, {c: np.ascontiguousarray(picture[..., i], np.float32) for i, c in enumerate("RGB")})


def crf():
    """(3, 1024) curves that differ a channel."""
    return np.stack([np.linspace(0, 1, 1024) ** gamma for gamma in (0.4, 0.5, 0.6)])


def synthetic(home):
    """train/ and val/ as IIF lays them out: x left, y up, z forward."""
    vertices, faces, _ = own.room_mesh()
    obj(home / "scene.obj", vertices, faces)
    geometry, every = own.geometry(), own.poses(5)
    shots = {"train": every[:3], "val": every[3:]}
    for split, poses in shots.items():
        here, frames, listed = home / split, [], []
        for i, pose in enumerate(poses):
            picture, _, face = own.shoot(geometry, pose, CAMERA)
            columns = [-pose[:, 0], -pose[:, 1], pose[:, 2], pose[:, 3]]  # left, up, forward, place
            frames.append({"transform_matrix": np.stack(columns, 1).tolist()})
            name = f"{i:03d}_0001"
            colour_exr(here / f"Image/{name}.exr", picture)
            exposed = np.clip(EXPOSURES[split][i] * picture, 0, 1)
            encoded = np.stack([exposed[..., c] ** g for c, g in enumerate((0.4, 0.5, 0.6))], -1)
            own.save_png(here / f"Image/{name}.png", encoded)
            colour_exr(here / f"BaseCol/{name}.exr", picture * 0.5)
            ones = np.ones((H, W, 3), np.float32)
            colour_exr(here / f"Roughness/{name}.exr", ones * 0.3)
            colour_exr(here / f"Metallic/{name}.exr", ones * 0.1)
            colour_exr(here / f"Emit/{name}.exr", ones * 0)
            index = (face // 12 + 4).astype(np.float32)
            index[0, 0], index[0, 1] = 4.5, 9.0  # anti-aliased: between integers, and an integer that no object has
            colour_exr(here / f"IndexMA/{name}.exr", np.repeat(index[..., None], 3, -1))
            listed.append("4,5")
        (here / "IndexMA/object_ids.txt").write_text("\n".join(listed) + "\n")
        (here / "transforms.json").write_text(json.dumps({"camera_angle_x": ANGLE, "frames": frames}))
        (here / "Image/cam").mkdir()
        np.save(here / "Image/cam/exposure.npy", np.array(EXPOSURES[split]))
        np.save(here / "Image/cam/crf.npy", crf())
    return shots


def real(home):
    """cam.txt, K_list.txt, pictures of a camera whose K differs a view, semantic ids."""
    vertices, faces, _ = own.room_mesh()
    obj(home / "scene.obj", vertices, faces)
    geometry, poses = own.geometry(), own.poses(3)
    cameras, lenses, shots = [str(len(poses))], [str(len(poses))], []
    for i, pose in enumerate(poses):
        camera = own.Pinhole(60.0 + i, 62.0 + i, 33.0, 23.5, W, H)
        picture, _, face = own.shoot(geometry, pose, camera)
        origin, ahead, up = pose[:3, 3], pose[:3, 2], -pose[:3, 1]
        cameras += [" ".join(repr(float(v)) for v in row) for row in (origin, origin + 2.5 * ahead, up)]
        lenses += [f"{camera.fx} 0.0 {camera.cx}", f"0.0 {camera.fy} {camera.cy}", "0.0 0.0 1.0"]
        colour_exr(home / f"Image/{i:03d}_0001.exr", picture)
        own.save_png(home / f"Image/{i:03d}_0001.png", picture)
        colour_exr(home / f"segmentation/{i:03d}.exr", np.repeat((face // 12).astype(np.float32)[..., None], 3, -1))
        shots.append((pose, camera))
    (home / "cam.txt").write_text("\n".join(cameras) + "\n")
    (home / "K_list.txt").write_text("\n".join(lenses) + "\n")
    return shots


def document(home, dynamic_range="hdr", capture=None, **source):
    tree = {
        "source": {"kind": "fipt", "path": str(home), **source},
        "capture": {"dynamic_range": dynamic_range, "width": W, "height": H, **(capture or {})},
        "prior": {"kind": "retinex"},
    }
    return settings.dump(settings.SceneSettings.model_validate(tree))


def refused(home, dynamic_range="hdr", **source):
    with pytest.raises(InputError) as caught:
        fipt.raw_inputs(document(home, dynamic_range, **source))
    return str(caught.value)


def captured(root, home, dynamic_range, **source):
    own.project(root, {"kind": "fipt", "path": str(home), **source}, {"dynamic_range": dynamic_range})
    return own.run(root, "capture")


def test_synthetic_radiance_truth_ids_and_splits(tmp_path):
    shots = synthetic(tmp_path / "kitchen")
    capture = captured(tmp_path, tmp_path / "kitchen", "hdr")
    assert [(v.name, v.split) for v in capture] == [
        ("000_0001", "train"),
        ("001_0001", "train"),
        ("002_0001", "train"),
        ("val_000_0001", "test"),
        ("val_001_0001", "test"),
    ]
    assert capture.is_hdr and capture.has_truth and capture.facts["source"] == "fipt"
    for view, pose in zip(capture, [*shots["train"], *shots["val"]], strict=True):
        np.testing.assert_allclose(view.world_from_camera, pose, atol=1e-9)
        assert (view.fx, view.fy, view.cx, view.cy) == pytest.approx((FOCAL, FOCAL, 32, 24))
        photo, valid = capture.photo(view, held_out=True)
        depth, face = capture.gbuffer(view)
        assert valid.all() and view.exposure == 1
        np.testing.assert_allclose(own.pattern(capture.points(view, depth)), photo, atol=1e-3)
        truth = capture.truth(view)
        np.testing.assert_allclose(truth.albedo, photo * 0.5, atol=1e-6)
        np.testing.assert_allclose(truth.radiance, photo, atol=1e-6)
        assert np.ptp(truth.roughness) == 0 and truth.roughness[0, 0] == np.float32(0.3) and truth.emission.max() == 0
        ids = capture.given_instances(view)
        assert ids[0, 0] == ids[0, 1] == -1
        np.testing.assert_array_equal(ids.ravel()[2:], (face // 12 + 4).ravel()[2:])


def test_synthetic_photographs_exposures_and_response(tmp_path):
    synthetic(tmp_path / "kitchen")
    capture = captured(tmp_path, tmp_path / "kitchen", "ldr")
    assert [v.exposure for v in capture] == [*EXPOSURES["train"], *EXPOSURES["val"]]
    curve = np.array(capture.facts["response_truth"])
    np.testing.assert_allclose(curve, np.linspace(0, 1, 101) ** np.array([[0.4], [0.5], [0.6]]), atol=2e-3)
    for view in capture:
        photo, _ = capture.photo(view, held_out=True)
        radiance = capture.truth(view).radiance  # of the EXR next to the photograph
        np.testing.assert_allclose(own.pattern(capture.points(view, capture.gbuffer(view)[0])), radiance, atol=1e-3)
        exposed = np.clip(view.exposure * radiance, 0, 1)
        np.testing.assert_allclose(photo, exposed ** np.array([0.4, 0.5, 0.6]), atol=0.5 / 255 + 1e-3)


def test_fewer_views_keep_their_own_exposures(tmp_path):
    synthetic(tmp_path)
    found = fipt.find_inputs(*(document(tmp_path, "ldr", {"views": 3})[key] for key in ("source", "capture")))
    names = [f.name for f in found.cameras.frames]
    assert names == ["000_0001", "002_0001", "val_001_0001"] and [frame.exposure for frame in found.cameras.frames] == [
        0.5,
        2.0,
        0.25,
    ]


def test_real(tmp_path):
    shots = real(tmp_path / "room")
    capture = captured(tmp_path, tmp_path / "room", "hdr")
    assert not capture.has_truth
    for view, (pose, camera) in zip(capture, shots, strict=True):
        np.testing.assert_allclose(view.world_from_camera, pose, atol=1e-6)
        assert (view.fx, view.fy, view.cx, view.cy) == (camera.fx, camera.fy, camera.cx, camera.cy)
        photo, _ = capture.photo(view, held_out=True)
        depth, face = capture.gbuffer(view)
        np.testing.assert_allclose(own.pattern(capture.points(view, depth)), photo, atol=1e-3)
        np.testing.assert_array_equal(capture.given_instances(view), face // 12)
    shutil.rmtree(tmp_path / "room/segmentation")
    encoded = captured(tmp_path / "ldr", tmp_path / "room", "ldr")
    assert not encoded.is_hdr and all(view.exposure == 1 for view in encoded)
    assert any("exposures are 1" in note for note in encoded.facts["notes"])
    assert encoded.given_instances(encoded.views[0]) is None


def test_truth_is_all_or_none(tmp_path):
    synthetic(tmp_path)
    (tmp_path / "val/Metallic/001_0001.exr").unlink()
    named(refused(tmp_path), "val/Metallic/001_0001.exr", 1)
    (tmp_path / "val/BaseCol").rename(tmp_path / "val/DiffCol")
    found = fipt.find_inputs(*(document(tmp_path)[key] for key in ("source", "capture")))
    assert not any(frame.truth for frame in found.cameras.frames) and any(
        "no ground truth: BaseCol missing" in note for note in found.cameras.notes
    )


def test_synthetic_refusals(tmp_path):
    synthetic(tmp_path)
    np.save(tmp_path / "train/Image/cam/exposure.npy", np.array([1.0, 0.0, 1.0]))
    named(refused(tmp_path, "ldr"), "cam/exposure.npy", 3, 0)
    np.save(tmp_path / "train/Image/cam/exposure.npy", np.ones(3))
    np.save(tmp_path / "train/Image/cam/crf.npy", np.ones((1024, 3)))
    named(refused(tmp_path, "ldr"), "cam/crf.npy", "(1024, 3)", "(3, n)")
    (tmp_path / "train/Image/cam/crf.npy").write_bytes(b"nothing")
    named(refused(tmp_path, "ldr"), "cam/crf.npy", "np.save")
    (tmp_path / "train/IndexMA/001_0001.exr").unlink()
    named(refused(tmp_path), "IndexMA/001_0001.exr", 1, "remove the folders")
    path = tmp_path / "train/transforms.json"
    stated = json.loads(path.read_text())
    path.write_text(json.dumps({"frames": stated["frames"]}))
    named(refused(tmp_path), "train/transforms.json", "camera_angle_x")
    path.write_text(json.dumps(stated | {"frames": [{}, *stated["frames"][1:]]}))
    named(refused(tmp_path), "train/transforms.json", "camera 0", "train/Image/000_0001.exr", "transform_matrix")
    (tmp_path / "train/Image/000_0001.exr").unlink()
    named(refused(tmp_path), "train/transforms.json", 1, tmp_path / "train/Image/000_0001.exr")
    path.unlink()
    named(refused(tmp_path), "train/transforms.json", "cam.txt", "K_list.txt", "source.path")


@pytest.mark.parametrize(
    ("name", "change", "names"),
    [
        ("cam.txt", lambda t: t.replace("3\n", "4\n", 1), [27, 4, 9]),
        ("cam.txt", lambda t: "three\n" + t, ["'three'"]),
        ("K_list.txt", lambda t: "1\n60 0 33\n0 62 23\n0 0 1\n", [1, "cam.txt", 3]),
        (
            "K_list.txt",
            lambda t: t.replace("60.0 0.0 33.0", "60.0 5.0 33.0"),
            ["camera 0", "60.0, 5.0, 33.0"],
        ),
        ("K_list.txt", None, ["cam.txt", "FIPT"]),
    ],
)
def test_real_refusals(tmp_path, name, change, names):
    real(tmp_path)
    if change is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_text(change((tmp_path / name).read_text()))
    named(refused(tmp_path), tmp_path / name, *names)


def test_up_that_is_not_square_is_refused(tmp_path):
    real(tmp_path)
    lines = (tmp_path / "cam.txt").read_text().splitlines()
    lines[2], lines[3] = lines[3], lines[2]  # up and look-at exchanged
    (tmp_path / "cam.txt").write_text("\n".join(lines))
    named(refused(tmp_path), "cam.txt", "camera 0", "-0.9776", "0.002")
