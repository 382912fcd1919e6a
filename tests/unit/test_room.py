"""room.html without a browser: lamps, texels, packing, and what the vendored program is."""

import base64
import hashlib
import io
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from iif_core.light.base_scene import BaseScene
from iif_core.light.environment import solid_angles
from iif_core.light.light_maps import to_half
from iif_core.numerics.color import luminance
from tests.unit.transport_rooms import box, quad
from workflow.exporters.atlas import UNKNOWN, Atlas, TexturedPart
from workflow.room import build
from workflow.room.light import backdrop, find_lamps, lit_texels, trace_lamps
from workflow.room.pack import array_blob, normals_to_bytes, quantized
from workflow.room.page import NOTES, Page, policy, render_page, three_version
from workflow.room.sources import LIBRARY, VENDORED, VIEWER
from workflow.stages.room import _called


def part(mesh, column, columns, name, object_id, emitter_id=-1, radiance=(0, 0, 0), double_sided=False):
    """A mesh of quads whose charts lie below one another in a column of the atlas, with a margin between them."""
    vertices, faces = mesh
    corners = vertices[faces].reshape(-1, 2, 3, 3)
    count = len(corners)
    split, uv, new = [], [], []
    for number, (first, second) in enumerate(corners):
        four = np.stack([first[0], first[1], first[2], second[2]])
        low = np.array([(column + 0.05) / columns, (number + 0.05) / count])
        size = np.array([0.9 / columns, 0.9 / count])
        uv.append(low + size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]))
        new.append(np.array([[0, 1, 2], [0, 2, 3]]) + 4 * number)
        split.append(four)
    split = np.concatenate(split)
    normals = np.repeat(np.cross(corners[:, 0, 1] - corners[:, 0, 0], corners[:, 0, 2] - corners[:, 0, 0]), 4, 0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    arrays = [a.astype(np.float32) for a in (split, normals, np.concatenate(uv))]
    faces = np.concatenate(new).astype(np.int32)
    return TexturedPart(name, object_id, emitter_id, *arrays, faces, np.float32(radiance), double_sided)


@pytest.fixture
def parts():
    """A room of 3 x 2 x 2.5 m with a block that stands on the floor, and a lamp under the ceiling."""
    return [
        part(box((0, 0, 0), (3, 2, 2.5), inward=True), 0, 3, "shell", 0),
        part(box((1, 0.7, -0.1), (1.6, 1.3, 0.8), inward=False), 1, 3, "block", 1),
        part(quad((1.2, 0.8, 2.4), (0, 0.5, 0), (0.5, 0, 0)), 2, 3, "lamp.emitter0", 2, 0, (8, 4, 2)),
    ]


@pytest.fixture
def surface(parts):
    values = np.float32([[0.6, 0.6, 0.6, 0.9, 0], [0.4, 0.1, 0.1, 0.5, 0], [0, 0, 0, 1, 0]])
    empty = np.zeros((0, 3), np.int32)
    faces = sum(len(one.faces) for one in parts)
    return BaseScene(
        vertices=np.zeros((0, 3)),
        faces=empty,
        object_id=np.zeros(0),
        normals=np.zeros((0, 3)),
        areas=np.zeros(faces),
        n_objects=3,
        cell_edge=0.05,
        cell_origin=np.zeros(3),
        cell_ijk=empty,
        cell_object=np.zeros(0, np.int32),
        cell_values=np.zeros((0, 5), np.float32),
        object_values=values,
    )


def test_every_emitter_is_a_lamp_up_to_sixteen():
    many = [part(quad((0, 0, 2 + i), (0, 1, 0), (1, 0, 0)), i, 20, f"lamp.emitter{i}", i, i) for i in range(20)]
    radiance = np.linspace(1, 20, 20)[:, None] * np.float32([1, 0.5, 0.25])
    names = [f"lamp {i}" for i in range(20)]
    few = find_lamps(many[:3], radiance[:3], np.float32([0.1, 0.2, 0.4]), names)
    assert [one.name for one in few.lamps] == ["lamp 0", "lamp 1", "lamp 2", "light from outside"]
    np.testing.assert_allclose([one.color for one in few.lamps], [[1, 0.5, 0.25]] * 3 + [[0.25, 0.5, 1]])
    np.testing.assert_allclose(few.radiance, radiance[:3, :1].repeat(3, 1), rtol=1e-6)  # white while it is traced
    assert few.environment == 3 and few.surroundings.ravel().tolist() == pytest.approx([0.4] * 3)
    sun = np.float32([[[1, 2, 3], [0, 0, 0]], [[0, 0, 0], [0, 0, 9]]])
    all_of_them = find_lamps(many, radiance, sun, names)
    assert len(all_of_them.lamps) == 16 and all_of_them.environment == 15
    shared = all_of_them.lamps[14]
    assert shared.emitters == tuple(range(6)) and shared.color.tolist() == [1, 0.5, 0.25]
    np.testing.assert_allclose(all_of_them.radiance[:6] * shared.color, radiance[:6], rtol=1e-6)
    np.testing.assert_array_equal(all_of_them.surroundings, sun)
    assert find_lamps([], np.zeros((0, 3)), np.zeros(3), []).lamps == []


def test_panes_of_a_window_are_one_lamp():
    """Two panes of one name, in two colours, and a lamp; one of the panes is dark in another."""
    places = ((0, 0, 1), (0, 1.1, 1), (3, 0, 2))
    many = [part(quad(place, (0, 1, 0), (0, 0, 1)), i, 3, f"pane {i}.emitter{i}", i, i) for i, place in enumerate(places)]
    radiance = np.float32([[1, 2, 3], [4, 4, 4], [1, 1, 1]])
    names = ["window 1", "window 1", "lamp 1"]
    found = find_lamps(many, radiance, np.zeros(3), names)
    assert [(one.name, one.emitters) for one in found.lamps] == [("window 1", (0, 1)), ("lamp 1", (2,))]
    window = found.lamps[0].color
    np.testing.assert_allclose(window, np.array([9, 10, 11]) / 11)  # by power, 2 to 4
    np.testing.assert_allclose(found.radiance[:2] * window, radiance[:2], rtol=1e-6)  # each with its own colour
    dark = find_lamps(many[:1], np.float32([[0, 2, 0]]), np.zeros(3), names)
    np.testing.assert_allclose(dark.radiance[0] * dark.lamps[0].color, [0, 2, 0])
    assert found.of_emitter.tolist() == [0, 0, 1]
    alone = find_lamps(many, radiance * [[0], [1], [1]], np.zeros(3), names)
    assert [one.emitters for one in alone.lamps] == [(1,), (2,)] and alone.of_emitter.tolist() == [-1, 0, 1]


def test_doubtful_lamps_say_so_and_what_nothing_is_known_of_does_not():
    def called(**columns):
        job = SimpleNamespace(read=lambda stage: SimpleNamespace(table=lambda name: {k: np.array(v) for k, v in columns.items()}))
        return _called(job, SimpleNamespace(emitter_names=["window 1", "window 1", "lamp 1", "lamp 2"]))

    assert called(probability=[0.7, 0.7, 0.3, -1.0]) == ["window 1", "window 1", "lamp 1 (doubtful)", "lamp 2"]
    assert called() == ["window 1", "window 1", "lamp 1", "lamp 2"]  # of another solver


def test_what_no_photograph_shows_outside_is_grey():
    sky = np.random.default_rng(0).uniform(0.1, 2.0, (4, 8, 3)).astype(np.float32)
    seen = np.zeros((4, 8), bool)
    seen[1, 2:5] = True
    found = backdrop(sky, seen)
    np.testing.assert_array_equal(found[seen], sky[seen])
    grey = np.unique(found[~seen])
    weights = solid_angles(4, 8)[~seen]
    assert len(grey) == 1 and grey[0] == pytest.approx((luminance(sky[~seen]) * weights).sum() / weights.sum())
    for all_of_it in (None, np.ones((4, 8), bool), np.zeros((1, 1), bool)):  # known, or one radiance for all directions
        assert backdrop(sky, all_of_it) is sky


def test_texels_lie_on_the_surface(parts):
    texels = lit_texels(parts, 64)
    assert (np.diff(texels.index) > 0).all() and set(texels.part) == {0, 1, 2}
    shell = texels.points[texels.part == 0]
    away = np.minimum(np.abs(shell), np.abs(shell - [3, 2, 2.5])).min(1)
    np.testing.assert_allclose(away, 0, atol=1e-5)
    middle = np.array([1.5, 1, 1.25])
    assert (np.einsum("ij,ij->i", texels.normals[texels.part == 0], middle - shell) > 0).all()
    area = 2 * (3 * 2 + 3 * 2.5 + 2 * 2.5)
    assert texels.edge[0] ** 2 * (64 * 64 * 0.81 / 3) == pytest.approx(area, rel=1e-3)


def test_interpolation_finds_light_of_the_same_surface(parts):
    """Every texel around any point of a chart is stored, and most have the light of a texel of the same wall next to them."""
    texels = lit_texels(parts, 64)
    row = np.full(64 * 64, -1)
    row[texels.stored] = texels.source
    assert (np.diff(texels.stored) > 0).all() and np.isin(texels.index, texels.stored).all()
    np.testing.assert_array_equal(texels.index[row[texels.index]], texels.index)
    rng = np.random.default_rng(4)
    for number, one in enumerate(parts):
        face, (a, b) = rng.integers(len(one.faces), size=500), rng.dirichlet([1, 1, 1], 500).T[:2]
        weights = np.stack([a, b, 1 - a - b], 1)
        uv, points, normals = (
            np.einsum("ni,nij->nj", weights, values[one.faces[face]]) for values in (one.uv, one.vertices, one.normals)
        )
        low = np.floor(uv * 64 - 0.5).astype(int)
        for step in np.ndindex(2, 2):
            column, line = np.clip(low + step, 0, 63).T
            source = row[64 * line + column]
            assert (source >= 0).all() and (texels.part[source] == number).all()
            assert (np.einsum("ij,ij->i", texels.normals[source], normals) > 0.99).mean() > 0.95
            away = np.linalg.norm(texels.points[source] - points, axis=1)
            assert np.quantile(away, 0.95) < 4 * texels.edge[number]


def test_charts_narrower_than_a_texel_have_their_own_light(parts):
    """A bevel whose chart lies between the centres of texels, next to the chart of a wall far away."""
    uv = np.float32([[0.501, 0.502], [0.503, 0.502], [0.503, 0.9], [0.501, 0.9]])
    assert not (np.abs(uv[:2, 0] * 64 % 1 - 0.5) < 0.1).any()
    narrow = replace(parts[2], uv=uv, emitter_id=-1)
    wall = replace(parts[2], uv=uv + np.float32([0.02, 0]) * [1, 0] + np.float32([0.3, 0]) * (uv[:, :1] > 0.502), emitter_id=-1)
    wall = replace(wall, vertices=wall.vertices - np.float32([0, 0, 2]))
    texels = lit_texels([narrow, wall], 64)
    assert 0 in texels.part
    height = texels.points[:, 2]
    row = np.full(64 * 64, -1)
    row[texels.stored] = texels.source
    line = np.arange(34, 56)
    source = row[64 * line + int(0.502 * 64)]
    assert (texels.part[source] == 0).all()
    np.testing.assert_allclose(height[source], 2.4, atol=1e-5)


def test_a_lamp_of_a_million_is_stored_and_solids_cast_no_rims(llvm, parts, surface):
    """Light maps are linear in the radiance to the digits of half floats; the floor under the block has the light around it."""
    texels = lit_texels(parts, 64)
    maps = {}
    for strength in (1.0, 1e6 / 8):
        lamp = replace(parts[2], radiance=np.float32([8, 4, 2]) * np.float32(strength))
        lamps = find_lamps([*parts[:2], lamp], lamp.radiance[None], np.zeros(3), ["lamp"])
        light = trace_lamps([*parts[:2], lamp], texels, surface, lamps, 32, 8, 1, denoised=False)
        halves = to_half(light)
        assert np.isfinite(halves.value).all()
        maps[strength] = halves.value.astype(np.float64) * halves.scale[:, None] / strength
    np.testing.assert_allclose(maps[1.0], maps[1e6 / 8], rtol=2e-3, atol=1e-3 * maps[1.0].mean())
    x, y, z = texels.points.T
    below = (texels.part == 0) & (z < 0.01) & (x > 1.05) & (x < 1.55) & (y > 0.75) & (y < 1.25)
    around = (texels.part == 0) & (z < 0.01) & ~((x > 0.95) & (x < 1.65) & (y > 0.65) & (y < 1.35))
    assert below.sum() > 5 and maps[1.0][below].mean() > 0.2 * maps[1.0][around].mean()


def test_no_lamp_is_a_dark_page(parts, surface):
    texels = lit_texels(parts, 32)
    lamps = find_lamps(parts[:2], np.zeros((0, 3)), np.zeros(3), [])
    light = trace_lamps(parts, texels, surface, lamps, 8, 4, 1)
    assert light.shape == (len(texels.index), 0, 3)
    blobs = build.light_blobs(to_half(light), texels)
    assert blobs["light"].components == 0 and blobs["texels"].items >= len(texels.index)


def test_arrays_come_back(tmp_path):
    """Of several types and widths, empty ones too, through a page and the reader of the tests, which shares no code with it."""
    from tests.room_page import read_room

    rng = np.random.default_rng(2)
    arrays = {
        "a": rng.integers(0, 1 << 16, (100, 3)).astype(np.uint16),
        "b": rng.integers(0, 1 << 32, (57, 1)).astype(np.uint32),
        "c": rng.integers(0, 256, (9, 4)).astype(np.uint8),
        "d": np.zeros((5, 0), np.uint16),
    }
    text = render_page(
        Page(
            "<b>",
            "",
            ["</script>"],
            {"lamps": [], "x": "</script><script>alert(1)"},
            {n: array_blob(v) for n, v in arrays.items()},
        )
    )
    (tmp_path / "page.html").write_text(text)
    page = read_room(tmp_path / "page.html")
    for name, values in arrays.items():
        np.testing.assert_array_equal(page.arrays[name].reshape(values.shape), values)
    assert page.document["x"] == "</script><script>alert(1)" and "alert(1)" not in re.sub("\\\\u003cscript>alert", "", text)
    assert "<b>" not in text and text.count("</script>") == len(re.findall("<script", text))


def test_positions_and_normals_keep_their_digits():
    rng = np.random.default_rng(4)
    values = rng.uniform(-3, 7, (1000, 3))
    low, high = values.min(0), values.max(0)
    back = low + quantized(values, low, high) / 65535 * (high - low)
    np.testing.assert_allclose(back, values, atol=0.51 * 10 / 65535)
    normals = values / np.linalg.norm(values, axis=1, keepdims=True)
    np.testing.assert_allclose((normals_to_bytes(normals).astype(float) - 128) / 127, normals, atol=0.5 / 127 + 1e-9)


def test_light_maps_shrink_with_the_number_of_lamps():
    sizes = [build.lightmap_size(768, lamps, 0.6, 25) for lamps in (1, 4, 8, 16)]
    assert sizes == sorted(sizes, reverse=True) and sizes[0] == 768 and sizes[-1] < 768
    for lamps, size in zip((1, 4, 8, 16), sizes, strict=True):
        assert 0.6 * size**2 * lamps * 6 * 0.8 * 4 / 3 <= 12.5e6
    assert build.lightmap_size(64, 1, 0.6, 25) == 64 and build.lightmap_size(768, 16, 0.6, 0.01) == 32


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, 0.6, -0.8)])
def test_the_floor_is_found_and_z_is_up(parts, up):
    turn = np.linalg.qr(np.column_stack([up, np.eye(3)[:, :2]]))[0]
    turn *= np.sign(turn[:, 0] @ up)
    axes = np.stack([turn[:, 1], np.cross(up, turn[:, 1]), np.asarray(up, float)])  # world from room, as rows
    turned = [
        replace(one, vertices=(one.vertices @ axes).astype(np.float32), normals=(one.normals @ axes).astype(np.float32))
        for one in parts
    ]
    cameras = np.array([[0.5, 0.5, 1.5], [2.5, 1.5, 1.4]]) @ axes
    frame = build.frame_of(turned, lit_texels(turned, 64), np.asarray(up, float), cameras)
    np.testing.assert_allclose(frame.turn @ up, [0, 0, 1], atol=1e-6)
    assert frame.floor == pytest.approx(0, abs=1e-4)
    assert frame.high[2] == pytest.approx(2.5, abs=0.1)
    start = build.start_of([], frame)
    assert start["eye"][2] == pytest.approx(build.EYE_HEIGHT, abs=1e-3)


