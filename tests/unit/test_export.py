"""Exporters: other programs read the same geometry, colours and light, on a room of known colours."""

import io
import json
import os
import shutil
import struct
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from iif_core.camera.pinhole import direction_derivatives, look_at, pixel_directions, up_axis
from iif_core.light.base_scene import BaseScene, Light
from iif_core.numerics.color import linear_from_srgb
from iif_core.surface.atlas import nearest_covered, texel_values, unwrap
from iif_core.surface.cells import voxel_indices
from iif_core.surface.lookup import values_at
from iif_core.surface.tangents import vertex_tangents
from iif_core.surface.triangles import face_geometry, vertex_normals
from lab.rooms.shapes import quarter
from tests.browser import missing
from tests.errors import named, refused
from tests.oracles import gltf_viewer
from tests.oracles.blender import read_by_blender, require_bpy
from tests.oracles.exported import maps_of, read_back
from tests.oracles.mitsuba_lobes import metal_reflectance
from workflow.exporters.atlas import (
    Atlas,
    TexturedPart,
    bake,
    base_color_picture,
    encoded,
    joined,
    surface_picture,
    texels_beside,
    texels_of,
)
from workflow.exporters.camera_files import cameras_json
from workflow.exporters.glb import fitting_glb, glb_bytes, rotation_to_y
from workflow.exporters.mitsuba_lobes import METAL
from workflow.exporters.mitsuba_scene import mitsuba_files
from workflow.exporters.normal_map import normal_picture
from workflow.exporters.surface import SeenSurface, build_parts, seen_sides
from workflow.exporters.usd import BASE_COLOR, SURFACE, usd_bytes
from workflow.runtime import native
from workflow.scene.normal_form import View
from workflow.scene.recovered import Recovered

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
    """A 3 x 2 x 2.5 m room (normals outwards), a white box in it and a lamp below the ceiling that shines down; the floor is red
    and blue where photographs show it, in cells of 5 cm."""
    walls = BOX * [3, 2, 2.5]
    box = BOX * 0.5 + [2.0, 1.2, 0.0]
    lamp_quad = np.array([[1.2, 0.8, 2.4], [1.8, 0.8, 2.4], [1.8, 1.4, 2.4], [1.2, 1.4, 2.4]], np.float32)
    vertices = np.concatenate([walls, box, lamp_quad]).astype(np.float32)
    quad = np.array([[0, 2, 1], [0, 3, 2]]) + 16  # right-hand normal points down
    faces = np.concatenate([OUTWARD, OUTWARD + 8, quad]).astype(np.int32)
    object_id = np.repeat([0, 1, 2], [12, 12, 2]).astype(np.int32)
    floor = np.stack(np.meshgrid(np.arange(0.025, 3, 0.05), np.arange(0.025, 2, 0.05), [0.0]), -1).reshape(-1, 3)
    red = (floor[:, 0] < 1.5)[:, None]
    values = np.where(red, [0.6, 0.1, 0.1, 0.8, 0.0], [0.1, 0.1, 0.6, 0.4, 0.0]).astype(np.float32)
    emits = object_id == 2
    emitter = np.where(emits, 0, -1).astype(np.int32)
    origin = np.array([-0.5, -0.5, -0.525])  # the floor lies in the middle of a layer of cells
    surface = BaseScene(
        vertices=vertices,
        faces=faces,
        object_id=object_id,
        **dict(zip(("normals", "areas"), face_geometry(vertices, faces), strict=True)),
        n_objects=3,
        cell_edge=0.05,
        cell_origin=origin,
        cell_ijk=voxel_indices(floor, 0.05, origin),
        cell_object=np.zeros(len(floor), np.int32),
        cell_values=values,
        object_values=np.array([[0.5, 0.5, 0.5, 0.9, 0], [0.8, 0.8, 0.8, 0.3, 0], [0, 0, 0, 1, 0]], np.float32),
    )
    radiance = np.where(emits[:, None], np.float32(lamp), 0).astype(np.float32)
    light = Light(radiance, np.where(emits, lamp_side, 0).astype(np.int8), emits, np.array(environment, np.float32))
    names = ["walls", "white <box>", "lamp"]
    return Recovered(
        surface=surface,
        object_names=names,
        cell_centres=floor.astype(np.float32),
        light=light,
        emitter_id=emitter,
        emitter_radiance=np.array([lamp], np.float32),
        emitter_names=["ceiling light 1"],
        light_scale=1.0,
    )


def seen(scene, front=(0, 50, 0), back=(100, 0, 0)):
    """What photographs taken inside the room show of it: pixels on either side of the faces of each object."""
    own = scene.surface
    counts = (np.asarray(n, np.int64)[own.object_id] for n in (front, back))
    facts = own.vertices, own.faces, own.object_id, scene.object_names, scene.emitter_id, scene.light.side
    return SeenSurface(*facts, *counts)


def parts_of(scene, max_faces=20000, **of_seen):
    return {part.name: part for part in build_parts(seen(scene, **of_seen), max_faces)}


