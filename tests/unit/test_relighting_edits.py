"""Lamps by themselves, edits of the room, camera ways, videos, and what is said of everything that cannot be."""

import io
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.errors import InputError
from iif_core.light.relighting import coloured, sum_of_lamps
from iif_core.numerics.color import linear_from_srgb, luminance
from tests.errors import misset, named, refused
from tests.unit.test_relighting import lit
from tests.unit.test_report import make_scene, scene_of
from workflow.artifacts import StageReader, StageWriter
from workflow.artifacts.files import read_exr, write_exr
from workflow.artifacts.store import rgb, split_rgb
from workflow.exporters.atlas import TexturedPart
from workflow.exporters.glb import glb_bytes
from workflow.relighting import frames, sheet, video, world
from workflow.relighting.inserts import light_of, load_insert, placed
from workflow.relighting.inventory import Inventory, Lamp
from workflow.relighting.tracing import Studio
from workflow.settings import relight_files, relight_origin, relight_plans
from workflow.settings.mesh_files import emissive_strengths
from workflow.settings.relight import Relighting, key_of, lamp_bases, lamp_basis, recombines


def entry(**more):
    return Relighting(**{"name": "a", **more}).model_dump(mode="json")


# ------------------------------------------------------------------------------------------------- light of single lamps


def test_lamps_add_up_to_the_picture(T, room):
    """Both are estimates from independent paths, so that their differences over the noise have variance 1; weights too."""
    from iif_core.light.transport.lamps import render_lamps

    scene = T.Scene(room.geometry, room.material, room.emitters)
    jitter = (np.zeros(3), np.zeros(3))
    weights = np.array([[1.0, 1.0, 1.0], [0.2, 3.0, 0.0]])
    dimmed = T.Emitters(room.geometry, room.radiance * np.append(weights, [[0, 0, 0]], 0)[room.group], room.side)
    for factors, emitters in ((np.ones((2, 3)), room.emitters), (weights, dimmed)):
        traced = np.stack(
            [
                T.render(scene._replace(emitters=emitters), room.origin, room.directions, T.PathOptions(16, 6, seed))
                for seed in range(8)
            ]
        )
        parts = [
            render_lamps(scene, room.group, 2, room.origin, room.directions, T.PathOptions(16, 6, 100 + seed), jitter)
            for seed in range(8)
        ]
        summed = np.stack([sum_of_lamps(part.transpose(1, 0, 2), factors) for part in parts])
        away = (summed.mean(0) - traced.mean(0)).mean(0)
        error = np.sqrt((summed.mean(1).var(0, ddof=1) + traced.mean(1).var(0, ddof=1)) / 8)
        assert (np.abs(away) < 4.5 * np.maximum(error, 1e-9)).all(), away / error
        assert (error < 0.03 * traced.mean()).all()
    part = parts[0].transpose(1, 0, 2)
    assert (sum_of_lamps(part, 2 * weights) == 2 * sum_of_lamps(part, weights)).all()  # exactly linear
    alone = [sum_of_lamps(part, np.where(np.arange(2)[:, None] == lamp, weights, 0)) for lamp in range(2)]
    np.testing.assert_allclose(alone[0] + alone[1], sum_of_lamps(part, weights), rtol=1e-6)


def test_light_from_outside_is_a_lamp(T):
    from iif_core.light.transport.lamps import render_lamps

    geometry = T.build_geometry([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], [0])
    scene = T.Scene(
        geometry, T.FaceMaterials(np.float32([[0.5, 0.5, 0.5, 1, 0]])), T.Emitters(geometry, np.zeros((1, 3)), None, (1, 2, 3))
    )
    rays = (np.float32([0.2, 0.2, 1]), np.float32([[0, 0, 1], [0, 0, -1]]))
    step = (np.zeros(3), np.zeros(3))
    found = render_lamps(scene, [-1], 1, *rays, T.PathOptions(64, 2, 0), step, environment_lamp=0)
    assert found[0, 0].tolist() == [1, 2, 3] and 0.3 < found[1, 0, 0] < 0.7
    assert not render_lamps(scene, [-1], 1, *rays, T.PathOptions(4, 2, 0), step).any()  # nobody asked for its light
    with refused("lamp_of_face", "(2,)", "(1,)"):
        render_lamps(scene, [0, 0], 1, *rays, T.PathOptions(4, 2, 0), step)
    with refused("lamp_of_face", 1, "0 ... 0"):
        render_lamps(scene, [1], 1, *rays, T.PathOptions(4, 2, 0), step)


def test_a_colour_keeps_the_luminance():
    found = np.array([8.0, 4.0, 1.0])
    blue = coloured(found, 0.5, [0.0, 0.2, 1.0])
    assert luminance(blue) == pytest.approx(0.5 * luminance(found)) and blue[0] == 0 and blue[2] == 5 * blue[1]
    with refused("colour", "[0.0, 0.0, 0.0]"):
        coloured(found, 1.0, [0, 0, 0])


def test_colours_may_be_hexadecimal_srgb():
    """#bc8000 is 188, 128, 0 of 255: linear 0.5029, 0.2159, 0 by IEC 61966-2-1."""
    linear = pytest.approx((0.50289, 0.21586, 0.0), abs=1e-5)
    found = entry(lamps={"a": {"colour": "#bc8000"}}, materials={"b": {"albedo": "#BC8000"}, "c": {"tint": "#bc8000"}})
    assert found["lamps"]["a"]["colour"] == linear
    assert found["materials"]["b"]["albedo"] == linear and found["materials"]["c"]["tint"] == linear


def test_factors_and_colours_are_no_part_of_what_is_traced():
    one = entry(name="a", emitters=0.3, lamps={"bulb": {"factor": 2, "colour": [1, 0, 0]}}, environment="off", exposure=2)
    other = entry(name="b", lamps={3: "off"}, video=False)
    assert recombines(one) and recombines(other) and lamp_basis(one) == lamp_basis(other)
    assert len(lamp_bases([one, other])) == 1
    for edit in (
        {"lamps": {"bulb": {"move": [0, 0, 1]}}},
        {"insert": [{"file": "x.glb", "position": [0, 0, 0]}]},
        {"materials": {"wall": {"albedo": [1, 0, 0]}}},
        {"sphere": {"center": [0, 0, 0]}},
        {"environment": [1, 1, 1]},
    ):
        assert not recombines(entry(**edit)) and recombines(entry(**edit, method="recombine"))
        assert key_of(lamp_basis(entry(**edit))) != key_of(lamp_basis(one))
    assert not recombines(entry(method="path")) and key_of(lamp_basis(entry(samples=8))) != key_of(lamp_basis(one))


SPELLINGS = (("colour", "centre"), ("color", "center"))


