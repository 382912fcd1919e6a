"""Exporters: other programs read the same geometry, colours and light, on a room of known colours."""

import json
import os
import shutil
import struct
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from iif_core.camera.pinhole import direction_derivatives, look_at, pixel_directions
from iif_core.errors import InputError
from iif_core.surface.triangles import subdivide, vertex_normals
from workflow.exporters.glb import glb_bytes, rotation_to_y
from workflow.exporters.mitsuba_scene import mitsuba_files, slivers
from workflow.exporters.surface import RecoveredScene, build_parts, seen_sides, up_axis
from workflow.runtime import native
from workflow.scene.normal_form import View

BOX = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float32)
OUTWARD = np.array(
    [
        [0, 2, 1],
        [1, 2, 3],
        [4, 5, 6],
        [5, 7, 6],
        [0, 1, 4],
        [1, 5, 4],
        [2, 6, 3],
        [3, 6, 7],
        [0, 4, 2],
        [2, 4, 6],
        [1, 3, 5],
        [3, 7, 5],
    ],
    np.int32,
)
EYE = np.array([1.5, 1.0, 1.2])


def room(lamp=(9.0, 6.0, 3.0), environment=(0, 0, 0), lamp_side=1):
    """A 3 x 2 x 2.5 m room (normals outwards), a white box in it and a lamp below the ceiling that shines down."""
    walls = BOX * [3, 2, 2.5]
    box = BOX * 0.5 + [2.0, 1.2, 0.0]
    lamp_quad = np.array([[1.2, 0.8, 2.4], [1.8, 0.8, 2.4], [1.8, 1.4, 2.4], [1.2, 1.4, 2.4]], np.float32)
    vertices = np.concatenate([walls, box, lamp_quad]).astype(np.float32)
    quad = np.array([[0, 2, 1], [0, 3, 2]]) + 16  # right-hand normal points down
    faces = np.concatenate([OUTWARD, OUTWARD + 8, quad]).astype(np.int32)
    object_id = np.repeat([0, 1, 2], [12, 12, 2]).astype(np.int32)
    floor = np.stack(np.meshgrid(np.arange(0.05, 3, 0.1), np.arange(0.05, 2, 0.1), [0.0]), -1).reshape(-1, 3)
    red = (floor[:, 0] < 1.5)[:, None]
    values = np.where(red, [0.6, 0.1, 0.1, 0.8, 0.0], [0.1, 0.1, 0.6, 0.4, 0.0])
    emitter = np.where(object_id == 2, 0, -1).astype(np.int32)
    front, back = np.zeros(26, np.int64), np.zeros(26, np.int64)
    back[:12] = 100
    front[12:24] = 50
    return RecoveredScene(
        vertices,
        faces,
        object_id,
        ["walls", "white <box>", "lamp"],
        floor.astype(np.float32),
        np.zeros(len(floor), np.int32),
        values.astype(np.float32),
        np.array([[0.5, 0.5, 0.5, 0.9, 0], [0.8, 0.8, 0.8, 0.3, 0], [0, 0, 0, 1, 0]], np.float32),
        emitter,
        np.where(emitter >= 0, lamp_side, 0),
        np.array([lamp], np.float32),
        np.array(environment, np.float32),
        front,
        back,
        np.array([0.0, 0.0, 1.0]),
    )


def parts_of(scene, longest=0.2, max_faces=20000):
    return {part.name: part for part in build_parts(scene, longest, max_faces)}


# ------------------------------------------------------------------------------------------------------------- surface


def test_subdivision_keeps_the_surface_closed():
    vertices, faces, parent = subdivide(BOX * [3, 2, 2.5], OUTWARD, 0.4, 10**6)
    corner = vertices[faces]
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    assert length.max() <= 0.4 + 1e-9
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()  # watertight: no T-junctions
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    assert area.sum() == pytest.approx(2 * (6 + 7.5 + 5))
    original = (BOX * [3, 2, 2.5])[OUTWARD]
    direction = np.cross(original[:, 1] - original[:, 0], original[:, 2] - original[:, 0])
    assert (np.einsum("ij,ij->i", normal, direction[parent]) > 0).all()
    np.testing.assert_allclose(np.bincount(parent, area), np.linalg.norm(direction, axis=1) / 2)


def test_subdivision_respects_the_budget():
    _, faces, _ = subdivide(BOX * [3, 2, 2.5], OUTWARD, 1e-3, 500)
    assert 125 < len(faces) <= 500
    _, faces, _ = subdivide(BOX, OUTWARD, 0.1, 5)
    assert len(faces) == 12