def textured(scene, texels_per_metre=20.0, **of_seen):
    """The parts and the atlas of a scene: 20 texels a metre are one for each cell."""
    parts = list(parts_of(scene, **of_seen).values())
    made = unwrap([(p.vertices, p.faces) for p in parts], np.full(len(parts), texels_per_metre), 1024)
    out = []
    for part, rows, uv, faces in zip(parts, made.source, made.uv, made.faces, strict=True):
        xyz, normals = (a[rows].astype(np.float32) for a in (part.vertices, part.normals))
        radiance = scene.emitter_radiance[part.emitter_id] if part.emitter_id >= 0 else np.zeros(3, np.float32)
        share = scene.surface.transmittance
        opacity = 1 - float(share[part.object_id]) if share is not None else 1.0
        sides = part.double_sided or opacity < 1
        facts = part.name, part.object_id, part.emitter_id, xyz, normals, uv, faces.astype(np.int32)
        out.append(TexturedPart(*facts, radiance, sides, opacity, part.simplified))
    return out, bake(out, scene, np.full(len(scene.cell_centres), 0.02, np.float32), made.size)


UP = np.array([0.0, 0, 1])


def images_of(atlas):
    return {"base_color": encoded(base_color_picture(atlas)), "surface": encoded(surface_picture(atlas))}


def glb_of(scene, views=()):
    parts, atlas = textured(scene)
    return glb_bytes(parts, images_of(atlas), UP, {"scene": "test"}, views)


# ------------------------------------------------------------------------------------------------------------- surface


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
    nobody = parts_of(scene, front=(0, 0, 0), back=(0, 0, 0))
    assert nobody["walls"].double_sided and nobody["white <box>"].double_sided
    sheet = parts_of(scene, front=(100, 50, 0))
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


def test_texels_take_the_colour_of_their_cells():
    parts, atlas = textured(room())
    texels = texels_of(parts, atlas.size)
    flat = {name: getattr(atlas, name).reshape(atlas.size**2, -1)[texels.index] for name in ("base_color", "roughness", "seen")}
    inside = ((texels.points[:, :2] > 0.01) & (texels.points[:, :2] < [2.99, 1.99])).all(1)
    floor = (texels.points[:, 2] < 1e-6) & (texels.normals[:, 2] > 0.9) & inside
    for side, colour, roughness in (
        (texels.points[:, 0] < 1.5, [0.6, 0.1, 0.1], 0.8),
        (texels.points[:, 0] > 1.5, [0.1, 0.1, 0.6], 0.4),
    ):
        own = floor & side
        assert own.sum() > 1000
        np.testing.assert_allclose(flat["base_color"][own], np.tile(colour, (own.sum(), 1)), atol=1e-6)
        np.testing.assert_allclose(flat["roughness"][own], roughness)
        assert flat["seen"][own].all()
    ceiling = texels.points[:, 2] > 2.49  # no cells near: the mean of the object
    np.testing.assert_allclose(flat["base_color"][ceiling], 0.5)
    assert not flat["seen"][ceiling].any()


def test_nothing_black_lies_between_charts():
    """Filters and mip maps mix texels beyond the edge of a chart into it: those have the values of the nearest chart."""
    parts, atlas = textured(room())
    free = ~atlas.covered
    assert 0.1 < free.mean() < 0.9
    emitter, known = np.zeros((2, atlas.size**2), bool)
    texels = texels_of(parts, atlas.size)
    texels = joined(texels, texels_beside(parts, texels)[0])
    emitter[texels.index[np.array([p.emitter_id for p in parts])[texels.part] >= 0]] = True
    known[texels.index] = True
    lit = ~emitter[nearest_covered(known.reshape(atlas.size, atlas.size))]
    assert atlas.base_color[free & lit].min() > 0.09


def test_charts_narrower_than_a_texel_have_their_own_colour():
    """The lamp as a strip of a twentieth of a texel between two rows of centres: around it the atlas is black, as the lamp is."""
    parts, _ = textured(room())
    lamp = next(i for i, one in enumerate(parts) if one.emitter_id >= 0)
    low, high = parts[lamp].uv.min(0), parts[lamp].uv.max(0)
    line = (np.floor(0.5 * (low[1] + high[1]) * 256) + np.float32([0.98, 1.03])) / 256
    narrow = np.where(
        np.arange(2) == 1, line[((parts[lamp].uv[:, 1] > 0.5 * (low[1] + high[1])).astype(int))][:, None], parts[lamp].uv
    )
    parts[lamp] = replace(parts[lamp], uv=narrow.astype(np.float32))
    assert not (texels_of(parts, 256).part == lamp).any()
    beside, inside = texels_beside(parts, texels_of(parts, 256))
    own = beside.index[beside.part == lamp]
    assert len(own) > 2 * 256 * (high[0] - low[0]) - 4 and inside[beside.part == lamp].any()
    atlas = bake(parts, room(), np.zeros(0), 256)
    assert not atlas.base_color.reshape(-1, 3)[own].any()


