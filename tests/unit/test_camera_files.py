"""What lies next to the scene for other programs: objects.csv, cameras.json, photographs, response, attributes of EXR files."""

import io
import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from iif_core.camera.pinhole import look_at
from iif_core.fitting.intervals import AlbedoIntervals, MeasuredErrors, RoughnessIntervals
from iif_core.fitting.problem import Kinds
from iif_core.numerics import color
from iif_core.numerics.xp import NUMPY
from tests.errors import named
from tests.oracles.blender import require_bpy
from workflow.artifacts.files import read_exr, sha256_of, write_exr
from workflow.decisions.held import measured
from workflow.exporters import camera_files
from workflow.exporters.object_table import csv_bytes, hex_colour, object_rows, read_csv
from workflow.scene.normal_form import View
from workflow.scene.picture_facts import view_attributes

UP = np.array([0.0, 0.0, 1.0])
VIEWS = [
    View(0, "a", 40, 30, 33.0, 33.0, 23.0, 14.0, look_at([0.2, 0.1, 1.0], [2.0, 1.0, 0.5], UP), 0.5),
    View(1, "b", 40, 30, 33.0, 36.3, 18.0, 16.0, look_at([3.0, 0.4, 1.5], [1.0, 1.5, 1.2], UP), 2.0, "test"),
]
GAINS = np.array([[0.5, 0.5, 0.5], [2.0, 1.8, 1.5]])
POINTS = np.array([[1.5, 0.8, 0.7], [2.0, 1.2, 0.9], [1.2, 1.1, 1.0]])


def projected(view, points):
    """Pixels of points by the pinhole camera, OpenCV axes; the reference of every other form."""
    local = (points - view.world_from_camera[:3, 3]) @ view.world_from_camera[:3, :3]
    return np.stack([view.fx * local[:, 0] / local[:, 2] + view.cx, view.fy * local[:, 1] / local[:, 2] + view.cy], 1)