def test_settings_of_lamps_and_paint():
    lamps = entry(lamps={"a": "off", "b": False, 3: 0.5, "c": {"factor": True}})["lamps"]
    assert {key: lamp["factor"] for key, lamp in lamps.items()} == {"a": 0, "b": 0, "3": 0.5, "c": 1}
    finite, least, most, ours = "finite_number", "greater_than_equal", "less_than_equal", "value_error"
    for bad, *fault in (
        ({"lamps": {"a": -1}}, "lamps.a.factor", least, 0),
        ({"lamps": {"a": {"colour": [0, 0, 0]}}}, "lamps.a.colour", ours, "off"),
        ({"lamps": {"a": {"colour": "orange"}}}, "lamps.a.colour", ours, "'#c0d8e0'"),
        ({"materials": {"a": {"albedo": "#c0d8"}}}, "materials.a.albedo", ours, "'#c0d8e0'"),
        ({"materials": {"a": {}}}, "materials.a", ours, "albedo", "tint", "roughness", "metallic"),
        ({"materials": {"a": {"albedo": [0, 0, 0], "tint": [1, 1, 1]}}}, "materials.a", ours, "albedo", "tint"),
        ({"materials": {"a": {"albedo": [2, 0, 0]}}}, "materials.a.albedo.0", most, 1),
        (
            {"camera": {"views": ["a"], "poses": [{"position": [0, 0, 0], "look_at": [1, 0, 0]}]}},
            "camera",
            ours,
            "views",
            "poses",
        ),
        ({"video": {"codec": "hevc"}}, "video.codec", "literal_error", "'av1'", "'h264'"),
        ({"method": "recombine", "sphere": {"center": [0, 0, 0], "path_to": [1, 0, 0]}}, "", ours, "method: recombine", "sphere"),
        ({"emitters": float("inf")}, "emitters", finite),
        ({"lamps": {"a": 1e300}}, "lamps.a.factor", most, 1_000_000_000),
        ({"lamps": {"a": {"move": [float("nan"), 0, 0]}}}, "lamps.a.move.0", finite),
        ({"sphere": {"center": [0, float("nan"), 0]}}, "sphere.center.1", finite),
        ({"sphere": {"center": [0, 0, 0], "radiance": [-1, 1, 1]}}, "sphere.radiance.0", least, 0),
        ({"insert": [{"file": "a.glb", "position": [0, 0, 0], "scale": float("inf")}]}, "insert.0.scale", finite),
        ({"environment_turn": float("nan")}, "environment_turn", finite),
        ({"environment": [float("inf"), 0, 0]}, "environment.0", finite),
        ({"lamps": {"a": "#ff8800"}}, "lamps.a", ours, "on", "off", "{colour: [1, 0.5, 0.2]}"),
        ({"camera": {"views": ["a"], "frames": 24}}, "", ours, "camera", 24, "frames"),
        ({"camera": {"views": ["a", "b"]}}, "", ours, "camera", "views", "poses", "frames"),
        ({"video": {"codec": "h264"}}, "", ours, "video", "frames"),
        ({"camera": {"poses": [{"position": [0, 1, 2], "look_at": [0, 1, 2]}]}}, "camera.poses.0", ours, "[0.0, 1.0, 2.0]"),
    ):
        with misset(*fault):
            entry(**bad)
    assert entry(video="off")["video"] is None and entry()["video"] == {"fps": 24, "codec": "av1"}
    british, american = (entry(lamps={"a": {ou: [1, 0, 0]}}, sphere={re: [0, 1, 2]}) for ou, re in SPELLINGS)
    assert british == american and british["sphere"]["center"] == [0, 1, 2]
    moving = {"center": [0, 0, 0], "path_to": [1, 0, 0]}
    assert entry(sphere=moving, camera={"frames": 3})["camera"]["frames"] == 3  # the camera stands still, the sphere does not


# ------------------------------------------------------------------------------------------------------------- the room


@pytest.fixture(scope="module")
def toy(llvm, tmp_path_factory):
    root = tmp_path_factory.mktemp("edited")
    make_scene(root)
    return root


@pytest.fixture(scope="module")
def studio(toy):
    return Studio.open(scene_of(toy).job("lamp_images"))


def plate(path, colour=(200, 30, 30), size=(0.8, 0.02, 0.8)):
    """A plate in GLB, y up, of one colour."""
    import trimesh
    from trimesh.visual.material import PBRMaterial

    box = trimesh.creation.box(size)
    box.visual = trimesh.visual.TextureVisuals(
        material=PBRMaterial(baseColorFactor=[*colour, 255], roughnessFactor=0.9, metallicFactor=0.0)
    )
    path.write_bytes(trimesh.Scene({"plate": box}).export(file_type="glb"))
    return path


def seen(studio, state, origin, direction, samples=2048, weights=None):
    """Radiance (3,) along one ray."""
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions

    made = studio.world(lamp_basis(state))
    weights = world.lamp_weights(state, studio.inventory, made.columns, made.level, made.found)
    return render(made.scene(weights), np.float32(origin), np.float32([direction]), PathOptions(samples, 4, 1))[0]


def test_what_is_put_in_casts_a_shadow_and_is_reflected(studio, tmp_path):
    put = {"insert": [{"file": str(plate(tmp_path / "plate.glb")), "position": [1.5, 1.0, 1.2]}]}
    floor = ([1.5, 1.0, 1.0], [0, 0, -1])
    bare, shaded = (seen(studio, entry(**more), *floor) for more in ({}, put))
    assert (shaded < 0.5 * bare).all() and (shaded > 0).all()
    from_above = seen(studio, entry(**put), [1.5, 1.0, 2.0], [0, 0, -1])
    np.testing.assert_allclose(
        from_above / from_above[0], linear_from_srgb(np.array([200, 30, 30]) / 255) / linear_from_srgb(200 / 255), atol=0.15
    )
    mirror = {"walls": {"albedo": [1, 1, 1], "metallic": 1, "roughness": 0.02}}
    green = {**put["insert"][0], "radiance": [0, 5, 0]}
    image = seen(studio, entry(emitters="off", materials=mirror, insert=[green]), *floor, samples=64)
    assert image[1] > 3 and image[0] == image[2] == 0


def test_recombined_with_something_put_in(toy, tmp_path):
    """The same picture, summed and traced, of a room that was edited."""
    edits = {"insert": [{"file": str(plate(tmp_path / "plate.glb")), "position": [1.5, 1.0, 1.2], "radiance": [0, 0, 3]}]}
    more = {**edits, "lamps": {"lamp": {"factor": 0.4, "colour": [1, 0.2, 0.1]}}}
    (summed, traced), _ = lit(toy, {"name": "sum", "method": "recombine", **more}, {"name": "path", **more})
    away = summed - traced
    error = away.std((0, 1)) / np.sqrt(away[..., 0].size)
    assert (np.abs(away.mean((0, 1))) < 4.5 * error).all() and (error < 0.05 * traced.mean((0, 1))).all()