def test_a_mesh_that_is_too_fine_becomes_simpler_and_keeps_its_colours():
    """The room in small triangles: the flat walls give them up, the lamp keeps its own, and colours stay where they were."""
    scene = room()
    lamp = scene.surface.object_id == 2  # its faces stay as they are
    vertices, fine = scene.surface.vertices, scene.surface.faces[~lamp]
    while len(fine) <= 20000:
        vertices, fine = quarter(vertices, fine)
    faces = np.concatenate([scene.surface.faces[lamp], fine])
    parent = np.r_[np.flatnonzero(lamp), np.repeat(np.flatnonzero(~lamp), len(fine) // (~lamp).sum())]
    surface = replace(
        scene.surface,
        vertices=vertices.astype(np.float32),
        faces=faces.astype(np.int32),
        object_id=scene.surface.object_id[parent],
    )
    own = scene.light
    light = Light(own.radiance[parent], own.side[parent], own.emits[parent], own.environment)
    fine = replace(scene, surface=surface, light=light, emitter_id=scene.emitter_id[parent])
    parts = parts_of(fine, max_faces=2000)
    assert sum(len(p.faces) for p in parts.values()) < 2500
    assert len(parts["lamp.emitter0"].faces) == (surface.object_id == 2).sum() and not parts["lamp.emitter0"].simplified
    walls = parts["walls"]
    assert walls.simplified
    assert face_geometry(walls.vertices, walls.faces)[1].sum() == pytest.approx(37, rel=0.01)
    np.testing.assert_allclose(np.ptp(walls.vertices, axis=0), [3, 2, 2.5], atol=0.02)
    # A simplified mesh is not quite where the cells are; its texels are read on the mesh of the photographs.
    off = [replace(part, vertices=part.vertices + np.float32([0, 0, 0.3])) for part in textured(scene)[0]]
    texels = texels_of(off, 256)
    floor = (texels.points[:, 2] < 0.31) & (texels.normals[:, 2] > 0.9) & (np.abs(texels.points[:, 0] - 1.5) < 1.1)
    floor &= (np.abs(texels.points[:, 0] - 1.5) > 0.1) & (np.abs(texels.points[:, 1] - 1) < 0.6)
    colour = np.where(texels.points[floor, :1] < 1.5, [0.6, 0.1, 0.1], [0.1, 0.1, 0.6])
    uncertainty = np.zeros(len(scene.cell_centres))
    for simplified, most in ((True, 1e-6), (False, np.inf)):
        atlas = bake([replace(part, simplified=simplified) for part in off], fine, uncertainty, 256)
        error = np.abs(atlas.base_color.reshape(-1, 3)[texels.index[floor]] - colour)
        assert error.max() < most and (simplified or error.max() > 0.1)


def test_copies_and_faces_without_area_are_dropped():
    scene = room()
    own = scene.surface
    twice = np.concatenate([own.faces, own.faces[:12, [1, 0, 2]], own.faces[:1, [0, 0, 1]]])
    rows = np.concatenate([np.arange(26), np.arange(12), [0]])
    light = scene.light
    more = replace(
        scene,
        surface=replace(own, faces=twice, object_id=own.object_id[rows]),
        light=Light(light.radiance[rows], light.side[rows], light.emits[rows], light.environment),
        emitter_id=scene.emitter_id[rows],
    )
    assert {name: len(part.faces) for name, part in parts_of(more).items()} == {
        name: len(part.faces) for name, part in parts_of(scene).items()
    }


def test_seen_sides_and_up():
    surface = room().surface
    front, back = seen_sides(surface.vertices, surface.faces, np.array([[0, 0, 12], [-1, 24, 24]]), EYE)
    assert back[0] == 2 and front[0] == 0 and front[24] == 2 and front.sum() + back.sum() == 5
    poses = np.stack([look_at([0, 0, 1], [1, 0.2 * i, 0.8], [0, 0, 1]) for i in range(4)])
    np.testing.assert_array_equal(up_axis(poses), [0, 0, 1])
    poses = np.stack([look_at([0, 0, 1], [1, 0.2 * i, 0.8], [0, 1, 0]) for i in range(4)])
    np.testing.assert_array_equal(up_axis(poses), [0, 1, 0])


def test_mesh_without_surface_is_refused():
    with refused(26, "1e-12"):
        build_parts(replace(seen(room()), vertices=np.zeros((20, 3), np.float32)), 1000)


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
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    dtype = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
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
    used |= set(document.get("extensions", {}))
    if used != set(document.get("extensionsUsed", [])):
        errors.append("extensionsUsed")
    return errors


@pytest.fixture(scope="module")
def glb():
    return glb_of(room(), [view()])


def test_glb_structure(glb):
    assert structural_errors(glb) == []
    document, binary = chunks_of(glb)
    assert [node["name"] for node in document["nodes"]] == ["walls", "white <box>", "lamp.emitter0", "view a", "world"]
    lamp = document["materials"][2]
    assert lamp["emissiveFactor"] == pytest.approx([1, 6 / 9, 3 / 9], abs=1e-5)
    assert lamp["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"] == 9.0
    assert [material["name"] for material in document["materials"]] == ["walls", "white <box>", "lamp.emitter0"]
    assert document["cameras"][0]["perspective"]["aspectRatio"] == pytest.approx(48 / 36)
    assert document["cameras"][0]["perspective"]["yfov"] == pytest.approx(2 * np.arctan(18 / 40))
    assert document["asset"]["extras"] == {"scene": "test"}


def test_structural_check_can_fail(glb):
    document, binary = chunks_of(glb)
    view = document["bufferViews"][document["accessors"][1]["bufferView"]]
    broken = bytearray(glb)
    start = len(glb) - len(binary) + view["byteOffset"]
    broken[start : start + 12] = struct.pack("<3f", 0, 0, 0)
    assert structural_errors(bytes(broken)) == ["walls: normals"]


def test_a_simplified_ball_looks_round_by_its_normal_map(tmp_path):
    """Normals of the map, turned into the world by the frame that viewers use, are those of the fine ball."""
    ball = trimesh.creation.icosphere(5, 0.5)
    count = len(ball.faces)
    empty, values = np.zeros(0, np.int32), np.array([[0.5, 0.5, 0.5, 0.9, 0]], np.float32)
    surface = BaseScene(
        vertices=np.float32(ball.vertices),
        faces=np.int32(ball.faces),
        object_id=np.zeros(count, np.int32),
        **dict(zip(("normals", "areas"), face_geometry(ball.vertices, ball.faces), strict=True)),
        n_objects=1,
        cell_edge=0.05,
        cell_origin=np.full(3, -2.0),
        cell_ijk=np.zeros((0, 3), np.int32),
        cell_object=empty,
        cell_values=np.zeros((0, 5), np.float32),
        object_values=values,
    )
    dark = Light(np.zeros((count, 3), np.float32), np.zeros(count, np.int8), np.zeros(count, bool), np.zeros(3, np.float32))
    scene = Recovered(
        surface=surface,
        object_names=["ball"],
        cell_centres=np.zeros((0, 3), np.float32),
        light=dark,
        emitter_id=np.full(count, -1, np.int32),
        emitter_radiance=np.zeros((0, 3)),
        emitter_names=[],
        light_scale=1.0,
    )
    (coarse,) = build_parts(seen(scene, front=(9,), back=(0,)), 200)
    made = unwrap([(coarse.vertices, coarse.faces)], [200.0], 512)
    xyz, normals = (a[made.source[0]].astype(np.float32) for a in (coarse.vertices, coarse.normals))
    part = TexturedPart("ball", 0, -1, xyz, normals, made.uv[0], made.faces[0].astype(np.int32), np.zeros(3), False, 1.0, True)
    picture = normal_picture([part], scene, made.size)
    texels = texels_of([part], made.size)
    stored = picture.reshape(-1, 3)[texels.index] / 127.5 - 1
    tangent = texel_values(vertex_tangents(xyz, part.faces, part.uv, normals), part.faces, texels.face, texels.barycentric)
    t = tangent[:, :3] - texels.normals * (tangent[:, :3] * texels.normals).sum(1, keepdims=True)
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    b = np.cross(texels.normals, t) * np.sign(tangent[:, 3:])
    found = stored[:, :1] * t + stored[:, 1:2] * b + stored[:, 2:] * texels.normals
    round_ = texels.points / np.linalg.norm(texels.points, axis=1, keepdims=True)
    degrees = [
        np.degrees(np.arccos(np.clip((a * round_).sum(1) / np.linalg.norm(a, axis=1), -1, 1))) for a in (found, texels.normals)
    ]
    assert degrees[0].mean() < 0.7 and degrees[1].mean() > 1.5 * degrees[0].mean()
    atlas = bake([part], scene, np.zeros(0), made.size)
    data, _ = fitting_glb([part], atlas, UP, {}, [], 40.0, picture)
    assert structural_errors(data) == [] and khronos_issues(data, tmp_path) == []
    document, _ = chunks_of(data)
    assert "normalTexture" in document["materials"][0] and "TANGENT" in document["meshes"][0]["primitives"][0]["attributes"]


def test_unlit_glb_has_the_light_in_its_colours_and_lamps_as_points(tmp_path):
    parts, atlas = textured(room())
    picture = np.full((64, 64, 3), 100, np.uint8)
    data = glb_bytes(parts, {"base_color": encoded(picture)}, UP, {}, [view()], exposure=0.05)
    assert structural_errors(data) == [] and khronos_issues(data, tmp_path) == []
    document, _ = chunks_of(data)
    assert set(document["extensionsUsed"]) == {"KHR_lights_punctual", "KHR_materials_unlit"}
    lamp = document["materials"][2]["pbrMetallicRoughness"]["baseColorFactor"]
    assert lamp == pytest.approx([0.45, 0.3, 0.15, 1.0], abs=1e-5)
    (light,) = document["extensions"]["KHR_lights_punctual"]["lights"]
    assert light["intensity"] == pytest.approx(0.05 * 9 * 0.36, rel=1e-5)  # exposed, as the texture is
    assert light["color"] == pytest.approx([1, 6 / 9, 3 / 9], abs=1e-5)
    node = next(node for node in document["nodes"] if "KHR_lights_punctual" in node.get("extensions", {}))
    assert node["translation"] == pytest.approx([1.5, 1.1, 2.4], abs=1e-6)
    assert "KHR_lights_punctual" not in chunks_of(glb_of(room()))[0]["extensionsUsed"]  # its lamps shine as surface


def test_glb_is_the_same_every_time(glb):
    assert glb == glb_of(room(), [view()])


def test_glb_comes_back(glb, tmp_path):
    """trimesh reads the same geometry and, within a quantum of eight bits, the same materials, pixel by pixel."""
    (tmp_path / "scene.glb").write_bytes(glb)
    meshes = read_back(tmp_path / "scene.glb", UP)
    scene = room()
    parts = {part.name: part for part in textured(scene)[0]}
    assert set(meshes) == set(parts)
    extents = trimesh.load(tmp_path / "scene.glb", process=False).extents
    np.testing.assert_allclose(extents, [3, 2.5, 2], atol=1e-5)  # z up became y up
    for name, (xyz, faces, _) in meshes.items():
        np.testing.assert_allclose(xyz, parts[name].vertices, atol=1e-6)
        np.testing.assert_array_equal(faces, parts[name].faces)
    found, hits, of = maps_of(meshes, view())
    objects = np.array([parts[name].object_id for name in meshes])[of]
    own = scene.surface
    grid = own.cell_edge, own.cell_origin, own.cell_ijk, own.cell_object
    wanted, _ = values_at(hits, objects, *grid, own.cell_values, own.object_values)
    error = np.abs(found - wanted)
    # Where red meets blue, or the floor the walls, resampling shifts the border by up to a texel.
    edge = (np.abs(hits[:, 0] - 1.5) < 0.05) | (np.minimum(hits, [3, 2, 9] - hits)[:, :2].min(1) < 0.05)
    assert error[~edge].mean() < 1 / 255 and error[~edge].max() < 0.01
    assert error.mean() < 2 / 255


def test_a_glb_that_must_be_small(glb):
    parts, atlas = textured(room(), 60.0)
    noise = np.random.default_rng(0).uniform(0, 1, (atlas.size, atlas.size, 3)).astype(np.float32)
    noisy = replace(atlas, base_color=noise)
    whole, facts = fitting_glb(parts, noisy, UP, {}, [], 40.0)
    assert facts["format"] == "png" and facts["size"] == atlas.size and facts["fits"]
    smaller, facts = fitting_glb(parts, noisy, UP, {}, [], 0.7 * len(whole) / 1e6)
    assert facts["format"] == "jpeg" and len(smaller) <= 0.7 * len(whole) and facts["fits"]
    smaller, facts = fitting_glb(parts, noisy, UP, {}, [], 0.2 * len(whole) / 1e6)
    assert facts["size"] < atlas.size and len(smaller) <= 0.2 * len(whole)
    assert structural_errors(smaller) == []
    assert not fitting_glb(parts, noisy, UP, {}, [], 1e-4)[1]["fits"]


@pytest.mark.parametrize("side", [1024, 1000])
def test_a_smaller_texture_stays_in_its_place(side):
    """A hill across the atlas has its top at the same texture coordinate, to a fifth of a texel of the whole atlas."""
    parts, _ = textured(room(), 60.0)
    u = (np.arange(side) + 0.5) / side
    hill = np.broadcast_to(np.exp(-0.5 * ((u - 0.37) / 0.03) ** 2).astype(np.float32), (side, side))
    placed = Atlas(np.stack([hill] * 3, -1), hill, hill.T, hill, hill > 0, hill > 0)
    data, facts = fitting_glb(parts, placed, UP, {}, [], 1e-4)
    assert facts["size"] == side // 4
    document, binary = chunks_of(data)
    image = document["bufferViews"][document["images"][1]["bufferView"]]
    start = image["byteOffset"]
    surface = np.asarray(Image.open(io.BytesIO(binary[start : start + image["byteLength"]])), np.float64)
    at = (np.arange(len(surface)) + 0.5) / len(surface)
    for channel, axis in ((1, 0), (2, 1)):  # roughness changes along columns, metallic along rows
        profile = np.maximum(surface[..., channel].mean(axis) - 30, 0)  # JPEG leaves ripples next to the hill
        assert (profile * at).sum() / profile.sum() == pytest.approx(0.37, abs=0.2 / side)


def test_dark_albedo_survives(glb):
    """sRGB keeps relative steps small in the dark: albedo of 0.005 is off by less than 4 %."""
    scene = room()
    dark = replace(
        scene, surface=replace(scene.surface, cell_values=scene.surface.cell_values * np.float32([0.05, 0.05, 0.05, 1, 1]))
    )
    _, atlas = textured(dark)
    back = linear_from_srgb(base_color_picture(atlas).astype(np.float64) / 255)
    lit = atlas.base_color > 0
    assert np.abs(back[lit] / atlas.base_color[lit] - 1).max() < 0.04


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


def khronos_issues(glb, folder):
    """What the validator finds, infos left out."""
    if not (shutil.which("node") and VALIDATOR.is_dir()):
        assert not os.environ.get("CI"), f"continuous integration has node and npm; {VALIDATOR} is missing"
        pytest.skip("needs node and the npm package gltf-validator: make node")
    (folder / "scene.glb").write_bytes(glb)
    command = ["node", "-e", VALIDATE, str(VALIDATOR.resolve()), str(folder / "scene.glb")]
    issues = json.loads(subprocess.run(command, capture_output=True, text=True).stdout)
    return [message for message in issues["messages"] if message["severity"] < 2]


def test_khronos_validator(glb, tmp_path):
    assert khronos_issues(glb, tmp_path) == []


# ------------------------------------------------------------------------------------------------------- other programs


def written_glb(folder, camera):
    """A room, and what trimesh reads of it at the pixels of a camera: values (n, 5), and depth, infinite where nothing is."""
    path = folder / "scene.glb"
    path.write_bytes(glb_of(room(), [camera]))
    values, points, of = maps_of(read_back(path, UP), camera)
    depth = (points - camera.world_from_camera[:3, 3]) @ camera.world_from_camera[:3, 2]
    return path, values, np.where(of >= 0, depth, np.inf)


def same_pixels(found, depth, values, wanted):
    """Almost all pixels show the same surface, and the same material on it."""
    near = np.abs(depth / wanted - 1) < 1e-3
    assert near.mean() > 0.98
    apart = np.abs(found - values)[near].max(1)
    assert (apart < 1.5 / 255).mean() > 0.98 and np.ptp(values[near, 0]) > 0.4  # a texel may fall to a neighbour


def test_blender_reads_what_was_written(tmp_path):
    python = require_bpy()
    camera = view(cx=19.0, cy=21.0)
    path, values, depth = written_glb(tmp_path, camera)
    document = json.loads(cameras_json([camera], ["a.png"], np.ones((1, 3)), UP, None, None))
    read = read_by_blender(python, path, document, ["a"], 120)
    same_pixels(read.values[0], read.depth[0], values, depth)
    assert read.spaces == {"base_color": "sRGB", "surface": "Non-Color"}
    np.testing.assert_allclose(read.emission["lamp.emitter0"], [9, 6, 3], rtol=1e-5)
    found = read.cameras["view a"]
    wide = 2 * np.arctan(0.5 * camera.width / camera.fx), 2 * np.arctan(0.5 * camera.height / camera.fy)
    assert found["angle_y" if found["fit"] == "VERTICAL" else "angle_x"] == pytest.approx(
        wide[found["fit"] == "VERTICAL"], rel=1e-5
    )
    np.testing.assert_allclose(np.array(found["pose"])[:3, 3], camera.world_from_camera[:3, 3], atol=1e-5)  # z is up in both


def test_a_browser_shows_what_was_written(tmp_path):
    if not gltf_viewer.available():
        missing("no Chromium, or no three.js, which `make node` installs")
    camera = view(cx=19.0, cy=21.0)
    path, values, depth = written_glb(tmp_path, camera)
    with ThreadPoolExecutor(1) as other:  # Playwright wants a thread for itself, and other tests keep a browser open in this one
        opened = other.submit(gltf_viewer.open_in_browser, path, [camera]).result()
    assert opened.complaints == [] and all(name == "" or name.startswith(("three/", "scene.glb")) for name in opened.requests)
    same_pixels(opened.values[0], opened.depth[0], values, depth)
    assert opened.facts["lamps"].keys() == {"lamp.emitter0"} and opened.facts["cameras"] == 1
    np.testing.assert_allclose(opened.facts["lamps"]["lamp.emitter0"], [9, 6, 3], rtol=1e-5)
    picture = np.asarray(Image.open(io.BytesIO(opened.picture)).convert("RGB"))
    assert picture.shape == (camera.height, camera.width, 3) and picture.std() > 20


# ----------------------------------------------------------------------------------------------------------------- usd


@pytest.fixture(scope="module")
def usd(tmp_path_factory):
    from pxr import Usd

    folder = tmp_path_factory.mktemp("usd")
    parts, atlas = textured(room(environment=(0.1, 0.2, 0.4)))
    camera = view(cx=19.0, cy=21.0, name="a-1")
    (folder / "scene.usdc").write_bytes(usd_bytes(parts, UP, np.array([0.1, 0.2, 0.4]), [camera], {"scene": "test"}))
    for name, data in zip((BASE_COLOR, SURFACE), images_of(atlas).values(), strict=True):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
    return Usd.Stage.Open(str(folder / "scene.usdc")), parts, camera


def test_usd_is_valid(usd):
    """The validators behind `usdchecker` find nothing."""
    from pxr import UsdValidation

    registry = UsdValidation.ValidationRegistry()
    errors = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators()).Validate(usd[0])
    assert [(str(error.GetName()), error.GetMessage()) for error in errors] == []


def test_usd_comes_back(usd):
    from pxr import Usd, UsdGeom, UsdLux, UsdShade

    stage, parts, camera = usd
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.GetStageUpAxis(stage) == "Y"
    meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    assert [prim.GetDisplayName() for prim in meshes] == [part.name for part in parts]
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(meshes[0]).ComputeAlignedRange()
    np.testing.assert_allclose(box.GetSize(), [3, 2.5, 2], atol=1e-5)
    for prim, part in zip(meshes, parts, strict=True):
        mesh, material = UsdGeom.Mesh(prim), UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        np.testing.assert_allclose(mesh.GetPointsAttr().Get(), part.vertices)
        np.testing.assert_array_equal(np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)), part.faces)
        shader = material.ComputeSurfaceSource()[0]
        if part.emitter_id >= 0:
            assert prim.HasAPI(UsdLux.MeshLightAPI)
            np.testing.assert_allclose(shader.GetInput("emissiveColor").Get(), part.radiance)
        else:
            st = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get()
            np.testing.assert_allclose(np.asarray(st)[:, 1], 1 - part.uv[:, 1])
            source = shader.GetInput("diffuseColor").GetConnectedSources()[0][0].source
            assert Path(UsdShade.Shader(source).GetInput("file").Get().resolvedPath).is_file()
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/world/environment"))
    np.testing.assert_allclose(np.multiply(dome.GetColorAttr().Get(), dome.GetIntensityAttr().Get()), [0.1, 0.2, 0.4], rtol=1e-6)