def read_attributes(path):
    """Header of an EXR."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return dict(file.header())


def document():
    return json.loads(camera_files.cameras_json(VIEWS, ["photos/a.png", "photos/b.png"], GAINS, UP, None, "camera_response.cube"))


@pytest.mark.parametrize("number", [0, 1])
def test_cameras_project_as_nerfstudio_does(number):
    """x right, y up, z backward; u = fl_x x / -z + cx, v = fl_y -y / -z + cy, from the corner of the picture."""
    frame, view = document()["frames"][number], VIEWS[number]
    local = (np.linalg.inv(np.array(frame["transform_matrix"])) @ np.c_[POINTS, np.ones(3)].T)[:3].T
    uv = np.stack(
        [frame["fl_x"] * local[:, 0] / -local[:, 2] + frame["cx"], frame["fl_y"] * -local[:, 1] / -local[:, 2] + frame["cy"]], 1
    )
    np.testing.assert_allclose(uv, projected(view, POINTS), atol=1e-9)
    assert (frame["w"], frame["h"], frame["held_out"]) == (40, 30, number == 1)
    np.testing.assert_allclose(frame["gain"], GAINS[number])


@pytest.mark.parametrize("up", [[0, 0, 1.0], [0, 1.0, 0], [0, -1.0, 0], [1.0, 0, 0]])
def test_world_of_blender_has_z_up(up):
    turn = camera_files.world_to_blender(np.array(up))
    np.testing.assert_allclose(turn[:3, :3] @ up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(4), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)


def test_nerfstudio_is_given_no_points():
    """It reads `ply_file_path` as a cloud of points in PLY, which a glTF file is not."""
    found = document()
    assert "ply_file_path" not in found
    assert found["camera_model"] == "OPENCV" and not any(found[name] for name in ("k1", "k2", "p1", "p2"))


def test_attributes_of_an_exr(tmp_path):
    path, plain = tmp_path / "a.exr", tmp_path / "plain.exr"
    channels = {"R": np.zeros((30, 40), np.float32)}
    for view in VIEWS:
        write_exr(path, channels, view_attributes(view, 1.25))
        found = read_attributes(path)
        points = np.c_[POINTS, np.ones(3)]
        ndc = points @ found["worldToNDC"]  # row vectors
        np.testing.assert_allclose(ndc[:, :2] / ndc[:, 3:] * [40, 30], projected(view, POINTS), atol=1e-4)
        camera = points @ found["worldToCamera"]
        local = (POINTS - view.world_from_camera[:3, 3]) @ view.world_from_camera[:3, :3]
        np.testing.assert_allclose(camera[:, :3], local * [1, -1, 1], atol=1e-6)  # y up
    np.testing.assert_allclose(found["chromaticities"][-2:], [0.3127, 0.3290], atol=1e-6)
    assert found["exposure"] == 1.25 and found["colorInteropID"] == "lin_rec709_scene"
    first = sha256_of(path)
    write_exr(path, channels, view_attributes(VIEWS[-1], 1.25))
    write_exr(plain, channels)
    assert sha256_of(path) == first  # the same bytes again
    assert "exposure" not in read_attributes(plain)
    np.testing.assert_array_equal(read_exr(path)["R"], channels["R"])


def test_photographs_keep_their_values_and_masks():
    photo = np.random.default_rng(0).uniform(0, 1, (4, 5, 3))
    valid = np.ones((4, 5), bool)
    plain = np.asarray(Image.open(io.BytesIO(camera_files.photograph_png(photo, valid))))
    np.testing.assert_array_equal(plain, color.to_uint8(photo))
    valid[1, 2] = False
    masked = np.asarray(Image.open(io.BytesIO(camera_files.photograph_png(photo, valid))))
    assert masked.shape == (4, 5, 4) and masked[1, 2, 3] == 0 and masked[..., 3].sum() == 19 * 255
    assert camera_files.photo_names(VIEWS, False) == ["photos/a.png", "photos/b.png"]
    assert camera_files.photo_names(VIEWS, True) == ["photos/a.exr", "photos/b.exr"]


def curve(x):
    return np.asarray(x) ** np.array([0.4, 0.45, 0.5])


def cube_rows(data):
    lines = data.decode().splitlines()
    return np.array([[float(v) for v in line.split()] for line in lines if line[0].isdigit()])


def test_lookup_table_holds_the_response():
    data = camera_files.response_cube(curve)
    rows = cube_rows(data)
    assert f"LUT_1D_SIZE {len(rows)}" in data.decode() and len(rows) == camera_files.LUT_SIZE
    x = np.linspace(0, 1, len(rows))
    np.testing.assert_allclose(rows, curve(x[:, None]), atol=1e-6)


def test_environment_picture_has_the_usual_columns():
    """Middle column towards +x, a quarter to the left towards +y, top row up."""
    from iif_core.light.environment import texel_of

    radiance = np.arange(4 * 8, dtype=float).reshape(4, 8, 1).repeat(3, -1)
    picture = camera_files.environment_picture(radiance)
    rng = np.random.default_rng(1)
    for direction in rng.normal(size=(50, 3)):
        x, y, z = direction / np.linalg.norm(direction)
        row, column = texel_of(NUMPY, (np.array(x), np.array(y), np.array(z)), 4, 8)
        u = 0.5 - np.arctan2(y, x) / (2 * np.pi)
        v = np.arccos(z) / np.pi
        np.testing.assert_array_equal(picture[int(v * 4), int(u * 8) % 8], radiance[int(row), int(column)])


# ---------------------------------------------------------------------------------------------------------- objects.csv


def rows():
    values = np.array([[0.2, 0.4, 0.6, 0.5, 0.0], [0.4, 0.4, 0.2, 0.7, 0.0], [0.9, 0.9, 0.9, 0.1, 1.0]])
    fit = {
        "object_id": np.array([1, 0]), "std_level": np.array([0.0, 0.1]), "model": np.array(["population", "full"], object),
        "pixels": np.array([0, 78]), "given": np.array(["roughness", ""], object), "kind_seen": np.array([0.0, 1.0]),
        "kind_probability": np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), "kind_brightness": np.zeros((2, 3)),
        "kind_roughness": np.full((2, 3), 0.6), "kind_deviation": np.full((2, 3), 0.1),
        "kind_witnesses": np.zeros((2, 3)),
    }  # fmt: skip
    seen = {"object_id": np.arange(3), "pixels": np.array([70, 8, 0]), "views": np.array([4, 2, 0])}
    return object_rows(["=wall", 'so, "fa"', "lost"], np.array([0, 0, 1]), values, np.full((3, 5), 0.25), fit, 0.05, seen)


def test_objects_are_means_with_intervals():
    table, errors = rows(), MeasuredErrors.from_facts(measured()["errors"], "")
    assert table["base_colour_r"] == [0.3, 0.9, 0.25] and table["roughness"] == [0.6, 0.1, 0.25]  # the last has no cells
    kinds = Kinds(np.eye(1, 3), np.zeros((1, 3)), np.full((1, 3), 0.6), np.full((1, 3), 0.1), np.ones(1), np.zeros((1, 3)))
    low, high = AlbedoIntervals.of([[0.3, 0.4, 0.4]], [0.1], [78], 0.05, kinds, errors).ends(errors.albedo)
    for c, name in enumerate("rgb"):
        assert table[f"base_colour_{name}_low"][0] == pytest.approx(low[0, c], rel=1e-4), name
        assert table[f"base_colour_{name}_high"][0] == pytest.approx(high[0, c], rel=1e-4), name
    low, high = RoughnessIntervals.of([0.6], kinds, errors).ends(errors.roughness)
    assert (table["roughness_low"][0], table["roughness_high"][0]) == pytest.approx((low[0], high[0]), rel=1e-4)
    assert (table["metallic_low"][0], table["metallic_high"][0]) == (0.0, 0.0)  # surely a dielectric
    assert (table["roughness_low"][1], table["roughness_high"][1]) == (0.1, 0.1)  # given by hand
    for name in ("base_colour_r", "metallic"):
        assert table[f"{name}_low"][1:] == [0.0, 0.0] and table[f"{name}_high"][1:] == [1.0, 1.0], name  # not fitted
    assert table["pixels"] == [70, 8, 0] and table["photographs"] == [4, 2, 0] and table["model"] == ["full", "population", ""]
    assert table["base_colour_hex"][2] == "#898989" == hex_colour(np.full(3, 0.25))


def test_without_errors_nothing_is_claimed():
    """A fit that states no errors, such as those that are compared with."""
    fit = {"object_id": np.array([0]), "pixels": np.array([9]), "model": np.array(["mean"], object)}
    table = object_rows(
        ["a"], np.zeros(1, int), np.full((1, 5), 0.5), np.full((1, 5), 0.5), fit, np.nan, {"object_id": np.zeros(1, int)}
    )
    for name in ("base_colour_r", "roughness", "metallic"):
        assert (table[f"{name}_low"], table[f"{name}_high"]) == ([0.0], [1.0]), name


def test_csv_is_read_back_and_holds_no_formula():
    found = read_csv(csv_bytes(rows()))
    assert [row["name"] for row in found] == ["'=wall", 'so, "fa"', "lost"]
    assert found[2]["area_m2"] == "" and float(found[0]["base_colour_g"]) == 0.4


# -------------------------------------------------------------------------------------------------------------- Blender

CHECK = """
import json, os, sys
sys.path.insert(0, sys.argv[1])
import bpy, blender_import
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector
cameras = blender_import.load(sys.argv[1])
document = json.load(open(sys.argv[1] + "/cameras.json"))
turn = Matrix(document["blender"]["world_to_blender"])
scene, out = bpy.context.scene, {"views": []}
for number, camera in enumerate(cameras, 1):
    scene.frame_set(number)
    bpy.context.view_layer.update()
    points = [world_to_camera_view(scene, camera, turn @ Vector(p)) for p in json.loads(sys.argv[2])]
    size = scene.render.resolution_x, scene.render.resolution_y
    mapping = scene.view_settings.curve_mapping
    shown = [[mapping.evaluate(mapping.curves[c], x) for x in (0.0, 0.1, 0.5, 0.9)] for c in range(3)]
    out["views"].append({"uv": [[p.x * size[0], (1 - p.y) * size[1]] for p in points], "size": size, "shown": shown,
                         "white": list(mapping.white_level), "camera": scene.camera.name,
                         "backgrounds": [list(b.image.size) for b in camera.data.background_images]})