def test_dimmed_is_darker_by_the_factor(toy):
    """Also as a picture: the exposure comes from the photograph and is not chosen anew."""
    from PIL import Image

    (found, dimmed, path), folder = lit(
        toy, {"name": "found"}, {"name": "dimmed", "emitters": 0.3}, {"name": "path", "emitters": 0.3, "method": "path"}
    )
    np.testing.assert_allclose(dimmed, 0.3 * found, rtol=1e-5, atol=1e-6)
    assert path.mean() == pytest.approx(dimmed.mean(), rel=0.03)
    facts = json.loads((folder / "relight.json").read_text())["relightings"]
    assert [one["exposure"] for one in facts] == [0.5] * 3 and facts[1]["exposure_of"] == "of photograph v0"
    assert facts[1]["changes"] == "all lamps x 0.3" and facts[0]["method"] == "recombined"
    level = [np.asarray(Image.open(folder / f"{name}/frame_0000.png")).mean() for name in ("found", "dimmed")]
    assert level[1] < 0.7 * level[0]
    before = np.asarray(Image.open(folder / "dimmed/before_0000.png"))
    assert (before == np.asarray(Image.open(folder / "found/frame_0000.png"))).all()
    _, folder = lit(
        toy, {"name": "auto", "emitters": 0.3, "exposure": "auto"}, {"name": "plain", "exposure": 2, "response": "srgb"}
    )
    auto, plain = json.loads((folder / "relight.json").read_text())["relightings"]
    assert auto["exposure"] > 1 and auto["exposure_of"] == "by the first frame" and plain["exposure"] == 2


def test_paint_changes_one_object_alone(studio):
    surface, paint = (
        studio.room.surface,
        entry(materials={"box": {"tint": [0.5, 1, 2], "roughness": 0.3}, 0: {"albedo": [1, 0, 0]}}),
    )
    made = world.painted(surface, studio.inventory, paint["materials"])
    box, walls = surface.cell_object == 1, surface.cell_object == 0
    np.testing.assert_allclose(made.cell_values[box, :3], np.minimum(surface.cell_values[box, :3] * np.float32([0.5, 1, 2]), 1))
    assert (made.cell_values[box, 3] == np.float32(0.3)).all() and (made.cell_values[box, 4] == surface.cell_values[box, 4]).all()
    assert (made.cell_values[walls, :3] == [1, 0, 0]).all() and (made.object_values[0, :3] == [1, 0, 0]).all()
    rest = ~(box | walls)
    assert rest.any() and (made.cell_values[rest] == surface.cell_values[rest]).all()
    assert (made.object_values[2] == surface.object_values[2]).all()


def test_a_lamp_that_is_moved_takes_its_material_along(studio):
    made = studio.world(lamp_basis(entry(lamps={"lamp": {"move": [0.5, 0, -1.0]}})))
    lit_faces = made.lamp_of_face == 0
    corners = made.geometry.vertices[made.geometry.faces[lit_faces]]
    was = studio.room.surface.vertices[studio.room.surface.faces[lit_faces[: len(studio.room.surface.faces)]]]
    np.testing.assert_allclose(corners, was + np.float32([0.5, 0, -1.0]), atol=1e-6)
    bright, dark = (
        seen(studio, entry(lamps={"lamp": {"move": move}}), [1.5, 1.0, 0.5], [0, 0, -1])[0] for move in ([0, 0, -1.0], [0, 0, 0])
    )
    assert bright > 1.2 * dark


def test_materials_of_moved_and_textured_faces(T):
    """A moved face has the material of where it was; textures repeat, and are interpolated between texels."""
    import drjit as dr
    import mitsuba as mi

    from iif_core.light.transport.edits import EditedMaterials, Textures, uv_maps

    def by_place(point, face, object_id, active):
        return mi.Color3f(point.x, point.y, point.z), mi.Float(0.5), mi.Float(0.0)

    corners = np.array([[[0, 0, 0], [2, 0, 0], [0, 2, 0]], [[1, 1, 1], [1, 3, 1], [1, 1, 4.0]]])
    uv = np.array([[[0, 0], [2, 0], [0, 2.0]], [[0.5, 0.5]] * 3])
    texels = np.random.default_rng(0).uniform(0.1, 0.9, (12, 5)).astype(np.float32)
    textures = Textures(texels, np.array([0, 0]), np.array([4, 4]), np.array([3, 3]), uv_maps(corners, uv))
    shift = np.zeros((4, 3), np.float32)
    shift[1] = 1, 2, 3
    made = EditedMaterials(by_place, 4, shift, textures)
    points = np.float32([[5, 5, 5], [5, 5, 5], [0.25, 1.7, 0], [1.9, 0.05, 0], [1, 2, 2]])
    faces = np.uint32([0, 1, 2, 2, 3])
    colour, roughness, metallic = made(mi.Point3f(points.T), mi.UInt32(faces), mi.Int32(0), mi.Bool(True))
    found = np.column_stack([np.array(colour).T, np.array(roughness), np.zeros(5) + np.array(metallic)])
    assert found[0].tolist()[:3] == [5, 5, 5] and found[1].tolist()[:3] == [4, 3, 2]
    image = texels.reshape(3, 4, 5)
    for row, (u, v) in zip(found[2:], ((0.25, 1.7), (1.9, 0.05), (0.5, 0.5)), strict=True):
        x, y = u % 1 * 4 - 0.5, v % 1 * 3 - 0.5
        i, j = int(np.floor(x)), int(np.floor(y))
        expected = sum(
            (1 - abs(x - i - a)) * (1 - abs(y - j - b)) * image[(j + b) % 3, (i + a) % 4] for a in (0, 1) for b in (0, 1)
        )
        np.testing.assert_allclose(row, expected, atol=2e-5)
    with refused("2 faces", "(2, 8)"):
        EditedMaterials(by_place, 4, None, textures._replace(width=np.array([4, 40])))
    dr.eval(colour)


# ------------------------------------------------------------------------------------------------------- files of meshes


def test_meshes_come_with_their_materials(tmp_path):
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial

    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    colours = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    gloss = np.zeros((2, 2, 3), np.uint8)
    gloss[..., 1], gloss[..., 2] = 128, 255
    material = PBRMaterial(
        baseColorTexture=Image.fromarray(colours),
        metallicRoughnessTexture=Image.fromarray(gloss),
        roughnessFactor=0.5,
        metallicFactor=0.8,
    )
    textured = square.copy()
    textured.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    (tmp_path / "a.glb").write_bytes(trimesh.Scene({"a": textured}).export(file_type="glb"))
    mesh = load_insert(tmp_path / "a.glb")
    assert mesh.is_y_up and len(mesh.corners) == 2 and mesh.textures[0].shape == (2, 2, 5)
    assert mesh.textures[0][0, 0, :3].tolist() == [1, 0, 0] and mesh.textures[0][1, 0, :3].tolist() == [0, 0, 1]
    np.testing.assert_allclose(mesh.textures[0][..., 3:].reshape(-1, 2), [[0.5 * 128 / 255, 0.8]] * 4, atol=1e-3)
    lower_left = mesh.corners.reshape(-1, 3).sum(1).argmin()
    np.testing.assert_allclose(mesh.uv.reshape(-1, 2)[lower_left], [0, 1], atol=1e-6)  # v counts downwards
    plain = square.copy()
    plain.visual.vertex_colors = np.tile(np.uint8([188, 0, 0, 255]), (4, 1))
    plain.export(tmp_path / "b.ply")
    mesh = load_insert(tmp_path / "b.ply")
    assert not mesh.is_y_up
    np.testing.assert_allclose(mesh.textures[0][0, :, 0], linear_from_srgb(188 / 255), atol=1e-6)
    square.export(tmp_path / "c.obj")
    assert load_insert(tmp_path / "c.obj").textures[0].shape == (1, 1, 5)