def test_usd_camera_sees_what_the_photograph_sees(usd):
    """A point of the room falls on the same pixel, also with the principal point off centre."""
    from pxr import Gf, Usd, UsdGeom

    stage, _, camera = usd
    prim = next(prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera))
    frustum = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default()).frustum
    to_clip = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    root = UsdGeom.Xformable(stage.GetPrimAtPath("/world")).GetLocalTransformation()
    for point in ([2.0, 1.2, 0.5], [1.5, 1.1, 2.4], [0.9, 1.5, 0.1]):
        x, y, z = np.linalg.inv(camera.world_from_camera)[:3] @ [*point, 1]
        pixel = [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]
        clip = to_clip.Transform(root.Transform(Gf.Vec3d(*point)))
        found = [(clip[0] + 1) / 2 * camera.width, (1 - clip[1]) / 2 * camera.height]
        np.testing.assert_allclose(found, pixel, atol=1e-3)


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
    files = mitsuba_files(*textured(room()), [view(), view(name="b & c")], np.array([0.1, 0, 0]))
    text = files["scene.xml"].decode()
    tree = ElementTree.fromstring(text)
    names = [node.get("value") for node in tree.iter("string") if node.get("name") == "filename"]
    textures = [f"textures/{name}.exr" for name in ("albedo", "roughness", "metallic", "diffuse", "specular")]
    assert names == [*textures, "meshes/walls.ply", "meshes/white_box.ply", "meshes/lamp.emitter0.ply"]
    program = {"render.py", *(f"iif_bsdf/{name}.py" for name in ("__init__", "xp", "brdf", "mitsuba_bsdf"))}
    assert set(names) | {"scene.xml"} | program == set(files)
    assert [node.get("id") for node in tree.iter("sensor")] == ["view-a", "view-b & c"]
    assert [node.get("type") for node in tree.iter("emitter")] == ["area", "constant"]
    assert "0.04" in text and "principled" in text