def test_what_a_click_tells():
    columns = {
        "object_id": [0, 1], "name": ["door", "wall"], "model": ["gain", ""], "photographs": [3, None], "pixels": [10, None],
        "area_m2": [1.5, None], "base_colour_hex": ["#102030", "#ffffff"], **{f"base_colour_{c}": [0.2, 0.5] for c in "rgb"},
        **{f"base_colour_{c}_{end}": [v, None] for c in "rgb" for end, v in (("low", 0.1), ("high", 0.3))},
        **{f"{name}{end}": [0.4, None] for name in ("roughness", "metallic") for end in ("", "_low", "_high")},
    }  # fmt: skip
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [0, 0, 3.0]])
    faces, area = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 4], [0, 3, 4]]), np.array([2.0, 2.0, 3.0, 3.0])
    middle = build.middles(vertices, faces, np.array([0, 0, -1, 1]), area)
    assert middle == {0: [1.0, 1.0, 0.0], 1: [0.0, 0.67, 1.0]}
    door, wall = build.object_facts(columns, middle)
    assert (door["middle"], wall["middle"]) == (middle.get(door["id"]), middle.get(wall["id"]))
    assert door["views"] == 3 and door["model"] == "colour by factors" and len(door["numbers"]) == 5
    assert door["numbers"][0] == {"name": "albedo, red", "value": 0.2, "low": 0.1, "high": 0.3}
    assert wall["model"] == "not fitted" and wall["views"] == 0 and wall["numbers"][0]["low"] is None
    assert build.interval("radiance", 1.0, 2.0) == {
        "name": "radiance",
        "value": 1.0,
        "low": 0.0,
        "high": pytest.approx(4.92, abs=0.01),
    }


