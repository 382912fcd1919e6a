"""Meshes as other programs write them: polygons, relative indices, mixed faces, quantised and instanced glTF, doubled faces."""

import json
import struct

import DracoPy
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from tests.errors import refused
from tests.unit import own_scene as own
from workflow.intake.gltf import plain_glb
from workflow.intake.obj import read_obj
from workflow.intake.ply import read_ply
from workflow.intake.polygons import triangulated
from workflow.sources.folder_scene import mesh


def areas(vertices, faces):
    """(m, 3) normals of triangles, as long as twice their areas."""
    at = np.asarray(vertices)[faces]
    return np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])


def turn(seed):
    """A rotation (3, 3) and a shift (3,)."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q)), rng.normal(size=3) * 10


def triangles(vertices, polygon):
    polygon = np.asarray(polygon)
    return triangulated(np.asarray(vertices, float), [(np.zeros(1, np.int64), polygon[None])])[0]


# ------------------------------------------------------------------------------------------------------------- polygons


@given(
    st.lists(st.floats(0.05, 1.0), min_size=4, max_size=14),
    st.integers(0, 2**31),
    st.booleans(),
)
def test_a_polygon_that_its_middle_sees_keeps_its_area_and_its_side(radii, seed, reverse):
    angle = 2 * np.pi * np.arange(len(radii)) / len(radii)
    flat = np.array(radii)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    q, shift = turn(seed)
    corners = np.pad(flat, ((0, 0), (0, 1))) @ q.T + shift
    order = np.arange(len(radii))[:: -1 if reverse else 1]
    found = triangles(corners, order)
    assert len(found) == len(radii) - 2
    normal = areas(corners, found)
    area = 0.5 * np.sum(flat[:, 0] * np.roll(flat[:, 1], -1) - flat[:, 1] * np.roll(flat[:, 0], -1))
    side = q[:, 2] * (-1 if reverse else 1)
    # No triangle lies outside, which would add area, or is turned over, which would take some away.
    np.testing.assert_allclose(0.5 * np.linalg.norm(normal, axis=1).sum(), area, rtol=1e-6)
    assert (normal @ side >= -1e-9).all()


@pytest.mark.parametrize("first", range(8))
def test_a_doorway_stays_open(first):
    wall = np.array([(0, 0, 0), (1, 0, 0), (1, 0, 2), (2, 0, 2), (2, 0, 0), (3, 0, 0), (3, 0, 2.6), (0, 0, 2.6)], float)
    found = triangles(np.roll(wall, first, 0), np.arange(8))
    assert 0.5 * np.linalg.norm(areas(np.roll(wall, first, 0), found), axis=1).sum() == pytest.approx(3 * 2.6 - 2)


def test_a_doorway_of_quads_stays_open():
    arrow = np.array([(0, 0, 0), (2, -1, 0), (0.5, 0, 0), (2, 1, 0)], float)  # concave at the third corner
    for first in range(4):
        at = np.roll(arrow, first, 0)
        assert 0.5 * np.linalg.norm(areas(at, triangles(at, np.arange(4))), axis=1).sum() == pytest.approx(0.5)


@pytest.mark.parametrize("corners, count", [(10_001, 1), (9_000, 200)])
def test_polygons_that_would_take_minutes_are_refused(tmp_path, corners, count):
    lines = [f"v {x!r} {y!r} 0" for x, y in np.random.default_rng(1).random((corners, 2)).tolist()]
    lines += ["f " + " ".join(map(str, range(1, corners + 1)))] * count
    (tmp_path / "a.obj").write_text("\n".join(lines))
    with refused("a.obj", corners):
        read_obj(tmp_path / "a.obj")


def test_polygons_without_area_do_not_fail():
    line = np.stack([np.arange(6.0)] * 3, 1)
    assert triangles(line, np.arange(6)).shape == (4, 3)
    assert triangles(np.zeros((5, 3)), np.arange(5)).shape == (3, 3)
    assert triangles(np.full((5, 3), np.nan), np.arange(5)).shape == (3, 3)


# ------------------------------------------------------------------------------------------------------------------ OBJ

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    "text",
    [
        SQUARE + "f 1 2 3 4\n",
        SQUARE + "f -4 -3 -2 -1\n",
        SQUARE + "vt 0 0\nvn 0 0 1\nf 1/1/1 2//1 3/1 4\n",
        SQUARE.replace("\n", "\r\n") + "f 1 2 \\\r\n 3 4\r\n",
        SQUARE.replace("0\n", "0 0.5 0.5 0.5\n") + "usemtl a\nf 1 2 3\nusemtl b\nf 1 3 4\n",
        "\t" + SQUARE.replace(" ", "\t") + "f\t1\t2\t3\t4",
        "v 9 9 9\nf 1 1 1\n" + SQUARE + "o second\nf -4 -3 -2 -1\n",
        SQUARE + "f 1 2 3 4\nv 9 9 9\nv 8 8 8\n",
    ],
)
def test_obj_faces(tmp_path, text):
    (tmp_path / "a.obj").write_bytes(text.encode())
    vertices, faces = read_obj(tmp_path / "a.obj")
    normal = areas(vertices, faces)
    np.testing.assert_allclose(normal.sum(0), [0, 0, 2])
    assert np.linalg.norm(normal, axis=1).sum() == pytest.approx(2)


def test_relative_indices_count_from_their_own_line(tmp_path):
    parts, lines, at = own.room_mesh(), [], 0
    for faces in (parts[1][:12], parts[1][12:]):
        vertices = parts[0][faces.min() : faces.max() + 1]
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        lines += ["f " + " ".join(str(int(i) - at - len(vertices)) for i in face) for face in faces]
        at += len(vertices)
    (tmp_path / "a.obj").write_text("\n".join(lines))
    vertices, faces = read_obj(tmp_path / "a.obj")
    np.testing.assert_array_equal(vertices, parts[0])
    np.testing.assert_array_equal(faces, parts[1])


def test_obj_keeps_double_precision(tmp_path):
    (tmp_path / "a.obj").write_text("v 448262.123456 5411932.654321 287\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    np.testing.assert_array_equal(read_obj(tmp_path / "a.obj")[0][0], [448262.123456, 5411932.654321, 287])


@pytest.mark.parametrize("line", ["f 1 2 9", "f 1 2 -9", "f 0 1 2", "f a b c", "f 1 2 3.5", "f 1 2 99999999999999999999"])
def test_faces_of_nothing_are_refused_by_line(tmp_path, line):
    (tmp_path / "a.obj").write_text(SQUARE + line + "\n")
    with refused("a.obj", "line 5"):
        read_obj(tmp_path / "a.obj")


def test_a_vertex_that_is_none_is_refused_by_line(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 x 0\nf 1 1 1\n")
    with refused("a.obj", "line 2"):
        read_obj(tmp_path / "a.obj")


# ------------------------------------------------------------------------------------------------------------------ PLY

MIXED = [(0, 1, 2), (0, 1, 3, 2), (0, 4, 5, 1), (2, 0, 4, 6, 3), (7, 6, 5)]
IDS = [7, 8, 9, -1, 11]


def ply(path, form, polygons=MIXED, ids=IDS, kind="double", count="uchar", before=False):
    vertices, _, _ = own.room_mesh()
    order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    head = ["ply", f"format {form} 1.0", "comment of a test", f"element vertex {len(vertices)}"]
    head += [f"property {kind} {axis}" for axis in "xyz"] + ["property uchar red", f"element face {len(polygons)}"]
    lists, own_id = [f"property list {count} int vertex_indices"], ["property int instance"]
    head += (own_id + lists if before else lists + own_id) if ids else lists
    head += ["element edge 1", "property int vertex1", "end_header"]
    code = {"uchar": "B", "int": "i", "char": "b"}[count]
    if order is None:
        rows = [" ".join(map(repr, v)) + " 9" for v in vertices.tolist()]
        for i, polygon in enumerate(polygons):
            words, tail = [len(polygon), *polygon], [ids[i]] if ids else []
            rows.append(" ".join(map(str, tail + words if before else words + tail)))
        path.write_text("\n".join([*head, *rows, "5"]) + "\n")
        return vertices
    data = b"".join(struct.pack(f"{order}3{'d' if kind == 'double' else 'f'}B", *v, 9) for v in vertices)
    for i, polygon in enumerate(polygons):
        listed = struct.pack(f"{order}{code}{len(polygon)}i", len(polygon), *polygon)
        tail = struct.pack(f"{order}i", ids[i]) if ids else b""
        data += tail + listed if before else listed + tail
    path.write_bytes("\n".join([*head, ""]).encode() + data + struct.pack(f"{order}i", 5))
    return vertices


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("count", ["uchar", "int"])
def test_ply_of_mixed_polygons(tmp_path, form, before, count):
    written = ply(tmp_path / "a.ply", form, before=before, count=count)
    vertices, faces, ids = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(vertices, written)
    assert [sorted(set(faces[ids == i].ravel())) for i in IDS] == [sorted(polygon) for polygon in MIXED]
    np.testing.assert_array_equal(ids, np.repeat(IDS, [len(polygon) - 2 for polygon in MIXED]))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("polygons", [[(0, 1, 2), (5, 4, 7)], [(0, 1, 3, 2), (4, 5, 7, 6)]])
def test_ply_of_equal_polygons(tmp_path, form, polygons):
    written = ply(tmp_path / "a.ply", form, polygons, None, "float")
    vertices, faces, ids = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(vertices, written.astype(np.float32) if form != "ascii" else written)
    assert ids is None and len(faces) == 2 * (len(polygons[0]) - 2)
    assert [set(f.tolist()) <= set(p) for f, p in zip(faces, np.repeat(polygons, len(polygons[0]) - 2, 0), strict=True)]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("polygons", [MIXED, [(0, 1, 2)] * 5])
def test_ply_cut_short_is_refused(tmp_path, form, polygons):
    ply(tmp_path / "a.ply", form, polygons)
    data = (tmp_path / "a.ply").read_bytes()
    for left in (len(data) - 12, len(data) - 40):
        (tmp_path / "a.ply").write_bytes(data[:left])
        with refused("a.ply", "cut short"):
            read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_empty_lists_of_ply(tmp_path, form):
    """A point cloud, and a mesh with an element of lists that has none."""
    written = ply(tmp_path / "a.ply", form, [], None)
    vertices, faces, _ = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(vertices, written)
    assert faces.shape == (0, 3)
    ply(tmp_path / "b.ply", form, MIXED, None)
    data = (
        (tmp_path / "b.ply").read_bytes().replace(b"element edge 1\nproperty int", b"element tristrips 0\nproperty list int int")
    )
    (tmp_path / "b.ply").write_bytes(data)
    assert len(read_ply(tmp_path / "b.ply")[1]) == 9


def test_a_comment_is_no_end_of_the_header(tmp_path):
    ply(tmp_path / "a.ply", "ascii")
    text = (tmp_path / "a.ply").read_text().replace("comment of a test", "comment before end_header")
    (tmp_path / "a.ply").write_text(text)
    assert len(read_ply(tmp_path / "a.ply")[1]) == 9


def test_corners_that_are_no_integers_are_refused(tmp_path):
    ply(tmp_path / "a.ply", "ascii", MIXED, None)
    text = (tmp_path / "a.ply").read_text().replace("\n3 0 1 2\n", "\n3 0 1 2.7\n")
    (tmp_path / "a.ply").write_text(text)
    with refused("a.ply"):
        read_ply(tmp_path / "a.ply")


def test_ply_with_impossible_counts_is_refused(tmp_path):
    ply(tmp_path / "a.ply", "binary_little_endian", [(0, 1, 2), (0, 1, 2, 3)], None, count="char")
    data = bytearray((tmp_path / "a.ply").read_bytes())
    at = data.find(struct.pack("<b4i", 4, 0, 1, 2, 3))
    data[at] = 256 - 3
    (tmp_path / "a.ply").write_bytes(data)
    with refused("a.ply", "cut short"):
        read_ply(tmp_path / "a.ply")
    ply(tmp_path / "b.ply", "ascii", [(0, 1, 99), (0, 1, 2, 3)], None)
    with refused("b.ply", 99):
        read_ply(tmp_path / "b.ply")


# ----------------------------------------------------------------------------------------------------------------- glTF


def glb(path, meshes, nodes, arrays, **more):
    """Write a GLB. arrays: (values, type, normalized, stride) each; meshes: lists of primitives."""
    views, accessors, data = [], [], b""
    for values, normalized, stride in arrays:
        values = np.asarray(values)
        values = values[:, None] if values.ndim == 1 else values
        item = values.dtype.itemsize * values.shape[1]
        rows = [values[i].tobytes().ljust(stride or item, b"\xab") for i in range(len(values))]
        code = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}[values.dtype.name]
        kind = "SCALAR" if values.shape[1] == 1 else f"VEC{values.shape[1]}"
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(b"".join(rows))})
        views[-1] |= {"byteStride": stride} if stride else {}
        accessors.append({"bufferView": len(views) - 1, "componentType": code, "count": len(values), "type": kind})
        accessors[-1] |= {"normalized": True} if normalized else {}
        if values.shape[1] == 3:
            accessors[-1] |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        data += b"".join(rows) + b"\0" * (-len(b"".join(rows)) % 4)
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [i for i, node in enumerate(nodes) if not node.pop("below", False)]}],
        "nodes": nodes,
        "meshes": [{"primitives": own} for own in meshes],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
        **more,
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    parts = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts)
    return path


@pytest.mark.parametrize(
    "kind, normalized, stride",
    [
        (np.int16, True, 8),
        (np.uint16, True, 8),
        (np.int16, False, 8),
        (np.uint16, False, 0),
        (np.int8, True, 4),
        (np.uint8, True, 4),
    ],
)
def test_quantised_positions_are_where_they_were(tmp_path, kind, normalized, stride):
    vertices, faces, _ = own.room_mesh()
    low, size = vertices.min(0), np.ptp(vertices, 0).max()
    most = np.iinfo(kind).max
    lowest = -most if np.issubdtype(kind, np.signedinteger) else 0
    levels = np.rint((vertices - low) / size * (most - lowest) + lowest).astype(kind)
    # x = low + size (q - lowest) / (most - lowest), with q divided by `most` first where the accessor is normalised.
    unit = most if normalized else 1
    scale = size * unit / (most - lowest)
    shift = low - size * lowest / (most - lowest)
    node = {"mesh": 0, "scale": [scale] * 3, "translation": shift.tolist()}
    path = glb(
        tmp_path / "a.glb",
        [[{"attributes": {"POSITION": 0}, "indices": 1}]],
        [node],
        [(levels, normalized, stride), (faces.astype(np.uint16).ravel(), False, 0)],
        extensionsUsed=["KHR_mesh_quantization"],
        extensionsRequired=["KHR_mesh_quantization"],
    )
    found = mesh.load(path, 1.0)
    step = size / (most - lowest)
    np.testing.assert_allclose(np.sort(found.vertices, 0), np.sort(vertices, 0), atol=0.51 * step + 1e-6)
    assert found.faces.shape == faces.shape


def test_a_normalised_integer_is_no_less_than_minus_one(tmp_path):
    corners = np.array([(-128, 0, 0), (-127, 127, 0), (127, 0, 64)], np.int8)
    path = glb(tmp_path / "a.glb", [[{"attributes": {"POSITION": 0}}]], [{"mesh": 0}], [(corners, True, 4)])
    assert mesh.load(path, 1.0).bounds[0, 0] == -1.0


def test_instances_become_objects(tmp_path):
    vertices, faces = own.box((0, 0, 0), (1, 1, 1), inward=False)
    half = np.sqrt(0.5)
    places = {
        "TRANSLATION": np.array([(0, 0, 0), (5, 0, 0), (0, 7, 0)], np.float32),
        "ROTATION": np.array([(0, 0, 0, 1), (0, 0, half, half), (0, 0, 0, 1)], np.float32),
        "SCALE": np.array([(1, 1, 1), (2, 1, 1), (1, 1, 3)], np.float32),
    }
    arrays = [(vertices.astype(np.float32), False, 0), (faces.astype(np.uint16).ravel(), False, 0)]
    arrays += [(values, False, 0) for values in places.values()]
    own_places = {name: 2 + i for i, name in enumerate(places)}
    nodes = [
        {
            "name": "stools",
            "mesh": 0,
            "translation": [0, 0, 10],
            "extensions": {"EXT_mesh_gpu_instancing": {"attributes": own_places}},
        },
        {"name": "box", "mesh": 0},
    ]
    path = glb(tmp_path / "a.glb", [[{"attributes": {"POSITION": 0}, "indices": 1}]], nodes, arrays)
    found = mesh.load(path, 1.0)
    assert sorted(found.names) == ["box", "stools 1", "stools 2", "stools 3"]
    bounds = {}
    for number, name in enumerate(found.names):
        own_vertices = found.vertices[found.faces[found.instance == number]].reshape(-1, 3)
        bounds[name] = np.stack([own_vertices.min(0), own_vertices.max(0)])
    np.testing.assert_allclose(bounds["box"], [(0, 0, 0), (1, 1, 1)], atol=1e-6)
    np.testing.assert_allclose(bounds["stools 1"], [(0, 0, 10), (1, 1, 11)], atol=1e-6)
    np.testing.assert_allclose(bounds["stools 2"], [(4, 0, 10), (5, 2, 11)], atol=1e-6)  # scaled, then turned from x to y
    np.testing.assert_allclose(bounds["stools 3"], [(0, 7, 10), (1, 8, 13)], atol=1e-6)


@pytest.mark.parametrize("mode", [5, 6])
@pytest.mark.parametrize("indexed", [False, True])
def test_fans_and_strips_are_triangles(tmp_path, mode, indexed):
    if mode == 6:  # a hexagon around its first corner
        angle = np.pi / 3 * np.arange(6)
        corners = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    else:  # a ribbon
        corners = np.array([(i // 2, i % 2, 0) for i in range(7)], float)
        corners = corners[:, [1, 0, 2]] * [-1, 1, 1]
    shuffled = np.random.default_rng(4).permutation(len(corners))
    arrays = [(corners.astype(np.float32) if not indexed else corners[shuffled].astype(np.float32), False, 0)]
    primitive = {"attributes": {"POSITION": 0}, "mode": mode}
    if indexed:
        arrays.append((np.argsort(shuffled).astype(np.uint16), False, 0))
        primitive["indices"] = 1
    found = mesh.load(glb(tmp_path / "a.glb", [[primitive]], [{"mesh": 0}], arrays), 1.0)
    normal = areas(found.vertices, found.faces)
    area = 6 * np.sqrt(3) / 4 if mode == 6 else 2.5
    assert 0.5 * np.linalg.norm(normal, axis=1).sum() == pytest.approx(area, rel=1e-6)
    assert (np.sign(normal[:, 2]) == np.sign(normal[0, 2])).all()


def test_sparse_positions(tmp_path):
    corners = np.zeros((4, 3), np.float32)
    moved = np.array([(1, 0, 0), (1, 1, 0), (0, 1, 0)], np.float32)
    arrays = [(corners, False, 0), (np.array([1, 2, 3], np.uint16), False, 0), (moved, False, 0)]
    arrays.append((np.array([0, 1, 2, 0, 2, 3], np.uint16), False, 0))
    path = glb(tmp_path / "a.glb", [[{"attributes": {"POSITION": 0}, "indices": 3}]], [{"mesh": 0}], arrays)
    sparse = {"count": 3, "indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 2}}
    own.rewrite_glb(path, lambda document: document["accessors"][0].update(sparse=sparse))
    found = mesh.load(path, 1.0)
    assert 0.5 * np.linalg.norm(areas(found.vertices, found.faces), axis=1).sum() == pytest.approx(1.0)


def test_draco_is_decoded(tmp_path):
    vertices, faces, _ = own.room_mesh()
    scene = trimesh.Scene(trimesh.Trimesh(vertices, faces, process=False))
    (tmp_path / "a.glb").write_bytes(trimesh.exchange.gltf.export_glb(scene, extension_draco=True))
    assert b"KHR_draco_mesh_compression" in (tmp_path / "a.glb").read_bytes()
    found = mesh.load(tmp_path / "a.glb", 1.0)
    np.testing.assert_allclose(found.bounds, [vertices.min(0), vertices.max(0)], atol=1e-3)
    assert len(found.faces) == len(faces)


def test_a_scan_that_draco_has_made_small_is_decoded(tmp_path):
    """Most have more indices than bytes."""
    x, y = np.meshgrid(np.linspace(0, 4, 120), np.linspace(0, 3, 120))
    z = 0.1 * np.sin(x) * y
    grid = np.arange(120 * 120).reshape(120, 120)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    points = np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32)
    data = DracoPy.encode(points, faces.astype(np.uint32), quantization_bits=11, compression_level=10)
    packed = {"KHR_draco_mesh_compression": {"bufferView": 2, "attributes": {"POSITION": 0}}}
    primitive = {"attributes": {"POSITION": 0}, "indices": 1, "extensions": packed}
    arrays = [(points[:1], False, 0), (np.zeros(1, np.uint32), False, 0), (np.frombuffer(data, np.uint8), False, 0)]
    used = {"extensionsUsed": ["KHR_draco_mesh_compression"], "extensionsRequired": ["KHR_draco_mesh_compression"]}
    path = glb(tmp_path / "a.glb", [[primitive]], [{"mesh": 0}], arrays, **used)

    def without_buffers(document):
        for accessor, count in zip(document["accessors"], (len(points), faces.size), strict=False):
            del accessor["bufferView"]
            accessor["count"] = count
        del document["accessors"][2]

    own.rewrite_glb(path, without_buffers)
    assert path.stat().st_size < faces.size
    found = mesh.load(path, 1.0)
    assert len(found.faces) == len(faces)
    np.testing.assert_allclose(found.bounds, [points.min(0), points.max(0)], atol=4e-3)


def test_buffers_without_a_file_are_refused(tmp_path):
    corners = np.eye(3, dtype=np.float32)
    path = glb(tmp_path / "a.glb", [[{"attributes": {"POSITION": 0}}]], [{"mesh": 0}], [(corners, False, 0)])
    own.rewrite_glb(path, lambda document: document.update(buffers=[{"byteLength": 36}] * 100))
    with refused("a.glb", "buffer 1"):
        mesh.load(path, 1.0)


def test_instances_that_have_other_attributes_alone_stay(tmp_path):
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], np.float32)
    node = {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"_ID": 1}}}}
    arrays = [(corners, False, 0), (np.zeros(1, np.float32), False, 0)]
    path = glb(tmp_path / "a.glb", [[{"attributes": {"POSITION": 0}}]], [node], arrays)
    assert len(mesh.load(path, 1.0).faces) == 1


@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "VENDOR_new_geometry"])
def test_what_an_unknown_extension_would_do_is_refused_by_name(tmp_path, name):
    corners = np.eye(3, dtype=np.float32)
    more = {"extensionsRequired": [name], "extensionsUsed": [name]}
    path = glb(tmp_path / "a.glb", [[{"attributes": {"POSITION": 0}}]], [{"mesh": 0}], [(corners, False, 0)], **more)
    with refused("a.glb", name):
        mesh.load(path, 1.0)


def test_extensions_of_appearance_do_not_matter(tmp_path):
    corners = np.eye(3, dtype=np.float32)
    more = {"extensionsRequired": ["KHR_texture_basisu", "KHR_materials_unlit"]}
    path = glb(tmp_path / "a.glb", [[{"attributes": {"POSITION": 0}}]], [{"mesh": 0}], [(corners, False, 0)], **more)
    assert len(mesh.load(path, 1.0).faces) == 1


def test_a_plain_file_stays_as_it_is(tmp_path):
    vertices, faces, _ = own.room_mesh()
    path = tmp_path / "a.glb"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    before, after = (trimesh.load_scene(file, file_type="glb") for file in (path, trimesh.util.wrap_as_stream(plain_glb(path))))
    np.testing.assert_array_equal(before.to_geometry().vertices, after.to_geometry().vertices)
    np.testing.assert_array_equal(before.to_geometry().faces, after.to_geometry().faces)


@pytest.mark.parametrize("change", [{"byteOffset": 10_000}, {"count": 900}, {"componentType": 1}, {"type": "VEC9"}])
def test_accessors_that_do_not_fit_are_refused(tmp_path, change):
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], np.int16)
    path = glb(tmp_path / "a.glb", [[{"attributes": {"POSITION": 0}}]], [{"mesh": 0}], [(corners, True, 8)])
    own.rewrite_glb(path, lambda document: document["accessors"][0].update(change))
    with refused("a.glb"):
        mesh.load(path, 1.0)


# --------------------------------------------------------------------------------------------- doubled faces, far places


@pytest.mark.parametrize("apart", [False, True])
def test_doubled_faces_are_one(tmp_path, apart):
    vertices, faces, thing = own.room_mesh()
    second = faces[:, ::-1] + (len(vertices) if apart else 0)
    own.save_mesh(
        tmp_path / "a.ply", np.concatenate([vertices] * (1 + apart)), np.concatenate([faces, second]), np.r_[thing, thing]
    )
    found = mesh.load(tmp_path / "a.ply", 1.0)
    assert len(found.faces) == len(faces) and (found.instance == thing).all()
    assert any(str(len(faces)) in note for note in found.notes)


def moved_project(root, offset):
    path = own.project(root)
    document, shots = own.photographed(path, 4)
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(path / "mesh.ply", vertices + offset, faces)
    for entry in document["frames"]:
        matrix = np.array(entry["transform_matrix"])
        matrix[:3, 3] += offset
        entry["transform_matrix"] = matrix.tolist()
    own.write_transforms(path, document)
    return own.run(root, "capture")


def test_a_scene_far_from_zero_is_read_as_if_it_were_near(tmp_path):
    far = np.array([448262.5, 5411932.25, 287.0])
    near, moved = moved_project(tmp_path / "near", np.zeros(3)), moved_project(tmp_path / "far", far)
    origin = np.array(moved.facts["origin"])
    assert near.facts["origin"] == [0, 0, 0] and np.abs(origin - far).max() < 5
    assert any("origin" in note for note in moved.facts["notes"])
    for a, b in zip(near, moved, strict=True):
        np.testing.assert_allclose(a.world_from_camera[:3, 3] + far, b.world_from_camera[:3, 3] + origin, atol=1e-6)
        np.testing.assert_allclose(near.gbuffer(a)[0], moved.gbuffer(b)[0], atol=1e-4)
        np.testing.assert_array_equal(near.gbuffer(a)[1], moved.gbuffer(b)[1])
    assert moved.facts["alignment"]["depth_median_disagreement"] < 0.01
