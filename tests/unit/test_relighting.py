"""Relighting: camera paths, the inserted lamp, and the stage against the renderer and the superposition of light."""

import json

import numpy as np
import pytest

from iif_core.camera.pinhole import look_at
from iif_core.light.environment import resample
from iif_core.light.relighting import axes_of_map, camera_path, ease, exposure_for, frame_times, sphere_mesh
from tests.errors import refused
from tests.unit.test_report import made, make_scene, scene_of
from workflow.artifacts.files import read_exr, write_exr
from workflow.artifacts.store import rgb, split_rgb
from workflow.exporters.camera_files import environment_picture
from workflow.relighting.world import read_environment
from workflow.settings.relight import Relighting, lamp_bases
from workflow.stages import lamp_images, relight


def test_ease_starts_and_stops_gently():
    t = np.linspace(0, 1, 1001)
    value = ease(t)
    assert value[[0, 500, 1000]].tolist() == [0, 0.5, 1] and (np.diff(value) > 0).all()
    assert value[1] < 1e-5 and 1 - value[-2] < 1e-5
    np.testing.assert_allclose(value + value[::-1], 1, atol=1e-12)
    assert frame_times(1).tolist() == [0] and frame_times(3).tolist() == [0, 0.5, 1]


def test_camera_path_meets_its_keys_on_the_shortest_arc():
    poses = np.stack([look_at((x, 0.2 * x * x, 1), (x + np.cos(x), np.sin(x), 1), (0, 0, 1)) for x in (0.0, 0.7, 2.0)])
    path = camera_path(poses, np.linspace(0, 1, 5))
    np.testing.assert_allclose(path[[0, 2, 4]], poses, atol=1e-12)
    turn = path[:, :3, :3]
    np.testing.assert_allclose(turn @ turn.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-12)
    first = np.arccos((np.trace(turn[0].T @ turn[1]) - 1) / 2)
    assert first == pytest.approx(np.arccos((np.trace(turn[1].T @ turn[2]) - 1) / 2))  # half-way is half the angle
    line = np.tile(np.eye(4), (3, 1, 1))
    line[:, 0, 3] = 0, 1, 2
    np.testing.assert_allclose(camera_path(line, [0.25, 0.6])[:, 0, 3], [0.5, 1.2])
    assert (camera_path(poses[:1], [0, 0.5]) == poses[0]).all()
    with refused("camera path", "(0, 4, 4)"):
        camera_path(np.zeros((0, 4, 4)), [0])


@pytest.mark.parametrize("subdivisions", [0, 3])
def test_sphere_is_closed_round_and_of_the_right_area(subdivisions):
    import trimesh

    vertices, faces = sphere_mesh((1, 2, 3), 0.2, subdivisions)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert len(faces) == 20 * 4**subdivisions and mesh.is_watertight and mesh.volume > 0
    assert mesh.area == pytest.approx(4 * np.pi * 0.04, rel=1e-5)
    radius = np.linalg.norm(vertices - np.float32([1, 2, 3]), axis=1)
    assert np.ptp(radius) < 1e-5 and radius.mean() == pytest.approx(0.2, rel=0.15 if subdivisions == 0 else 5e-3)


def test_exposure_and_map_axes():
    picture = np.zeros((10, 10, 3))
    assert exposure_for(picture) == 1
    picture[:] = 4
    picture[0, :2] = 1e6
    assert exposure_for(picture) * 4 == pytest.approx(0.8)
    for up in ((0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -1)):
        axes = axes_of_map(up, 30)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1) and (axes[2] == up).all()
    np.testing.assert_allclose(axes_of_map((0, 0, 1), 90)[0], [0, 1, 0], atol=1e-12)


def test_settings_read_switches():
    assert Relighting(name="a", emitters=False).emitters == 0 and Relighting(name="a", emitters="off").emitters == 0
    assert Relighting(name="a", emitters=True).emitters == 1 and Relighting(name="a", emitters=0.3).emitters == 0.3
    assert Relighting(name="a", environment=False).environment == "off"
    for bad in (
        {"name": "a b"},
        {"name": "a", "emitters": -1},
        {"name": "a", "sphere": {"center": [0, 0]}},
        {"name": "a", "x": 1},
    ):
        with pytest.raises(ValueError):
            Relighting(**bad)


def test_the_environment_of_a_scene_comes_back_as_it_was_found(tmp_path):
    """The file next to a scene has other axes than relightings; where z is up, half a turn lies between them."""
    found = np.random.default_rng(0).random((8, 16, 3), np.float32)
    write_exr(tmp_path / "environment.exr", split_rgb(environment_picture(found)))
    again = read_environment(tmp_path / "environment.exr", np.array([0.0, 0, 1]), 180.0)
    np.testing.assert_allclose(again, found, rtol=1e-5)


def test_environment_files_keep_up_and_turn_clockwise(tmp_path):
    picture = np.zeros((8, 16, 3), np.float32)
    picture[0] = (9, 0, 0)  # top row = up
    picture[4, 4] = (0, 5, 0)  # a quarter to the right of the left edge = a quarter turn clockwise, seen from above
    write_exr(tmp_path / "sky.exr", split_rgb(picture))
    found = read_environment(tmp_path / "sky.exr", np.array([0.0, 0, 1]), 0.0)
    assert (found[0, :, 0] > 8).all() and not found[2:, :, 0].any()
    assert found[4, 11].tolist() == [0, 5, 0]  # our columns run counter-clockwise
    turned = read_environment(tmp_path / "sky.exr", np.array([0.0, 0, 1]), 45.0)
    np.testing.assert_allclose(turned, np.roll(found, 2, 1), atol=1e-5)
    y_up = read_environment(tmp_path / "sky.exr", np.array([0.0, 1, 0]), 0.0)
    np.testing.assert_allclose(y_up, resample(picture[:, ::-1], axes_of_map((0, 1, 0), 0), 8, 16, 2))
    write_exr(tmp_path / "grey.exr", {"Y": picture[..., 0]})
    with refused("grey.exr", "Y", "R, G"):
        read_environment(tmp_path / "grey.exr", np.array([0.0, 0, 1]), 0.0)