def test_colours_of_vertices_are_linear_in_gltf(tmp_path):
    import trimesh
    from trimesh.visual.material import PBRMaterial

    coloured = trimesh.creation.box()
    coloured.visual.vertex_colors = np.tile(np.uint8([128, 64, 255, 255]), (8, 1))
    coloured.export(tmp_path / "a.glb")
    texture = load_insert(tmp_path / "a.glb").textures[0]
    np.testing.assert_allclose(texture[0, :, :3], np.tile([128 / 255, 64 / 255, 1], (12, 1)), atol=1e-6)
    material = PBRMaterial(baseColorFactor=[0.2, 1.0, 0.6, 1.0], roughnessFactor=0.3, metallicFactor=0.0)
    coloured.visual = trimesh.visual.TextureVisuals(material=material)
    coloured.visual.vertex_attributes["color"] = np.tile(np.uint8([128, 64, 255, 255]), (8, 1))
    coloured.export(tmp_path / "b.glb")
    mesh = load_insert(tmp_path / "b.glb")  # both are multiplied, and what else the material says stays
    np.testing.assert_allclose(mesh.textures[0][0], np.tile([0.2 * 128 / 255, 64 / 255, 0.6, 0.3, 0], (12, 1)), atol=2e-3)
    assert mesh.uv.shape == (12, 3, 2)


def test_mirrored_nodes_keep_their_outer_side_out(tmp_path):
    import trimesh

    for name, mirror in (("as-is", [1, 1, 1]), ("mirrored", [-2, 1, 1])):
        scene = trimesh.Scene()
        scene.add_geometry(trimesh.creation.box(), transform=np.diag([*mirror, 1.0]))
        (tmp_path / f"{name}.glb").write_bytes(scene.export(file_type="glb"))
        a, b, c = np.moveaxis(load_insert(tmp_path / f"{name}.glb").corners, 1, 0)
        volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
        assert volume == pytest.approx(abs(np.prod(mirror)))


def lamp_glb(path, **changes):
    """A square of 0.4 m that looks down, as the exporter writes a lamp: its radiance is 9, 6, 3."""
    corners = np.float32([[0, 0, 0], [0.4, 0, 0], [0.4, 0, 0.4], [0, 0, 0.4]])  # in glTF's axes
    down, faces = np.tile(np.float32([0, -1, 0]), (4, 1)), np.int32([[0, 1, 2], [0, 2, 3]])
    lamp = TexturedPart("lamp", 0, 0, corners, down, np.zeros((4, 2), np.float32), faces, np.float32([9, 6, 3]), False)
    path.write_bytes(glb_bytes([replace(lamp, **changes)], {}, np.array([0.0, 1, 0]), {}))
    return path


def test_what_shines_in_its_file_shines_in_the_room(studio, tmp_path):
    """The strength of glTF counts, one side alone shines unless the material has two, and what a user gives goes before."""
    path = lamp_glb(tmp_path / "lamp.glb")
    put = {"file": str(path), "position": [1.5, 1.0, 1.5]}
    up, down = ([1.5, 1.0, 1.0], [0.01, 0.01, 1]), ([1.5, 1.0, 2.0], [0.01, 0.01, -1])

    def lit(where, **more):
        return seen(studio, entry(emitters="off", insert=[{**put, **more}]), *where, samples=64)

    np.testing.assert_allclose(lit(up), [9, 6, 3], rtol=1e-3)  # itself all but black
    assert lit(down).max() < 0.1
    below = seen(studio, entry(emitters="off", insert=[put]), [1.5, 1.0, 1.0], [0, 0, -1])
    assert (below > 0.01).all() and below.argmax() == 0
    np.testing.assert_allclose(lit(up, radiance=[0, 2, 0]), [0, 2, 0], atol=2e-3)
    assert lit(up, radiance=[0, 0, 0]).max() == 0 and lit(up, material={"albedo": [0.5, 0.5, 0.5]}).max() == 0
    lamp_glb(path, double_sided=True)
    np.testing.assert_allclose(lit(down), [9, 6, 3], rtol=1e-3)


def test_emission_that_is_not_read_is_refused_and_the_rest_is_named(tmp_path):
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial

    def made(name, **more):
        square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 1, 2]], process=False)
        square.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1]], material=PBRMaterial(name=name, **more))
        (tmp_path / f"{name}.glb").write_bytes(trimesh.Scene({"a": square}).export(file_type="glb"))
        return load_insert(tmp_path / f"{name}.glb")

    picture = Image.fromarray(np.full((2, 2, 3), 200, np.uint8))
    screen = made("screen", emissiveTexture=picture, emissiveFactor=[1, 1, 1])
    put = entry(insert=[{"file": str(tmp_path / "screen.glb"), "position": [0, 0, 0]}])["insert"][0]
    with refused("screen.glb", "'screen'", "emissiveFactor", "radiance"):
        light_of(screen, put)
    assert light_of(screen, {**put, "radiance": [0, 1, 0]}).tolist() == [[0, 1, 0]]
    dark = made("dark", emissiveTexture=picture, emissiveFactor=[0, 0, 0])
    assert not dark.glowing and not light_of(dark, put).any()
    glass = made("glass", alphaMode="BLEND", baseColorFactor=[255, 255, 255, 80], normalTexture=picture)
    assert glass.left_out == ("transparency", "normal maps") and screen.left_out == ()
    document = {"asset": {}, "materials": [{"name": "a"}, {"name": "a", "extensions": {"KHR_materials_emissive_strength": {}}}]}
    path = tmp_path / "two.gltf"
    path.write_text(json.dumps(document))
    assert emissive_strengths(path) == {}
    document["materials"][1]["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"] = 4
    path.write_text(json.dumps(document))
    with refused(path, "'a'"):
        emissive_strengths(path)


@pytest.mark.parametrize("strength", ["NaN", "1e10", "-1", '"bright"', "[]"])
def test_strengths_of_emission_that_are_no_radiance_are_refused(tmp_path, strength):
    material = f'{{"name": "a", "extensions": {{"KHR_materials_emissive_strength": {{"emissiveStrength": {strength}}}}}}}'
    path = tmp_path / "one.gltf"
    path.write_text(f'{{"asset": {{}}, "materials": [{material}]}}')
    with refused(path):
        emissive_strengths(path)