def test_surface_that_nothing_shows_is_told_apart_without_a_large_uncertainty():
    """What is between seen and unseen surface on the screen is interpolated: red must not rise there, alpha alone may fall."""
    seen = np.zeros((16, 16), bool)
    seen[:, :4] = True
    values = np.where(seen, 0.1, UNKNOWN).astype(np.float32)
    flat = np.full((16, 16), 0.5, np.float32)
    atlas = Atlas(np.full((16, 16, 3), 0.5, np.float32), flat, flat, values, seen, np.ones((16, 16), bool))
    blob = build.picture_blobs(atlas, 16)["surface"]
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(blob.text))))
    assert (picture[..., 0] == round(255 * 0.1 / build.UNCERTAINTY_MOST)).all()
    assert (picture[:, : 4 + build.HOLES, 3] == 255).all() and (picture[:, 4 + build.HOLES :, 3] == 0).all()


def test_three_is_the_file_that_its_readme_names():
    readme, library = VENDORED.read_text(), LIBRARY.read_bytes()
    assert hashlib.sha256(library).hexdigest() in readme
    assert re.fullmatch(r"\d+\.\d+\.\d+", three_version())
    assert (
        "MIT" in (VENDORED.parent / "LICENSE").read_text()
        or "Permission is hereby granted" in (VENDORED.parent / "LICENSE").read_text()
    )
    assert f"three@{three_version()}" in (VENDORED.parent / "bundle.sh").read_text()
    for text in (library.decode(), VIEWER.read_text()):
        assert "</script" not in text and "eval(" not in text and "new Function" not in text


def test_the_policy_has_no_hole():
    text = policy("body {}", ["first", "second"])
    assert "unsafe" not in text and "*" not in text and "http" not in text and text.count("sha256-") == 3
    modes = re.search(r"const MODES = \[(.*?)\]", VIEWER.read_text())[1]
    assert re.findall(r"'(\w+)'", modes) == list(NOTES)