BALL = {"center": [1.0, 1.0, 1.4], "radius": 0.15, "radiance": [8.0, 4.0, 2.0]}


@pytest.fixture(scope="module")
def toy(llvm, tmp_path_factory):
    root = tmp_path_factory.mktemp("relit")
    make_scene(root)
    return root


def lit(root, *wanted, run=None):
    """Run both stages on a room; returns the first frames, and the folder of the pictures. `run` collects the jobs."""
    common = {"samples": 256, "max_bounces": 4, "denoise": False}
    entries = [Relighting(**{**common, **entry}).model_dump(mode="json") for entry in wanted]
    for stage, module in (("lamp_images", lamp_images), ("relight", relight)):
        job = made(scene_of(root, relight=entries, lamp_images=lamp_bases(entries)), stage, module)
        if run is not None:
            run.append(job)
    folder = root / "results/toy/relight"
    shown = [facts["name"] for facts in json.loads((folder / "relight.json").read_text())["relightings"]]
    return [rgb(read_exr(folder / f"{name}/frame_0000.exr")) for name in shown], folder


def test_as_found_is_the_truth_and_light_adds_up(toy):
    (found, half, ball, both), folder = lit(
        toy,
        {"name": "found"},
        {"name": "half", "emitters": 0.5},
        {"name": "ball", "emitters": "off", "sphere": BALL},
        {"name": "both", "sphere": BALL},
    )
    truth = read_exr(toy / "results/toy/capture/truth/v0.exr")
    truth = np.stack([truth[f"radiance.{c}"] for c in "RGB"], -1)
    np.testing.assert_allclose(found.mean((0, 1)), truth.mean((0, 1)), rtol=0.02)
    np.testing.assert_allclose(half.mean((0, 1)), 0.5 * found.mean((0, 1)), rtol=0.02)
    # The black ball also hides and absorbs a little of the lamp's light.
    hidden = (ball > 0.999 * np.float32(BALL["radiance"])).all(-1)
    assert hidden.any()
    np.testing.assert_allclose((found + ball)[~hidden].mean(0), both[~hidden].mean(0), rtol=0.05)
    from PIL import Image

    assert Image.open(folder / "found/frame_0000.png").size == (40, 32)
    facts = json.loads((folder / "relight.json").read_text())["relightings"]
    assert [entry["method"] for entry in facts] == ["recombined", "recombined", "path traced", "path traced"]


def test_the_only_lamp_alone_is_the_room_and_without_it_the_room_is_dark(toy):
    (found, alone, without), folder = lit(
        toy, {"name": "found"}, {"name": "alone", "each": "alone"}, {"name": "no", "each": "off"}
    )
    names = sorted(path.name for path in folder.iterdir() if path.is_dir())
    assert names == ["alone_ceiling_light_1", "found", "no_ceiling_light_1"]
    np.testing.assert_allclose(alone, found, rtol=1e-5)
    assert found.any() and not without.any()
    with refused("config/scenes/toy.yaml", "alone_ceiling_light_1"):
        lit(toy, {"name": "alone_ceiling_light_1"}, {"name": "alone", "each": "alone"})


def test_flight_denoised_and_lamp_that_moves(toy):
    camera = {"views": ["v0", "v1"], "frames": 3, "fov": 80, "width": 32, "height": 24}
    ball = {**BALL, "path_to": [2.0, 0.6, 1.4]}
    entry = {"name": "flight", "emitters": 0, "sphere": ball, "camera": camera, "samples": 16, "denoise": True}
    _, folder = lit(toy, entry)
    frames = [rgb(read_exr(folder / f"flight/frame_{i:04d}.exr")) for i in range(3)]
    assert all(frame.shape == (24, 32, 3) and np.isfinite(frame).all() and frame.mean() > 0.01 for frame in frames)
    assert np.abs(frames[0] - frames[2]).mean() > 0.05
    first = {path.name: path.read_bytes() for path in folder.rglob("frame_*")}
    lit(toy, entry)
    assert first == {path.name: path.read_bytes() for path in folder.rglob("frame_*")}


def test_a_closed_room_stays_dark_and_says_so(toy, caplog):
    (image,), folder = lit(toy, {"name": "sky", "emitters": 0, "environment": [1, 1, 1]})
    assert not image.any() and "black" in caplog.text and "no light" in (folder / "relight.json").read_text()


def test_what_is_asked_for_must_be_there(toy):
    with refused("config/scenes/toy.yaml", "snakemake --cores 2 relight/toy/example"):
        lit(toy)
    with refused("relight.camera.views", "a", "v9", "v0, v1"):
        lit(toy, {"name": "a", "camera": {"views": ["v9"]}})


def test_missing_environment_file_is_named():
    from workflow.settings import relight_files

    def entry(**more):
        return Relighting(name="a", **more).model_dump(mode="json")

    assert relight_files([entry(), entry(environment=[1, 2, 3]), entry(environment=0.5)]) == []
    with refused("relight.environment", "a", "'nowhere.exr'", "keep, off"):
        relight_files([entry(environment="nowhere.exr")])