def test_names_that_clash_on_disk():
    parts, atlas = textured(room())
    renamed = [replace(part, name=name) for part, name in zip(parts, ["A/b", "a b", "..."], strict=True)]
    files = mitsuba_files(renamed, atlas, [view()], np.zeros(3))
    lower = [name.lower() for name in files if name.startswith(("scene", "meshes"))]
    assert len(set(lower)) == len(lower) == 4
    assert all(".." not in name for name in files)


def own_render(scene, camera, samples):
    """The same scene in the workflow's renderer."""
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene

    geometry, material = scene.surface.traceable(scene.light.emits)
    pose = camera.world_from_camera
    rays = pixel_directions(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, pose)
    jitter = direction_derivatives(camera.fx, camera.fy, pose)
    world = Scene(geometry, material, scene.light.emitters(geometry))
    image = render(world, pose[:3, 3], rays.reshape(-1, 3), PathOptions(samples, 8, 1), jitter)
    return image.reshape(camera.height, camera.width, 3)


def test_the_table_of_mitsubas_metal_is_what_the_plug_in_gives(mi):
    np.testing.assert_allclose(METAL, metal_reflectance(), rtol=1e-5)


def test_mitsuba_renders_what_we_render(mi, tmp_path, monkeypatch):
    scene, camera = room(), view(cx=19.0, cy=21.0)
    path = written(tmp_path / "out", mitsuba_files(*textured(scene), [camera], np.zeros(3)))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    theirs = np.array(mi.render(mi.load_file(str(path)), spp=128, seed=1))[..., :3]
    ours = own_render(scene, camera, 128)
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
    scene, camera = room(), view()
    folder = written(tmp_path / "out", mitsuba_files(*textured(scene), [camera], np.zeros(3))).parent
    programs = [*folder.glob("iif_bsdf/*.py"), folder / "render.py"]
    assert not any(
        line.startswith(("from iif_core", "from workflow")) for file in programs for line in file.read_text().splitlines()
    )
    one_core = ["taskset", "-c", str(min(os.sched_getaffinity(0)))]  # with a thread for each core, Mitsuba would wait for ever
    command = [*one_core, sys.executable, str(folder / "render.py"), "--samples", "512", "--output", str(tmp_path / "room.exr")]
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=tmp_path, env=clean, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stderr.splitlines() if "samples a pixel" in line][
        -1
    ] == "512 of 512 samples a pixel, about 0 s left"
    theirs, ours = np.array(mi.Bitmap(str(tmp_path / "room.exr")))[..., :3], own_render(scene, camera, 512)
    assert theirs.mean() == pytest.approx(ours.mean(), rel=0.01)
    assert np.median(np.abs(theirs / ours - 1)) < 0.05
    wrong = subprocess.run([*command, "--view", "z"], cwd=tmp_path, env=clean, capture_output=True, text=True, timeout=120)
    assert wrong.returncode == 2
    named(wrong.stderr, "view z", "a")