meshes = [thing for thing in bpy.data.objects if thing.type == "MESH"]
corners = [thing.matrix_world @ vertex.co for thing in meshes for vertex in thing.data.vertices]
out["bounds"] = [[end(c[i] for c in corners) for i in range(3)] for end in (min, max)]
out["cameras"] = sum(thing.type == "CAMERA" for thing in bpy.data.objects)
print("FOUND" + json.dumps(out), flush=True)
os._exit(0)  # Blender's own end may wait for ever in a module
"""


def small_glb():
    """A box of 1 x 2 x 3 m from the origin, in glTF's axes, as scene.glb has it for a world with z up."""
    import trimesh

    box = trimesh.creation.box(bounds=[[0, 0, 0], [1, 2, 3]])
    to_gltf = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    return box.apply_transform(to_gltf).export(file_type="glb")


def test_script_sets_up_blender(tmp_path):
    """Cameras project to the pixels of the pinhole camera, meshes stand where the capture has them, curves hold the response."""
    python = require_bpy()
    (tmp_path / "photos").mkdir()
    for view in VIEWS:
        image = camera_files.photograph_png(np.full((30, 40, 3), 0.5), np.ones((30, 40), bool))
        (tmp_path / f"photos/{view.name}.png").write_bytes(image)
    (tmp_path / "scene.glb").write_bytes(small_glb())
    outside = {"mean_radiance": [0.5, 0.6, 0.7]}
    names = camera_files.photo_names(VIEWS, False)
    data = camera_files.cameras_json(VIEWS, names, GAINS, UP, outside, "camera_response.cube")
    (tmp_path / "cameras.json").write_bytes(data)
    (tmp_path / "camera_response.cube").write_bytes(camera_files.response_cube(curve))
    (tmp_path / "blender_import.py").write_bytes(camera_files.script())
    command = [python, "-c", CHECK, str(tmp_path), json.dumps(POINTS.tolist())]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, env={**os.environ, "PYTHONPATH": ""})
    assert "FOUND" in result.stdout, result.stderr[-3000:]
    found = json.loads(result.stdout.partition("FOUND")[2].splitlines()[0])
    assert found["cameras"] == 2
    np.testing.assert_allclose(found["bounds"], [[0, 0, 0], [1, 2, 3]], atol=1e-5)
    for view, gain, one in zip(VIEWS, GAINS, found["views"], strict=True):
        assert one["camera"] == f"photo {view.name}" and one["size"] == [40, 30] and one["backgrounds"] == [[40, 30]]
        np.testing.assert_allclose(one["uv"], projected(view, POINTS), atol=0.01)
        np.testing.assert_allclose(1 / np.array(one["white"]), gain, rtol=1e-5)
        x = np.array([0.0, 0.1, 0.5, 0.9])
        shown = color.srgb_from_linear(np.array(one["shown"]).T)  # as the standard view encodes it
        np.testing.assert_allclose(shown, curve(x[:, None]), atol=0.01)


def test_script_says_that_it_needs_blender(tmp_path):
    if find_spec("bpy"):
        pytest.skip("bpy is installed here")
    path = tmp_path / "blender_import.py"
    path.write_bytes(camera_files.script())
    result = subprocess.run([sys.executable, str(path)], capture_output=True, text=True)
    assert result.returncode == 1 and len(result.stderr.strip().splitlines()) == 1
    named(result.stderr, "blender --python blender_import.py")
    source = Path(camera_files.blender_import.__file__).read_text()
    assert "workflow" not in source and "iif_core" not in source