@pytest.mark.parametrize("factor", [[-1.0, 0.0, 0.0], [1e12, 0.0, 0.0], [float("nan"), 0.0, 0.0]])
def test_emission_that_is_no_radiance_is_refused(tmp_path, factor):
    mesh = replace(load_insert(plate(tmp_path / "plate.glb")), radiance=np.array([factor]))
    put = entry(insert=[{"file": "plate.glb", "position": [0, 0, 0]}])["insert"][0]
    with refused("plate.glb", "0 ... 1e+09", "radiance"):
        light_of(mesh, put)
    assert light_of(mesh, {**put, "radiance": [0, 1, 0]}).tolist() == [[0, 1, 0]] * len(mesh.corners)


def test_a_map_of_the_environment_that_is_no_picture_is_blamed_by_its_own_key(tmp_path):
    (tmp_path / "sky.exr").write_bytes(b"no picture")
    with refused("relight.environment", "a", tmp_path / "sky.exr", "EXR"):
        relight_files([entry(environment=str(tmp_path / "sky.exr"))])


def test_meshes_stand_where_they_are_put(tmp_path):
    mesh = load_insert(plate(tmp_path / "plate.glb", size=(0.8, 0.1, 0.4)))
    put = {"position": [1, 2, 3], "rotation": [0, 0, 90], "scale": 2.0}
    corners = placed(mesh, put, np.array([0.0, 0, 1])).reshape(-1, 3)
    np.testing.assert_allclose(corners.min(0), [1 - 0.4, 2 - 0.8, 3], atol=1e-9)
    np.testing.assert_allclose(corners.max(0), [1 + 0.4, 2 + 0.8, 3.2], atol=1e-9)
    for up in ([0, 1, 0], [0, -1, 0], [1, 0, 0]):
        corners = placed(mesh, {**put, "rotation": [0, 0, 0]}, np.float64(up)).reshape(-1, 3)
        assert (corners @ np.float64(up)).min() == pytest.approx(np.float64(up) @ [1, 2, 3])
        assert np.ptp(corners @ np.float64(up)) == pytest.approx(0.2)


def test_broken_meshes_are_refused(tmp_path):
    def said(path):
        with pytest.raises(InputError) as error:
            relight_files([entry(insert=[{"file": str(path), "position": [0, 0, 0]}])])
            load_insert(path)
        message = str(error.value)
        assert message.count("\n") == 0 and path.name in message
        return message

    whole = plate(tmp_path / "plate.glb").read_bytes()
    (tmp_path / "short.glb").write_bytes(whole[:-40])
    named(said(tmp_path / "short.glb"), len(whole), len(whole) - 40)
    for kind in (".glb", ".gltf", ".ply", ".obj"):
        (tmp_path / f"nothing{kind}").touch()
        named(said(tmp_path / f"nothing{kind}"), 0)
    (tmp_path / "text.glb").write_text("not a mesh, and longer than its header")
    named(said(tmp_path / "text.glb"), "GLB", "`glTF`")
    spoilt = bytearray(whole)
    spoilt[24:30] = b"??????"
    (tmp_path / "spoilt.glb").write_bytes(spoilt)
    named(said(tmp_path / "spoilt.glb"), "glTF")
    document = {"asset": {"version": "2.0"}, "images": [{"uri": "wodo.png"}]}
    (tmp_path / "wood.png").touch()
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    named(said(tmp_path / "a.gltf"), tmp_path / "wodo.png", tmp_path / "wood.png")
    (tmp_path / "b.gltf").write_text(json.dumps({"asset": {}, "extensionsRequired": ["EXT_meshopt_compression"]}))
    named(said(tmp_path / "b.gltf"), "EXT_meshopt_compression")
    (tmp_path / "c.gltf").write_text(json.dumps({"asset": {"version": "2.0"}}))
    named(said(tmp_path / "c.gltf"), "c.gltf")
    (tmp_path / "d.ply").write_text("plyers")
    named(said(tmp_path / "d.ply"), "d.ply", "header")
    (tmp_path / "e.obj").write_text("mtllib nothing.mtl\nv 0 0 0\n")
    named(said(tmp_path / "e.obj"), tmp_path / "nothing.mtl")
    named(said(tmp_path / "plat.glb"), tmp_path / "plat.glb", tmp_path / "plate.glb")
    named(said(tmp_path / "mesh.fbx"), ".fbx", ".glb, .gltf, .ply, .obj")


# --------------------------------------------------------------------------------------------------- what does not exist


@pytest.fixture
def things():
    return Inventory(["wall", "window", "bulb", "bulb"], [Lamp(0, (1,)), Lamp(4, (2,)), Lamp(5, (3,))])


def test_a_lamp_on_several_objects_is_called_as_it_is_shown():
    room = Inventory(["wall", "pane", "frame"], [Lamp(0, (1, 2)), Lamp(1, (2,)), Lamp(2, ())])
    assert [room.name_of(lamp) for lamp in room.lamps] == ["pane and 1 more", "frame", "lamp 2"]
    assert room.lamps_called("pane and 1 more", "x") == [0] and room.lamps_called("pane", "x") == [0]
    assert room.lamps_called("frame", "x") == [1]  # the one that is called so, and not all that are on it


def test_the_panes_of_a_window_are_called_together():
    lamps = [Lamp(0, (1,), 1.0, "window 1"), Lamp(1, (2,), 1.0, "window 1"), Lamp(4, (3,), 1.0, "lamp 1")]
    room = Inventory(["wall", "pane", "pane", "bulb"], lamps)
    assert room.lamps_called("window 1", "x") == [0, 1] and room.lamps_called("lamp 1", "x") == [2]
    with refused("relight.lamps", "'window 2'", "'window 1'", "window 1 (emitter 0, 1), lamp 1 (emitter 4);"):
        room.lamps_called("window 2", "relight.lamps")
    with refused("relight.lamps", "'light from outside'", "environment: off"):
        room.lamps_called("light from outside", "relight.lamps")
    found = room.expanded([entry(each="alone")])
    assert [(one["name"], list(one["lamps"])) for one in found] == [
        ("a_window_1", ["emitter 0", "emitter 1"]),
        ("a_lamp_1", ["emitter 4"]),
    ]
    for one in found:
        room.check(one)


def test_a_name_that_means_two_things_is_refused():
    """An object is called as a lamp that is on another one; where both are the same lamps nothing is in doubt."""
    room = Inventory(["wall", "pane", "window 1"], [Lamp(0, (1,), 1.0, "window 1"), Lamp(4, (2,), 1.0, "lamp 1")])
    with refused("relight.lamps", "'window 1'", "emitter 0, emitter 4"):
        room.lamps_called("window 1", "relight.lamps")
    assert room.lamps_called("emitter 4", "x") == [1] and room.lamps_called("lamp 1", "x") == [1]
    for one in room.expanded([entry(each="off")]):
        room.check(one)
    same = Inventory(["window 1"], [Lamp(0, (0,), 1.0, "window 1")])
    assert same.lamps_called("window 1", "x") == [0]