def test_faces_look_at_their_observers():
    parts = parts_of(room())
    walls, box, lamp = parts["walls"], parts["white <box>"], parts["lamp.emitter0"]
    centre = np.array([1.5, 1, 1.25])
    assert (np.einsum("ij,ij->i", walls.normals, centre - walls.vertices) > 0).all()
    middle = box.vertices.mean(0)
    assert (np.einsum("ij,ij->i", box.normals, box.vertices - middle) > 0).all()
    np.testing.assert_allclose(lamp.normals, np.tile([0, 0, -1.0], (len(lamp.normals), 1)), atol=1e-6)
    assert not walls.double_sided and not box.double_sided and not lamp.double_sided
    turned = parts_of(room(lamp_side=-1))["lamp.emitter0"]
    np.testing.assert_allclose(turned.normals[:, 2], 1, atol=1e-6)
    assert parts_of(room(lamp_side=0))["lamp.emitter0"].double_sided


def test_unseen_and_sheet_are_double_sided():
    scene = room()
    nobody = parts_of(replace(scene, seen_front=scene.seen_front * 0, seen_back=scene.seen_back * 0))
    assert nobody["walls"].double_sided and nobody["white <box>"].double_sided
    sheet = parts_of(replace(scene, seen_front=scene.seen_back + scene.seen_front))
    assert sheet["walls"].double_sided and not sheet["white <box>"].double_sided


def test_sharp_edges_have_two_normals_and_smooth_ones_one():
    box = parts_of(room())["white <box>"]
    largest = np.abs(box.normals).max(1)
    np.testing.assert_allclose(largest, 1, atol=1e-6)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    tube = np.concatenate([ring, ring + [0, 0, 1]])
    i, j = np.arange(24), (np.arange(24) + 1) % 24
    faces = np.concatenate([np.stack([i, j, i + 24], 1), np.stack([j, j + 24, i + 24], 1)])
    normals = vertex_normals(tube, faces)
    np.testing.assert_allclose(normals, np.concatenate([ring, ring]), atol=1e-9)
    np.testing.assert_array_equal(vertex_normals(np.zeros((3, 3)), np.array([[0, 1, 2]])), np.tile([0, 0, 1.0], (3, 1)))