def test_mitsuba_shades_flat_faces_as_we_do(mi, tmp_path):
    """A ball of few faces, whose vertices have the normals of a round one: shaded by those it would reflect less in all."""
    parts, atlas = textured(room())
    ball = trimesh.creation.icosphere(1, 0.4)
    round_normals = np.float32(ball.vertices / 0.4)
    points, faces = np.float32(ball.vertices), np.int32(ball.faces)
    uv = np.zeros((len(points), 2), np.float32)
    part = replace(parts[0], vertices=points, normals=round_normals, uv=uv, faces=faces)
    loaded = mi.load_file(str(written(tmp_path, mitsuba_files([part], atlas, [view()], np.zeros(3)))))
    x, y = (a.ravel() for a in np.mgrid[-0.2:0.2:20j, -0.2:0.2:20j].astype(np.float32))
    si = loaded.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 1.0), mi.Vector3f(0, 0, -1)))
    shading, place = np.array(si.sh_frame.n).T, np.array(si.p).T
    np.testing.assert_allclose(shading, np.array(si.n).T, atol=1e-5)
    assert np.abs(shading - place / 0.4).max() > 0.1


def test_slivers_are_no_hole_and_no_nan(mi, tmp_path):
    """On a face of 6 m x 1 mm Mitsuba's interpolation of attributes gives NaN; textures are read without it."""
    parts, atlas = textured(room())
    walls = parts[0]
    first = len(walls.vertices)
    thin = np.array([[0.3, 1.0, 1.0], [3.7, 1.0, 1.0], [2.0, 1.0, 1.0004]], np.float32)
    part = replace(
        walls,
        vertices=np.concatenate([walls.vertices, thin]),
        normals=np.concatenate([walls.normals, np.float32([[0, -1, 0]] * 3)]),
        uv=np.concatenate([walls.uv, walls.uv[:3]]),
        faces=np.r_[walls.faces, [[first, first + 1, first + 2]]].astype(np.int32),
    )
    loaded = mi.load_file(str(written(tmp_path, mitsuba_files([part], atlas, [view()], np.zeros(3)))))
    x = np.linspace(0.5, 3.5, 1000).astype(np.float32)
    si = loaded.ray_intersect(mi.Ray3f(mi.Point3f(x, 0.5, 1.00005), mi.Vector3f(0, 1, 0)))
    assert (np.abs(np.array(si.t) - 0.5) < 1e-4).mean() > 0.5
    assert np.isfinite(np.array(si.bsdf().eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1)))).all()