def test_lamps_are_called_by_object_or_id(things):
    assert things.lamps_called("window", "x") == [0] and things.lamps_called("4", "x") == [1]
    assert things.lamps_called("bulb", "x") == [1, 2]
    for key, names in (
        ("windw", ["'windw'", "'window'", "window (emitter 0), bulb (emitter 4, 5)"]),
        ("7", ["'7'", "window (emitter 0), bulb (emitter 4, 5)"]),
        ("wall", ["object 'wall'", "window (emitter 0), bulb (emitter 4, 5)"]),
    ):
        with refused("relight.lamps", "a", *names):
            things.check(entry(lamps={key: "off"}))
    with refused("relight.lamps", "a", "'4'", "'bulb'", 4):
        things.check(entry(lamps={"bulb": 1, 4: 2}))
    with refused("relight.materials", "a", "'wal'", "'wall'"):
        things.check(entry(materials={"wal": {"metallic": 0}}))


def test_each_lamp_alone_and_without_each():
    """The strongest first, at most twelve, all summed from the pictures of one pass; other entries stay as they are."""
    many = Inventory(["wall"], [Lamp(i, (0,), power) for i, power in enumerate([1.0, 5.0, 3.0, *[0.1] * 20])])
    alone, without, plain = entry(each="alone"), entry(each="off", exposure="auto"), entry(emitters=0.5)
    found = many.expanded([plain, alone, without])
    assert len(found) == 1 + 12 + 12 and found[0] is plain
    first, second = found[1:3]
    assert (first["name"], second["name"]) == ("a_1", "a_2")
    assert (first["emitters"], first["environment"], first["each"]) == (0.0, "off", None)
    assert list(first["lamps"]) == ["emitter 1"] and first["lamps"]["emitter 1"]["factor"] == 1.0
    last = found[13]
    assert (last["emitters"], last["environment"], last["lamps"]["emitter 1"]["factor"], last["exposure"]) == (
        1.0,
        "keep",
        0.0,
        "auto",
    )
    assert {key_of(lamp_basis(one)) for one in found[1:]} == {key_of(lamp_basis(alone)), key_of(lamp_basis(without))}
    assert all(recombines(one) for one in found)
    for one in found:
        many.check(one)


def test_a_lamp_is_told_from_an_object_that_is_called_by_a_number():
    odd = Inventory(["wall", "5", "sofa"], [Lamp(5, (0,)), Lamp(6, (1,))])
    assert odd.lamps_called("5", "x") == [1] and odd.lamps_called("emitter 5", "x") == [0]
    found = odd.expanded([entry(each="alone")])
    assert [odd.lamps_called(next(iter(one["lamps"])), "x") for one in found] == [[0], [1]]


def test_each_takes_no_other_lamps():
    with misset("", "value_error", "each", "lamps"):
        Relighting.model_validate({"name": "a", "each": "alone", "lamps": {"0": "off"}})


def test_a_way_through_a_wall_is_named(toy):
    camera = {
        "poses": [{"position": [0.3, 0.3, 1.6], "look_at": [2, 1, 1]}, {"position": [0.3, -1.0, 1.6], "look_at": [2, 1, 1]}]
    }
    camera |= {"frames": 5, "width": 16, "height": 16}
    wanted = {"name": "out", "camera": camera, "samples": 1, "video": False}
    where = ("config/scenes/toy.yaml", "relight.camera", "out", "'walls'", "[0.30, 0.00, 1.60]")
    with refused(*where, "1 and 2", "through_surface: true"):
        lit(toy, wanted)
    with refused(*where):
        lit(toy, {**wanted, "method": "path"})
    _, folder = lit(toy, {**wanted, "camera": {**camera, "through_surface": True}})
    assert (folder / "out/frame_0004.png").is_file() and not (folder / "out/video.mp4").exists()


def test_nothing_is_rendered_before_everything_was_checked(toy, monkeypatch):
    monkeypatch.setattr(frames, "trace_picture", lambda *_: pytest.fail("rendered although the second relighting is wrong"))
    for key, far in (("center", {"center": [0, 0, 70]}), ("path_to", {"center": [0, 0, 1], "path_to": [0, 0, 70]})):
        with refused(f"relight.sphere.{key}", "b", "[0.0, 0.0, 70.0]"):
            lit(toy, {"name": "a", "method": "path"}, {"name": "b", "sphere": far})
    with refused("relight.lamps", "b", "'lmap'", "'lamp'"):
        lit(toy, {"name": "a", "method": "path"}, {"name": "b", "lamps": {"lmap": 0}, "method": "path"})


# ----------------------------------------------------------------------------------------------- only what an edit touches


def test_frames_that_an_edit_does_not_touch_are_taken_over(toy, monkeypatch):
    traced = []
    trace = frames.trace_picture
    monkeypatch.setattr(frames, "trace_picture", lambda *arguments: traced.append(arguments[4]["materials"]) or trace(*arguments))
    first = {"name": "first", "materials": {"box": {"albedo": [1, 0, 0]}}, "samples": 2}
    second = {"name": "second", "materials": {"box": {"albedo": [0, 1, 0]}}, "samples": 2}
    pictures, folder = lit(toy, first, second)
    assert len(traced) == 4  # and what was before, of either
    traced.clear()
    again, _ = lit(toy, {**second, "materials": {"box": {"albedo": [0, 0, 1]}}}, {**first, "exposure": 3.0})
    assert traced == [{"box": {"albedo": [0.0, 0.0, 1.0], "tint": None, "roughness": None, "metallic": None}}]
    assert (again[1] == pictures[0]).all() and (again[0] != pictures[1]).any()
    assert set(json.loads((folder / "parts.json").read_text())["parts"]) == {
        "first.frame_0000",
        "first.before_0000",
        "second.frame_0000",
        "second.before_0000",
    }
    traced.clear()
    (folder / "first/frame_0000.exr").write_bytes(b"damaged")
    lit(toy, {**first, "exposure": 3.0})
    assert len(traced) == 1


def test_parts_outlive_other_changes_of_their_stage(tmp_path):
    def job(fingerprint):
        return StageWriter(tmp_path / "stage", {"stage": "stage", "fingerprint": fingerprint})

    writer = job("one")
    writer.bytes("a.bin", b"a")
    writer.part_done("a", ["a.bin"], {"n": 1}, by="digest")
    writer.bytes("b.bin", b"b")
    writer.part_done("b", ["b.bin"], {})
    writer.finish()
    (tmp_path / "stage/manifest.json").unlink()  # as Snakemake does
    writer = job("two")
    assert writer.part_kept("a", by="other") is None and writer.part_kept("b") is None
    assert writer.part_kept("a", by="digest") == {"n": 1}
    writer.finish()
    assert StageReader(tmp_path / "stage", "stage", "x").manifest["files"].keys() == {"a.bin"}
    assert not (tmp_path / "stage/unfinished").exists() and not (tmp_path / "stage/b.bin").exists()
    writer = job("three")  # killed before it looked at anything
    assert job("four").part_kept("a", by="digest") == {"n": 1}