def test_vertices_take_the_colour_of_their_cells():
    walls = parts_of(room(), 0.1)["walls"]
    floor = (walls.vertices[:, 2] < 1e-6) & (walls.normals[:, 2] > 0.9)
    left, right = floor & (walls.vertices[:, 0] < 1.3), floor & (walls.vertices[:, 0] > 1.7)
    np.testing.assert_allclose(walls.albedo[left], np.tile([0.6, 0.1, 0.1], (left.sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(walls.albedo[right], np.tile([0.1, 0.1, 0.6], (right.sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(walls.roughness[left], 0.8)
    ceiling = walls.vertices[:, 2] > 2.4  # no cells near: the mean of the object
    np.testing.assert_allclose(walls.albedo[ceiling], 0.5)


def test_seen_sides_and_up():
    scene = room()
    front, back = seen_sides(scene.vertices, scene.faces, np.array([[0, 0, 12], [-1, 24, 24]]), EYE)
    assert back[0] == 2 and front[0] == 0 and front[24] == 2 and front.sum() + back.sum() == 5
    poses = np.stack([look_at([0, 0, 1], [1, 0.2 * i, 0.8], [0, 0, 1]) for i in range(4)])
    np.testing.assert_array_equal(up_axis(poses), [0, 0, 1])
    poses = np.stack([look_at([0, 0, 1], [1, 0.2 * i, 0.8], [0, 1, 0]) for i in range(4)])
    np.testing.assert_array_equal(up_axis(poses), [0, 1, 0])


def test_mesh_without_surface_is_refused():
    with pytest.raises(InputError, match="none has an area"):
        build_parts(replace(room(), vertices=np.zeros((20, 3), np.float32)), 0.1, 1000)


# ----------------------------------------------------------------------------------------------------------------- glb


def chunks_of(data):
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<II", data, 12)
    assert kind == 0x4E4F534A and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<II", data, 20 + size)
    assert kind == 0x004E4942 and binary_size % 4 == 0
    binary = data[28 + size :]
    assert len(binary) == binary_size
    return document, binary


def accessor_array(document, binary, index):
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    dtype = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[accessor["componentType"]]
    raw = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(raw, dtype).reshape(-1, width)


def structural_errors(data):
    """Check the file for errors that the validator would report."""
    document, binary = chunks_of(data)
    errors = []
    assert document["asset"]["version"] == "2.0" and document["buffers"] == [{"byteLength": len(binary)}]
    for i, view in enumerate(document["bufferViews"]):
        if view["byteOffset"] % 4 or view["byteOffset"] + view["byteLength"] > len(binary):
            errors.append(f"view {i} out of bounds or misaligned")
    for i, accessor in enumerate(document["accessors"]):
        array = accessor_array(document, binary, i)
        if len(array) != accessor["count"] or not len(array):
            errors.append(f"accessor {i}: count")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            errors.append(f"accessor {i}: not finite")
        if "min" in accessor and (array.min(0).tolist(), array.max(0).tolist()) != (accessor["min"], accessor["max"]):
            errors.append(f"accessor {i}: bounds")
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            counts = {document["accessors"][a]["count"] for a in attributes.values()}
            indices = accessor_array(document, binary, primitive["indices"])
            if len(counts) != 1 or indices.max() >= counts.pop() or len(indices) % 3:
                errors.append(f"{mesh['name']}: indices")
            if "min" not in document["accessors"][attributes["POSITION"]]:
                errors.append(f"{mesh['name']}: POSITION has no bounds")
            length = np.linalg.norm(accessor_array(document, binary, attributes["NORMAL"]), axis=1)
            if np.abs(length - 1).max() > 1e-4:
                errors.append(f"{mesh['name']}: normals")
            if not 0 <= primitive["material"] < len(document["materials"]):
                errors.append(f"{mesh['name']}: material")
    for material in document["materials"]:
        surface = material["pbrMetallicRoughness"]
        factors = [surface["metallicFactor"], surface["roughnessFactor"], *material.get("emissiveFactor", [0])]
        if min(factors) < 0 or max(factors) > 1:
            errors.append(f"{material['name']}: factor")
    used = {name for material in document["materials"] for name in material.get("extensions", {})}
    if used != set(document.get("extensionsUsed", [])):
        errors.append("extensionsUsed")
    return errors


@pytest.fixture(scope="module")
def glb():
    return glb_bytes(list(parts_of(room()).values()), np.array([0.0, 0, 1]), {"scene": "test"})


def test_glb_structure(glb):
    assert structural_errors(glb) == []
    document, binary = chunks_of(glb)
    assert [node["name"] for node in document["nodes"]] == ["walls", "white <box>", "lamp.emitter0", "world"]
    lamp = document["materials"][2]
    assert lamp["emissiveFactor"] == pytest.approx([1, 6 / 9, 3 / 9], abs=1e-5)
    assert lamp["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"] == 9.0
    assert document["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] == 0.0
    assert document["asset"]["extras"] == {"scene": "test"}


def test_structural_check_can_fail(glb):
    document, binary = chunks_of(glb)
    view = document["bufferViews"][document["accessors"][1]["bufferView"]]
    broken = bytearray(glb)
    start = len(glb) - len(binary) + view["byteOffset"]
    broken[start : start + 12] = struct.pack("<3f", 0, 0, 0)
    assert structural_errors(bytes(broken)) == ["walls: normals"]


def test_glb_is_the_same_every_time(glb):
    assert glb == glb_bytes(list(parts_of(room()).values()), np.array([0.0, 0, 1]), {"scene": "test"})


def test_glb_comes_back(glb, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "scene.glb").write_bytes(glb)
    loaded = trimesh.load(tmp_path / "scene.glb", process=False)
    parts = parts_of(room())
    assert set(loaded.geometry) == set(parts)
    np.testing.assert_allclose(loaded.extents, [3, 2.5, 2], atol=1e-5)  # z up became y up
    walls = loaded.geometry["walls"]
    np.testing.assert_allclose(walls.vertices, parts["walls"].vertices, atol=1e-6)
    np.testing.assert_array_equal(walls.faces, parts["walls"].faces)


def test_dark_albedo_survives(glb):
    document, binary = chunks_of(glb)
    scene = room()
    dark = replace(scene, cell_values=scene.cell_values * [0.05, 0.05, 0.05, 1, 1])
    parts = list(parts_of(dark).values())
    document, binary = chunks_of(glb_bytes(parts, np.array([0.0, 0, 1]), {}))
    colour = accessor_array(document, binary, document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"])
    assert np.abs(colour[:, :3] / 65535 - parts[0].albedo).max() < 1e-5


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [0, 0, -1]])
def test_rotation_to_y(up):
    x, y, z, w = rotation_to_y(np.array(up, float))
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(matrix @ up, [0, 1, 0], atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1)


VALIDATOR = Path(os.environ.get("GLTF_VALIDATOR", Path(__file__).resolve().parents[2] / ".node/node_modules/gltf-validator"))
VALIDATE = """
const v = require(process.argv[1]), fs = require('fs');
v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then(r => console.log(JSON.stringify(r.issues)));
"""


def test_khronos_validator(glb, tmp_path):
    if not (shutil.which("node") and VALIDATOR.is_dir()):
        assert not os.environ.get("CI"), f"continuous integration has node and npm; {VALIDATOR} is missing"
        pytest.skip("needs node and the npm package gltf-validator: make validator")
    (tmp_path / "scene.glb").write_bytes(glb)
    command = ["node", "-e", VALIDATE, str(VALIDATOR.resolve()), str(tmp_path / "scene.glb")]
    issues = json.loads(subprocess.run(command, capture_output=True, text=True).stdout)
    assert issues["numErrors"] == 0 and issues["numWarnings"] == 0, issues["messages"]


# ------------------------------------------------------------------------------------------------------------- mitsuba


def view(width=48, height=36, f=40.0, cx=None, cy=None, name="a"):
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    pose = look_at([0.3, 0.3, 1.6], [2.2, 1.3, 0.5], [0, 0, 1])
    return View(0, name, width, height, f, f, cx, cy, pose)


@pytest.fixture(scope="module")
def mi():
    native.prepare()
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    return mitsuba


def written(folder, files):
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder / "scene.xml"


def test_mitsuba_files_are_plain():
    files = mitsuba_files(list(parts_of(room()).values()), [view(), view(name="b & c")], np.array([0.1, 0, 0]))
    text = files["scene.xml"].decode()
    tree = ElementTree.fromstring(text)
    names = [node.get("value") for node in tree.iter("string") if node.get("name") == "filename"]
    assert names == ["meshes/walls.ply", "meshes/white_box.ply", "meshes/lamp.emitter0.ply"]
    program = {"render.py", *(f"iif_bsdf/{name}.py" for name in ("__init__", "xp", "brdf", "mitsuba_bsdf"))}
    assert set(names) | {"scene.xml"} | program == set(files)
    assert [node.get("id") for node in tree.iter("sensor")] == ["view-a", "view-b & c"]
    assert [node.get("type") for node in tree.iter("emitter")] == ["area", "constant"]
    assert "0.04" in text and "principled" in text


def test_names_that_clash_on_disk():
    parts = list(parts_of(room()).values())
    renamed = [replace(part, name=name) for part, name in zip(parts, ["A/b", "a b", "..."], strict=True)]
    files = mitsuba_files(renamed, [view()], np.zeros(3))
    lower = [name.lower() for name in files if name.startswith(("scene", "meshes"))]
    assert len(set(lower)) == len(lower) == 4
    assert all(".." not in name for name in files)


def own_render(parts, camera, samples):
    """The same parts in the workflow's renderer, one material a face."""
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene
    from tests.oracles.face_materials import FaceMaterials

    offset, vertices, faces, values, radiance = 0, [], [], [], []
    for part in parts:
        vertices.append(part.vertices)
        faces.append(part.faces + offset)
        offset += len(part.vertices)
        material = np.concatenate([part.albedo, part.roughness[:, None], part.metallic[:, None]], 1)
        values.append(material[part.faces].mean(1))
        radiance.append(np.tile(part.radiance, (len(part.faces), 1)))
    passes = np.concatenate([np.full(len(part.faces), 1.0 - part.opacity) for part in parts])
    objects = np.zeros(len(passes), np.int32)
    geometry = build_geometry(np.concatenate(vertices), np.concatenate(faces), objects, passes)
    radiance = np.concatenate(radiance)
    emitters = Emitters(geometry, radiance, np.ones(len(radiance), np.int8))
    pose = camera.world_from_camera
    rays = pixel_directions(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, pose)
    jitter = direction_derivatives(camera.fx, camera.fy, pose)
    image = render(
        Scene(geometry, FaceMaterials(np.concatenate(values)), emitters),
        pose[:3, 3],
        rays.reshape(-1, 3),
        PathOptions(samples, 8, 1),
        jitter,
    )
    return image.reshape(camera.height, camera.width, 3)


def test_mitsuba_renders_what_we_render(mi, tmp_path, monkeypatch):
    parts = list(parts_of(room(), 0.1, 20000).values())
    camera = view(cx=19.0, cy=21.0)
    path = written(tmp_path / "out", mitsuba_files(parts, [camera], np.zeros(3)))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    scene = mi.load_file(str(path))
    theirs = np.array(mi.render(scene, spp=128, seed=1))[..., :3]
    ours = own_render(parts, camera, 128)
    assert np.isfinite(theirs).all() and theirs.mean() > 0.01
    assert theirs.mean() / ours.mean() == pytest.approx(1, abs=0.03)  # not the same BRDF, but as much light

    # Same camera: edges fall on the same pixels, also with the principal point off centre.
    def structure(image):
        grey = np.log(image.mean(-1) + 1e-3)
        return (grey - grey.mean()) / grey.std()

    assert (structure(theirs) * structure(ours)).mean() > 0.95
    shifted = np.roll(theirs, 3, axis=1)
    assert (structure(shifted) * structure(ours)).mean() < 0.9


def test_the_program_beside_the_scene_renders_what_we_render(mi, tmp_path):
    """It needs nothing of the project, and has the exact reflectance: a difference is noise alone."""
    parts, camera = list(parts_of(room(), 0.1, 20000).values()), view()
    folder = written(tmp_path / "out", mitsuba_files(parts, [camera], np.zeros(3))).parent
    programs = [*folder.glob("iif_bsdf/*.py"), folder / "render.py"]
    assert not any(
        line.startswith(("from iif_core", "from workflow")) for file in programs for line in file.read_text().splitlines()
    )
    command = [sys.executable, str(folder / "render.py"), "--samples", "512", "--output", str(tmp_path / "room.exr")]
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=tmp_path, env=clean, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    theirs, ours = np.array(mi.Bitmap(str(tmp_path / "room.exr")))[..., :3], own_render(parts, camera, 512)
    assert theirs.mean() == pytest.approx(ours.mean(), rel=0.01)
    assert np.median(np.abs(theirs / ours - 1)) < 0.05
    wrong = subprocess.run([*command, "--view", "z"], cwd=tmp_path, env=clean, capture_output=True, text=True, timeout=120)
    assert wrong.returncode == 2 and "no view z; there are a" in wrong.stderr


def test_slivers_are_no_hole_and_no_nan(mi, tmp_path):
    """Mitsuba cannot interpolate on a face of 6 m x 1 mm: it gets its material as a whole."""
    scene = room()
    part = parts_of(scene, 0.1)["walls"]
    first = len(part.vertices)
    thin = np.array([[0.3, 1.0, 1.0], [3.7, 1.0, 1.0], [2.0, 1.0, 1.0004]], np.float32)
    ends = {
        name: np.concatenate([getattr(part, name), getattr(part, name)[:3]])
        for name in ("albedo", "normals", "roughness", "metallic")
    }
    part = replace(
        part, vertices=np.concatenate([part.vertices, thin]), faces=np.r_[part.faces, [[first, first + 1, first + 2]]], **ends
    )
    files = mitsuba_files([part], [view()], np.zeros(3))
    assert "meshes/walls.slivers.ply" in files and slivers(part).sum() == 1
    loaded = mi.load_file(str(written(tmp_path, files)))
    thin_shape = next(shape for shape in loaded.shapes() if "slivers" in shape.id())
    x = np.linspace(0.5, 3.5, 1000).astype(np.float32)
    si = loaded.ray_intersect(mi.Ray3f(mi.Point3f(x, 0.5, 1.00005), mi.Vector3f(0, 1, 0)))
    assert np.array(si.shape == mi.ShapePtr(thin_shape)).mean() > 0.5
    assert np.isfinite(np.array(si.bsdf().eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1)))).all()


def test_surface_that_lets_light_through(mi, tmp_path):
    """The box lets half of the light through: in Mitsuba's renderer as in ours, and as alpha in glTF."""
    scene = replace(room(), transmittance=np.array([0, 0.5, 0], np.float32))
    parts = parts_of(scene, 0.1)
    assert {name: part.opacity for name, part in parts.items() if part.opacity < 1} == {"white <box>": 0.5}
    assert parts["white <box>"].double_sided
    camera = view(cx=19.0, cy=21.0)
    loaded = mi.load_file(str(written(tmp_path / "out", mitsuba_files(list(parts.values()), [camera], np.zeros(3)))))
    theirs, ours = np.array(mi.render(loaded, spp=256, seed=1))[..., :3], own_render(list(parts.values()), camera, 256)
    solid = own_render(list(parts_of(room(), 0.1).values()), camera, 256)
    on_box = np.abs(ours - solid).mean(-1) > 0.15 * solid.mean()
    assert on_box.mean() > 0.02
    assert theirs[on_box].mean() == pytest.approx(ours[on_box].mean(), rel=0.05)
    document, _ = chunks_of(glb_bytes(list(parts.values()), scene.up, {}))
    alphas = {m["name"]: (m.get("alphaMode"), m["pbrMetallicRoughness"]["baseColorFactor"][3]) for m in document["materials"]}
    assert alphas["white <box>"] == ("BLEND", 0.5) and alphas["walls"] == (None, 1.0)


def test_glb_looks_the_same_when_it_comes_back(mi, glb, tmp_path):
    """Render what another program reads from the file; the images differ slightly because roughness is a mean there."""
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "scene.glb").write_bytes(glb)
    loaded = trimesh.load(tmp_path / "scene.glb", process=False)
    parts = parts_of(room())
    back = []
    for name, mesh in loaded.geometry.items():
        material = mesh.visual.material
        colour = np.asarray(mesh.visual.vertex_attributes["color"], np.float32)[:, :3] / 65535
        n = len(mesh.vertices)
        strength = 9.0 if material.emissiveFactor is not None and np.any(material.emissiveFactor) else 0.0
        facts = {"vertices": np.asarray(mesh.vertices, np.float32), "faces": np.asarray(mesh.faces, np.int32)}
        facts |= {"albedo": colour, "roughness": np.full(n, material.roughnessFactor, np.float32)}
        facts |= {"metallic": np.full(n, material.metallicFactor, np.float32)}
        facts["radiance"] = strength * np.asarray(material.emissiveFactor if strength else np.zeros(3), np.float32)
        back.append(replace(parts[name], **facts))
    camera = view(24, 18, 20.0)
    before, after = own_render(list(parts.values()), camera, 64), own_render(back, camera, 64)
    assert after.mean() == pytest.approx(before.mean(), rel=0.02)
    assert np.abs(after - before).mean() < 0.08 * before.mean()  # most of it is noise


def test_mitsuba_emitters(mi, tmp_path):
    """A lamp seen head-on has the radiance that was given; one that shines both ways does so from both sides."""
    files = mitsuba_files(list(parts_of(room(lamp_side=0)).values()), [view()], np.zeros(3))
    path = written(tmp_path, files)
    assert "meshes/lamp.emitter0.back.ply" in files
    scene = mi.load_file(str(path))
    rays = mi.Ray3f(mi.Point3f([1.5, 1.5], [1.1, 1.1], [1.0, 2.45]), mi.Vector3f([0, 0], [0, 0], [1, -1]))
    hit = scene.ray_intersect(rays)
    seen = np.array(hit.emitter(scene).eval(hit)).T
    np.testing.assert_allclose(seen, np.tile([9, 6, 3], (2, 1)), rtol=1e-5)


def test_mitsuba_environment(mi, tmp_path):
    parts = [part for name, part in parts_of(room()).items() if name.startswith("white")]
    scene = mi.load_file(str(written(tmp_path, mitsuba_files(parts, [view()], np.array([0.5, 1.0, 2.0])))))
    image = np.array(mi.render(scene, spp=4))
    np.testing.assert_allclose(image[0, 0, :3], [0.5, 1.0, 2.0], rtol=1e-4)


def test_mitsuba_environment_map_keeps_its_directions(mi, tmp_path):
    import drjit as dr

    from iif_core.light.environment import direction_in
    from iif_core.numerics.xp import NUMPY

    sky = np.random.default_rng(0).uniform(0, 1, (16, 32, 3)).astype(np.float32)
    parts = [part for name, part in parts_of(room()).items() if name.startswith("white")]
    scene = mi.load_file(str(written(tmp_path, mitsuba_files(parts, [view()], sky))))
    row, column = np.indices((16, 32))
    for u in ((0.5, 0.5), (0.2, 0.8)):
        toward = np.stack(direction_in(NUMPY, row, column, *u, 16, 32), -1).reshape(-1, 3)
        escaped = dr.zeros(mi.SurfaceInteraction3f, len(toward))
        escaped.wi = mi.Vector3f(-toward.T.astype(np.float32))
        seen = scene.environment().eval(escaped).numpy().T.reshape(16, 32, 3)
        np.testing.assert_allclose(seen, sky, atol=1e-5)