def test_surface_that_lets_light_through(mi, tmp_path):
    """The box lets half of the light through: in Mitsuba's renderer as in ours, and as alpha in glTF."""
    scene = room()
    scene = replace(scene, surface=replace(scene.surface, transmittance=np.array([0, 0.5, 0], np.float32)))
    parts, atlas = textured(scene)
    assert {part.name: part.opacity for part in parts if part.opacity < 1} == {"white <box>": 0.5}
    assert parts[1].double_sided
    camera = view(cx=19.0, cy=21.0)
    loaded = mi.load_file(str(written(tmp_path / "out", mitsuba_files(parts, atlas, [camera], np.zeros(3)))))
    theirs, ours = np.array(mi.render(loaded, spp=256, seed=1))[..., :3], own_render(scene, camera, 256)
    solid = own_render(room(), camera, 256)
    on_box = np.abs(ours - solid).mean(-1) > 0.15 * solid.mean()
    assert on_box.mean() > 0.02
    assert theirs[on_box].mean() == pytest.approx(ours[on_box].mean(), rel=0.05)
    document, _ = chunks_of(glb_bytes(parts, images_of(atlas), UP, {}))
    alphas = {m["name"]: (m.get("alphaMode"), m["pbrMetallicRoughness"]["baseColorFactor"][3]) for m in document["materials"]}
    assert alphas["white <box>"] == ("BLEND", 0.5) and alphas["walls"] == (None, 1.0)