# ------------------------------------------------------------------------------------------------------ sheet and video


@pytest.mark.parametrize("codec", ["av1", "h264"])
@pytest.mark.parametrize("size", [(64, 96), (65, 97)])
def test_videos_play(codec, size):
    import av

    ramp = np.linspace(40, 200, size[1])[None, :, None] * np.ones((size[0], 1, 3))
    pictures = [np.uint8(np.clip(ramp * [1, 0.6, 0.3] + 10 * number, 0, 255)) for number in range(5)]
    with av.open(io.BytesIO(video.encoded(pictures, 12, codec))) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert stream.average_rate == 12 and float(stream.duration * stream.time_base) == pytest.approx(5 / 12)
    assert len(frames) == 5 and all(frame.shape == (-(-size[0] // 2) * 2, -(-size[1] // 2) * 2, 3) for frame in frames)
    for frame, picture in zip(frames, pictures, strict=True):
        assert np.abs(frame[: size[0], : size[1]].astype(int) - picture).mean() < 5


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="scheduling is asked for as Linux has it")
def test_a_video_leaves_the_scheduling_of_the_thread_as_it_was():
    """Fails as root alone: for others SVT-AV1 cannot change it."""
    before = os.sched_getscheduler(0)
    video.encoded([np.zeros((64, 64, 3), np.uint8)] * 2, 12, "av1")
    assert os.sched_getscheduler(0) == before


def test_a_codec_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setitem(video.ENCODERS, "av1", "libnothing")
    with refused("relight.video.codec", "flight", "'av1'", "libnothing", "h264"):
        video.require_codec("av1", "flight")
    video.require_codec("h264", "flight")


def test_flights_have_a_video_and_the_sheet_shows_what_was_before(toy):
    from PIL import Image

    camera = {"views": ["v0", "v1"], "frames": 4, "width": 48, "height": 40, "through_surface": True}
    _, folder = lit(
        toy, {"name": "flight", "lamps": {"lamp": 0.5}, "camera": camera, "samples": 4, "video": {"fps": 8, "codec": "h264"}}
    )
    assert (folder / "flight/video.mp4").stat().st_size > 500
    shown = sheet.shown_frames(4)
    assert shown == [0, 2, 3] and sheet.shown_frames(1) == [0] and sheet.shown_frames(2) == [0, 1]
    for frame in shown:
        before, after = (rgb(read_exr(folder / f"flight/{name}_{frame:04d}.exr")) for name in ("before", "frame"))
        np.testing.assert_allclose(after, 0.5 * before, rtol=2e-3, atol=1e-5)
    width, height = Image.open(folder / "contact_sheet.png").size
    assert width >= 6 * 48 and height > 40 + sheet.TITLE + sheet.CAPTION
    one = sheet.Row("a short title", [sheet.Pair(np.zeros((40, 200, 3), np.uint8), np.full((40, 200, 3), 255, np.uint8), "")])
    drawn = sheet.contact_sheet([one] * 4)
    assert drawn.shape[1] == 3 * 424 and drawn.shape[0] == 2 * (sheet.GAP + sheet.TITLE + 40 + sheet.CAPTION + sheet.GAP)
    assert (drawn[sheet.GAP + sheet.TITLE + 20, 20] == 0).all()
    titled = sheet.contact_sheet([one] * 4, "Evening")
    assert (titled[sheet.HEAD :] == drawn).all() and titled[: sheet.HEAD].min() < 128


def test_captions_say_what_changes():
    lamps = [Lamp(0, (1,), 1.0, "window 1"), Lamp(1, (1,), 1.0, "ceiling light 1"), Lamp(2, (2,), 1.0, "ceiling light 1")]
    room = Inventory(["wall", "pane", "panel"], [*lamps, Lamp(3, (0,), 1.0, "lamp 1")])
    told = sheet.described(
        entry(
            emitters=0.5,
            lamps={"pane": "off", 2: {"colour": [1, 0, 0], "factor": 2}, "lamp 1": {"move": [0, 0, 1]}},
            environment=[1, 1, 1],
            insert=[{"file": "a/vase.glb", "position": [0, 0, 0]}],
            materials={"wall": {"metallic": 0}},
        ),
        room,
    )
    of_lamps, rest = told.split("; light from ")
    assert of_lamps.split("; ") == [
        "other lamps x 0.5",
        "window 1 off",  # on the pane is one of the ceiling lights too
        "ceiling light 1 (emitter 1) off",
        "ceiling light 1 (emitter 2) x 2, colour 1 0 0",
        "lamp 1 moved 0 0 1 m",
    ]
    assert rest == "outside 1 1 1; vase put in; wall painted"
    assert sheet.described(entry(), room) == "as found"
    alone = sheet.described(next(iter(room.expanded([entry(each="alone")]))), room)
    assert alone == "other lamps off; ceiling light 1 on; light from outside off"  # both, which are the strongest
    assert sheet.described(entry(emitters=0.3), Inventory(["wall"], [])) == "all lamps x 0.3 (there are none)"


# ----------------------------------------------------------------------------------------------------------------- plans


def test_plans_are_found_and_checked(tmp_path):
    folder = tmp_path / "config/relight"
    folder.mkdir(parents=True)
    (tmp_path / "config/scenes").mkdir()
    (folder / "night.yaml").write_text(
        "relight:\n- {name: a, emitters: off}\n- {name: b, insert: [{file: plate.glb, position: [0, 0, 0]}]}\n"
    )
    plate(folder / "plate.glb")
    place, layer = relight_plans.plan_layer("night", tmp_path)
    assert place == "config/relight/night.yaml" and layer["relight"][1]["insert"][0]["file"] == str(folder / "plate.glb")
    assert relight_plans.active_plan("night", tmp_path) == "night" and relight_plans.active_plan("x", tmp_path) == "example"
    for text, names in (
        ("title: t\n", ["relight", "config/relight/kitchen.yaml"]),
        ("title: 5\nrelight: [{name: a}]\n", ["title", 5]),
        ("relihgt: []\n", ["relihgt", "relight"]),
    ):
        (folder / "bad.yaml").write_text(text)
        with refused("config/relight/bad.yaml", *names):
            relight_plans.plan_layer("bad", tmp_path)
    with refused("config/relight/nihgt.yaml", "night", "bad, night"):
        relight_plans.plan_layer("nihgt", tmp_path)


def test_mistakes_in_a_plan_are_blamed_on_it(tmp_path, repository):
    from workflow import settings

    for part in ("relight", "scenes"):
        (tmp_path / f"config/{part}").mkdir(parents=True)
    shutil.copy(repository / "config/scenes/kitchen.yaml", tmp_path / "config/scenes/room.yaml")
    for entries, names in (
        ("{name: a, lamsp: {bulb: off}}", ["relight.0.lamsp", "lamps"]),
        ("{name: a b/c}", ["relight.0.name", "'a b/c'", "_", "-"]),
        ("{name: a}, {name: a}", ["relight", 2, "'a'"]),
        ("{name: a, camera: {views: [003]}}", ["relight.0.camera.views.0", 3, '"003"']),
        ("{name: a, insert: [{file: a.glb}]}", ["relight.0.insert.0.position", "config/relight/kitchen.yaml"]),
    ):
        (tmp_path / "config/relight/night.yaml").write_text(f"relight: [{entries}]\n")
        with refused("config/relight/night.yaml", *names):
            settings.load("room--relight-night-s0", "draft", tmp_path)
    (tmp_path / "config/relight/night.yaml").write_text("relight: [{name: a, lamps: {bulb: off}}]\n")
    found = settings.dump(settings.load("room--relight-night-s0", "draft", tmp_path))
    plain = settings.dump(settings.load("room", "draft", tmp_path))
    assert found["recombined"] == ["a"] and not plain["relight"]
    different = {key for key in found if found[key] != plain[key]}
    assert different == {"relight", "lamp_images", "recombined"}


def test_shipped_plans_are_good(repository):
    from workflow import settings

    names = relight_plans.plan_names(repository)
    assert {"example", "kitchen"} <= set(names)
    for name in names:
        document = settings.dump(settings.load(f"kitchen--relight-{name}-s0", "draft", repository))
        assert document["relight"] and settings.require_relighting(document, "kitchen")


def test_environment_map_as_a_lamp(toy, tmp_path):
    """A map takes the place of what was found, for sums as well; a factor dims what was found."""
    write_exr(tmp_path / "sky.exr", split_rgb(np.full((8, 16, 3), 0.5, np.float32)))
    camera = {"poses": [{"position": [0.3, -1.0, 1.6], "look_at": [2, -3, 1]}]}
    more = {"environment": str(tmp_path / "sky.exr"), "camera": camera, "samples": 4}
    (summed, traced, none), _ = lit(
        toy,
        {"name": "a", "method": "recombine", **more},
        {"name": "b", **more},
        {"name": "c", "environment": 0.5, "camera": camera, "samples": 4},
    )
    np.testing.assert_allclose(summed[8], 0.5, rtol=2e-3)
    np.testing.assert_allclose(traced[8], 0.5, rtol=1e-5)
    assert not none[8].any()


def test_photographs_that_were_left_out_are_known_by_why(tmp_path, monkeypatch):
    from workflow.relighting.check import _left_out

    monkeypatch.chdir(tmp_path)
    Path("results/own/reconstruction").mkdir(parents=True)
    Path("results/own/reconstruction/reconstruction.json").write_text('{"left_out": {"IMG_1.JPG": "alone"}}')
    facts = {"source": "photographs", "dropped_views": {"b": "it sees nothing"}, "left_out_views": {"c": "blurred"}}
    own = {"b": "it sees nothing", "c": "blurred"}
    assert _left_out(SimpleNamespace(facts=facts), "own") == {"IMG_1": "alone", **own}
    assert _left_out(SimpleNamespace(facts=facts | {"source": "folder"}), "own") == own


def test_what_is_known_before_the_jobs_is_told_before_them(toy, monkeypatch):
    """The check that runs while Snakemake plans: it reads finished stages alone."""
    from workflow.relighting import check

    monkeypatch.setattr(check, "finished", lambda stage, *_: StageReader(toy / "results/toy" / stage, stage, "toy"))

    def told(**more):
        with pytest.raises(InputError) as error:
            check.check_relightings({"relight": [entry(**more)]}, "toy", "draft")
        return str(error.value)

    check.check_relightings({"relight": [entry(lamps={"lamp": 0}, materials={"walls": {"metallic": 0}})]}, "toy", "draft")
    named(told(materials={"wals": {"metallic": 0}}), "config/scenes/toy.yaml", "relight.materials", "a", "'wals'", "'walls'")
    named(told(lamps={"lmap": 0}), "relight.lamps", "'lmap'", "'lamp'")
    named(told(camera={"views": ["v7"]}), "relight.camera.views", "v7", "v0, v1")
    with monkeypatch.context() as patched:
        patched.setattr(check, "_left_out", lambda *_: {"v7": "blurred"})
        named(told(camera={"views": ["v7"]}), "v7", "left out", "blurred", "v0, v1")
    far = {"position": [90, 0, 0], "look_at": [0, 0, 0]}
    several = told(lamps={"lmap": 0, "walls": 0}, materials={"wals": {"metallic": 0}}, camera={"poses": [far]}).splitlines()
    assert [line.split(" of a: ")[0] for line in several] == [
        f"config/scenes/toy.yaml: relight.{key}" for key in ("camera.poses.0.position", "lamps", "lamps", "materials")
    ]
    named(several[0], "[90.0, 0.0, 0.0]", "[0.0, 0.0, 0.0]", "[3.0, 2.0, 2.5]")
    monkeypatch.setitem(video.ENCODERS, "av1", "libnothing")
    named(told(camera={"views": ["v0", "v1"], "frames": 2}), "relight.video.codec", "libnothing")
    monkeypatch.setattr(check, "finished", lambda *_: None)  # nothing is known yet, and nothing is refused
    check.check_relightings({"relight": [entry(lamps={"lmap": 0})]}, "toy", "draft")


def test_mistakes_are_blamed_on_the_plan_that_lists_them():
    assert relight_origin("kitchen--relight-evening-s0") == "config/relight/evening.yaml"
    assert relight_origin("kitchen") == "config/scenes/kitchen.yaml"


def test_held_out_photographs_lend_their_camera_but_not_their_exposure(studio):
    from workflow.relighting.camera import photograph_exposure, plan_flight

    views = [replace(view, split="test" if view.name == "v1" else "train") for view in studio.capture.views]
    capture = SimpleNamespace(views=views, used=views[:1], facts={"exposure_estimated": True}, is_hdr=False)
    for estimated, name in ((True, "v0"), (False, "v1")):
        capture.facts["exposure_estimated"] = estimated
        flight = plan_flight(capture, entry(camera={"views": ["v1"]}), studio.up)
        assert flight.view.name == name and (flight.poses[0] == views[1].world_from_camera).all()
    gains = SimpleNamespace(gain=np.array([[0.5, 0.5, 0.5], [1.0, 1.2, 0.8]]))
    assert photograph_exposure(capture, gains, flight.view).tolist() == [1.0, 1.2, 0.8]
    capture.is_hdr = True
    assert photograph_exposure(capture, gains, flight.view) is None
    near = plan_flight(capture, entry(camera={"poses": [{"position": [0.4, 0.4, 1.6], "look_at": [2.2, 1.3, 0.8]}]}), studio.up)
    assert near.view.name == "v0"


def test_frames_that_an_encoder_refuses_are_told(monkeypatch):
    monkeypatch.setitem(video.OPTIONS, "h264", {"preset": "no such preset"})
    with refused("relight.video", "h264", "codec", "video: off"):
        video.encoded([np.zeros((16, 16, 3), np.uint8)], 24, "h264")