def test_mitsuba_emitters(mi, tmp_path):
    """A lamp seen head-on has the radiance that was given; one that shines both ways does so from both sides."""
    files = mitsuba_files(*textured(room(lamp_side=0)), [view()], np.zeros(3))
    path = written(tmp_path, files)
    assert "meshes/lamp.emitter0.back.ply" in files
    scene = mi.load_file(str(path))
    rays = mi.Ray3f(mi.Point3f([1.5, 1.5], [1.1, 1.1], [1.0, 2.45]), mi.Vector3f([0, 0], [0, 0], [1, -1]))
    hit = scene.ray_intersect(rays)
    seen = np.array(hit.emitter(scene).eval(hit)).T
    np.testing.assert_allclose(seen, np.tile([9, 6, 3], (2, 1)), rtol=1e-5)
    gloss = np.array(hit.bsdf().eval(mi.BSDFContext(), hit, mi.Vector3f(0.6, 0, 0.8)))
    assert (gloss > 1e-4).all() and (gloss < 0.02).all()  # black, and as glossy as the workflow's renderer has it


def test_mitsuba_environment(mi, tmp_path):
    parts, atlas = textured(room())
    parts = [part for part in parts if part.name.startswith("white")]
    scene = mi.load_file(str(written(tmp_path, mitsuba_files(parts, atlas, [view()], np.array([0.5, 1.0, 2.0])))))
    image = np.array(mi.render(scene, spp=4))
    np.testing.assert_allclose(image[0, 0, :3], [0.5, 1.0, 2.0], rtol=1e-4)


def test_mitsuba_environment_map_keeps_its_directions(mi, tmp_path):
    import drjit as dr

    from iif_core.light.environment import direction_in
    from iif_core.numerics.xp import NUMPY

    sky = np.random.default_rng(0).uniform(0, 1, (16, 32, 3)).astype(np.float32)
    parts, atlas = textured(room())
    parts = [part for part in parts if part.name.startswith("white")]
    scene = mi.load_file(str(written(tmp_path, mitsuba_files(parts, atlas, [view()], sky))))
    row, column = np.indices((16, 32))
    for u in ((0.5, 0.5), (0.2, 0.8)):
        toward = np.stack(direction_in(NUMPY, row, column, *u, 16, 32), -1).reshape(-1, 3)
        escaped = dr.zeros(mi.SurfaceInteraction3f, len(toward))
        escaped.wi = mi.Vector3f(-toward.T.astype(np.float32))
        seen = scene.environment().eval(escaped).numpy().T.reshape(16, 32, 3)
        np.testing.assert_allclose(seen, sky, atol=1e-5)
