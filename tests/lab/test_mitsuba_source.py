"""Source `mitsuba`: files of a scene, mesh and orientation, material truth, camera path, rendering, bytes."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from lab.mitsuba_scene import document
from lab.sources import mitsuba as source
from tests.errors import refused
from tests.unit import own_scene as own

ROOT = Path(__file__).resolve().parents[2]
SENSOR = """<sensor type="perspective"><float name="fov" value="70"/>
  <transform name="to_world"><lookat origin="{0}" target="{1}" up="0,0,1"/></transform>
  <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/>
  <rfilter type="box"/></film></sensor>"""


def write(folder: Path, body: str, sensor: str | None = None, name: str = "scene.xml") -> Path:
    sensor = SENSOR.format("1,1,1.5", "3,2,1.2") if sensor is None else sensor
    path = folder / name
    path.write_text(f'<?xml version="1.0"?>\n<scene version="3.0.0">\n{sensor}\n{body}\n</scene>\n')
    return path


def box(low: tuple, high: tuple, bsdf: str = "") -> str:
    """A cube whose front is its inside."""
    size = [(b - a) / 2 for a, b in zip(low, high, strict=True)]
    centre = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    return f"""<shape type="cube" id="box"><boolean name="flip_normals" value="true"/>
      <transform name="to_world"><scale x="{size[0]}" y="{size[1]}" z="{size[2]}"/>
      <translate x="{centre[0]}" y="{centre[1]}" z="{centre[2]}"/></transform>{bsdf}</shape>"""


LAMP = """<shape type="rectangle" id="lamp"><boolean name="flip_normals" value="true"/>
  <transform name="to_world"><scale value="0.4"/><translate x="2" y="1.5" z="2.45"/></transform>
  <bsdf type="diffuse"><rgb name="reflectance" value="0,0,0"/></bsdf>
  <emitter type="area"><rgb name="radiance" value="5,4,3"/></emitter></shape>"""

ROOM = box((0, 0, 0), (4, 3, 2.5), '<bsdf type="twosided"><bsdf type="diffuse" id="walls"/></bsdf>') + LAMP


@pytest.fixture
def load(llvm, tmp_path):
    """`load(body)` -> (LoadedScene, FlatMesh, MaterialTable)."""
    from lab.mitsuba_scene import flatten, materials, scene

    def run(body: str, sensor: str | None = None):
        loaded = scene.load(write(tmp_path, body, sensor))
        mesh = flatten.flatten(loaded)
        return loaded, mesh, materials.MaterialTable(mesh.shapes)

    return run


def normals_of(mesh) -> tuple[np.ndarray, np.ndarray]:
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return corners.mean(1), normal / np.linalg.norm(normal, axis=1, keepdims=True)


# ------------------------------------------------------------------------------------------------------ document


def test_files_of_a_scene(tmp_path):
    for name in ("a.ply", "deep.ply"):
        own.save_mesh(tmp_path / name, *own.room_mesh()[:2])
    own.save_png(tmp_path / "tex.png", np.zeros((2, 2, 3)))
    (tmp_path / "part.xml").write_text(
        '<scene version="3.0.0"><shape type="ply"><string name="filename" value="deep.ply"/></shape></scene>'
    )
    body = """<default name="mesh" value="a"/><include filename="part.xml"/>
      <shape type="ply"><string name="filename" value="$mesh.ply"/></shape>
      <texture type="bitmap" id="t"><string name="filename" value="tex.png"/></texture>"""
    xml = write(tmp_path, body)
    found = source.raw_inputs({"source": {"kind": "mitsuba", "path": str(xml)}})
    assert found == sorted(tmp_path / name for name in ("a.ply", "part.xml", "tex.png", "deep.ply", "scene.xml"))


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (None, ["data/"]),
        ("<scene version='3.0.0'>\n<shape>\n</scene>", ["line 3, column 3", "XML"]),
        ("<mesh/>", ["<mesh>", "<scene version='3.0.0'>"]),
        ("<scene version='3.0.0'><shape type='cube'/></scene>", ["<sensor>"]),
        ("<scene version='3.0.0'><sensor type='perspective'/></scene>", ["<shape>"]),
    ],
)
def test_unusable_documents(tmp_path, content, names):
    path = tmp_path / "scene.xml"
    if content is not None:
        path.write_text(content)
    with refused(path, *names):
        document.referenced_files(path)


def test_missing_files_are_named_together(tmp_path):
    body = """<shape type="ply"><string name="filename" value="meshes/one.ply"/></shape>
      <texture type="bitmap"><string name="filename" value="textures/two.png"/></texture>"""
    with refused("scene.xml", 2, "meshes/one.ply, textures/two.png"):
        document.referenced_files(write(tmp_path, body))


def test_a_file_that_includes_itself_is_refused(tmp_path):
    with refused("scene.xml", "<include>", 16):
        document.referenced_files(write(tmp_path, '<include filename="scene.xml"/>'))


def test_a_file_on_which_mitsuba_crashes_is_refused_by_name(tmp_path):
    from lab.mitsuba_scene import trial

    trial.check(write(tmp_path, '<shape type="cube"/>'), "scalar_rgb")
    bad = write(tmp_path, '<texture type="bitmap" id="t"/>')
    with refused(bad, "SIGSEGV", "mitsuba"):
        trial.check(bad, "scalar_rgb")
    with refused(bad, kind=MemoryError):
        trial.judge(bad, -signal.SIGKILL)  # as by the kernel, where memory runs out


def test_what_mitsuba_refuses_is_said_in_its_words(llvm, tmp_path):
    from lab.mitsuba_scene import scene

    with refused("scene.xml", "nosuchbsdf"):
        scene.load(write(tmp_path, '<shape type="cube"><bsdf type="nosuchbsdf"/></shape>'))


# ---------------------------------------------------------------------------------------------------------- mesh


@pytest.mark.parametrize("plugin", ["rectangle", "disk", "sphere", "cylinder", "cube"])
@pytest.mark.parametrize("flip", ["false", "true"])
@pytest.mark.parametrize("scale", ["1,1,1", "-1,1,1", "1,1,-1"])
def test_the_right_hand_normal_is_the_side_that_shines(load, plugin, flip, scale):
    import mitsuba as mi

    x, y, z = scale.split(",")
    body = f"""<shape type="{plugin}"><boolean name="flip_normals" value="{flip}"/>
      <transform name="to_world"><scale x="{x}" y="{y}" z="{z}"/><rotate x="1" angle="30"/><rotate y="1" angle="50"/>
      <translate x="1" y="2" z="3"/></transform>
      <emitter type="area"><rgb name="radiance" value="1,2,3"/></emitter></shape>"""
    loaded, mesh, _ = load(body)
    centre, normal = normals_of(mesh)
    light = loaded.scene.shapes()[0].emitter()
    for side, expected in ((1, [1, 2, 3]), (-1, [0, 0, 0])):
        origin, toward = centre + 0.3 * side * normal, -side * normal
        ray = mi.Ray3f(*(t(*v.T.astype(np.float32)) for t, v in ((mi.Point3f, origin), (mi.Vector3f, toward))))
        si = loaded.scene.ray_intersect(ray)
        assert np.allclose(np.array(si.t), 0.3, atol=0.02)
        assert np.allclose(np.array(light.eval(si)).T, expected)
        assert np.allclose(np.array(si.uv).T, mesh.uv.mean(1), atol=0.02)
    assert np.array_equal(mesh.emission, np.broadcast_to(np.float32([1, 2, 3]), mesh.emission.shape))


@pytest.mark.parametrize(
    ("plugin", "area", "closed"),
    [("sphere", 4 * np.pi, True), ("cylinder", 2 * np.pi, False), ("disk", np.pi, False), ("rectangle", 4, False)],
)
def test_tessellation_has_the_shapes_area_and_no_open_seams(load, plugin, area, closed):
    _, mesh, _ = load(f'<shape type="{plugin}"/>')
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(area, rel=4e-3)
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    uses = np.unique(edges, axis=0, return_counts=True)[1]
    assert set(uses) == ({2} if closed else {1, 2})


def test_groups_names_and_duplicates(load):
    body = """<shape type="shapegroup" id="g"><shape type="cube" id="a"><bsdf type="diffuse" id="m"/></shape></shape>
      <shape type="instance"><ref id="g"/><transform name="to_world"><translate x="5"/></transform></shape>
      <shape type="instance"><ref id="g"/><transform name="to_world"><scale x="-2" y="1" z="1"/></transform></shape>
      <shape type="rectangle" id="r"/><shape type="rectangle" id="again"/>"""
    _, mesh, _ = load(body)
    assert sorted(shape.name for shape in mesh.shapes) == ["again", "m/a", "m/a#2", "r"]
    assert len(mesh.faces) == 12 + 12 + 2
    assert any("2 faces over the same three vertices" in note for note in mesh.notes)
    for name, low, high in (("m/a", 4, 6), ("m/a#2", -2, 2)):
        index = [shape.name for shape in mesh.shapes].index(name)
        x = mesh.vertices[mesh.faces[mesh.shape == index]][..., 0]
        assert (x.min(), x.max()) == (low, high)
        centre, normal = normals_of(mesh)
        own = mesh.shape == index
        middle = np.array([(low + high) / 2, 0, 0])
        assert ((centre[own] - middle) * normal[own]).sum(1).min() > 0  # outwards, mirrored or not


def test_of_coinciding_faces_the_light_stays(load):
    lamp = '<shape type="rectangle"><emitter type="area"><rgb name="radiance" value="1,1,1"/></emitter></shape>'
    _, mesh, _ = load('<shape type="rectangle"/>' + lamp)
    assert len(mesh.faces) == 2 and mesh.emission.all()


def test_degenerate_faces_are_left_out_and_counted(load, tmp_path):
    (tmp_path / "bad.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nf 1 2 3\nf 1 2 4\nf 1 1 2\n")
    _, mesh, _ = load('<shape type="obj"><string name="filename" value="bad.obj"/></shape>')
    assert len(mesh.faces) == 1
    assert "2 faces without area left out" in mesh.notes


def test_equal_rows_are_found_also_when_hashes_collide():
    from lab.mitsuba_scene.flatten import first_of_equal

    rng = np.random.default_rng(0)
    rows = rng.integers(0, 4, (500, 3)).astype(np.int32)
    first = first_of_equal(rows)
    for i, row in enumerate(rows):
        assert first[i] == np.flatnonzero((rows == row).all(1))[0]
    assert len(first_of_equal(np.zeros((0, 3), np.float32))) == 0


def test_a_textured_light_is_averaged_over_its_faces(load, tmp_path):
    import mitsuba as mi

    picture = np.zeros((2, 2, 3), np.float32)
    picture[:, 1] = 4
    mi.Bitmap(picture).write(str(tmp_path / "glow.exr"))
    body = """<shape type="rectangle"><emitter type="area"><texture name="radiance" type="bitmap">
      <string name="filename" value="glow.exr"/><string name="filter_type" value="nearest"/></texture>
      </emitter></shape>"""
    _, mesh, _ = load(body)
    centre, _ = normals_of(mesh)
    assert len(mesh.faces) == 2 * 16 * 16
    assert np.allclose(mesh.emission[centre[:, 0] > 0.0], 4) and np.allclose(mesh.emission[centre[:, 0] < 0.0], 0)


def test_exr_textures_load_in_a_job_of_one_thread_on_one_core(tmp_path):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.ones((64, 32, 3), np.float32)}) as picture:
        picture.write(str(tmp_path / "sky.exr"))
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><shape type="rectangle"/>'
        '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter></scene>'
    )
    program = (
        "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])\n"
        "from pathlib import Path; from workflow.runtime import native; native.prepare(); native.limit_threads(1)\n"
        "import drjit, mitsuba; mitsuba.set_variant('llvm_ad_rgb')\n"
        "from lab.mitsuba_scene import scene, trial\n"
        "trial.check(Path('scene.xml'), 'llvm_ad_rgb')\n"
        "assert scene.load(Path('scene.xml')).scene.environment() is not None\n"
        "assert drjit.thread_count() == 1"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=environment, timeout=60, check=True)


def test_a_scene_without_triangles_is_refused(load):
    with refused("ply", "rectangle", "sphere"):
        load('<shape type="shapegroup" id="unused"><shape type="cube"/></shape>')


# ----------------------------------------------------------------------------------------------------- materials


def material_of(load, bsdf: str):
    _, mesh, table = load(f'<shape type="rectangle">{bsdf}</shape>')
    n = len(mesh.faces)
    return table.evaluate(mesh, np.arange(n), np.full((n, 2), 1 / 3)), table, mesh


RGB = '<rgb name="{}" value="0.2,0.4,0.6"/>'
BLUE = [0.2, 0.4, 0.6]
# 0.2, 0.4, 0.6 under Mitsuba's default coat (eta 1.49 / 1.000277), all reflections inside at their linear sum.
COATED = [0.18217, 0.36434, 0.54651]
GOLDISH = '<rgb name="eta" value="0.2,0.4,1.4"/><rgb name="k" value="3.9,2.4,1.6"/>'
F0 = [((e - 1) ** 2 + k * k) / ((e + 1) ** 2 + k * k) for e, k in ((0.2, 3.9), (0.4, 2.4), (1.4, 1.6))]


@pytest.mark.parametrize("nonlinear", [False, True])
@pytest.mark.parametrize("kind", ["plastic", "roughplastic"])
def test_plastic_truth_is_the_albedo_that_mitsuba_shows(load, kind, nonlinear):
    """Compare the conversion with Mitsuba's own BSDF, without its specular lobe, integrated over both directions."""
    text = (
        f"<bsdf type='{kind}'>{RGB.format('diffuse_reflectance')}<float name='int_ior' value='1.5'/>"
        f"<float name='ext_ior' value='1'/><boolean name='nonlinear' value='{str(nonlinear).lower()}'/>"
        "<rgb name='specular_reflectance' value='0'/></bsdf>"
    )
    surface, _, _ = material_of(load, text)
    import drjit as dr
    import mitsuba as mi

    n = 1 << 20
    rng = mi.PCG32(size=n)
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    wo = mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    value = mi.load_string(text.replace("<bsdf ", '<bsdf version="3.0.0" ', 1)).eval(mi.BSDFContext(), si, wo)
    shown = np.array(value * dr.pi / wo.z).mean(1)
    np.testing.assert_allclose(surface.albedo[0], shown, rtol=0.04)


@pytest.mark.parametrize(
    ("bsdf", "albedo", "roughness", "metallic", "truth"),
    [
        ("<bsdf type='diffuse'/>", [0.5] * 3, 1, 0, True),
        (f"<bsdf type='twosided'><bsdf type='diffuse'>{RGB.format('reflectance')}</bsdf></bsdf>", BLUE, 1, 0, True),
        (f"<bsdf type='plastic'>{RGB.format('diffuse_reflectance')}</bsdf>", COATED, 0.02, 0, True),
        (
            f"<bsdf type='roughplastic'>{RGB.format('diffuse_reflectance')}<float name='alpha' value='0.09'/></bsdf>",
            COATED,
            0.3,
            0,
            True,
        ),
        (f"<bsdf type='conductor'>{GOLDISH}</bsdf>", F0, 0.02, 1, True),
        (
            f"<bsdf type='roughconductor'>{GOLDISH}<rgb name='specular_reflectance' value='0.5,0.5,0.5'/>"
            "<float name='alpha' value='0.25'/></bsdf>",
            [f / 2 for f in F0],
            0.5,
            1,
            True,
        ),
        (
            "<bsdf type='roughconductor'><string name='material' value='none'/>"
            "<float name='alpha_u' value='0.04'/><float name='alpha_v' value='0.16'/></bsdf>",
            [1, 1, 1],
            np.sqrt(0.08),
            1,
            True,
        ),
        (
            f"<bsdf type='principled'>{RGB.format('base_color')}<float name='roughness' value='0.3'/>"
            "<float name='metallic' value='0.7'/></bsdf>",
            [0.2, 0.4, 0.6],
            0.3,
            0.7,
            True,
        ),
        (
            f"<bsdf type='blendbsdf'><float name='weight' value='0.25'/>"
            f"<bsdf type='diffuse'>{RGB.format('reflectance')}</bsdf>"
            "<bsdf type='conductor'><string name='material' value='none'/></bsdf></bsdf>",
            [0.4, 0.55, 0.7],
            0.75 + 0.25 * 0.02,
            0.25,
            True,
        ),
        (
            f"<bsdf type='mask'><float name='opacity' value='0.7'/>"
            f"<bsdf type='diffuse'>{RGB.format('reflectance')}</bsdf></bsdf>",
            [0.2, 0.4, 0.6],
            1,
            0,
            True,
        ),
        ("<bsdf type='dielectric'/>", [1, 1, 1], 0.02, 0, False),
        ("<bsdf type='roughdielectric'><float name='alpha' value='0.16'/></bsdf>", [1, 1, 1], 0.4, 0, False),
        ("<bsdf type='thindielectric'/>", [1, 1, 1], 0.02, 0, False),
        ("<bsdf type='hair'/>", [0.5] * 3, 0.5, 0, False),
    ],
)
def test_mapping_of_bsdfs(load, bsdf, albedo, roughness, metallic, truth):
    surface, table, mesh = material_of(load, bsdf)
    assert np.allclose(surface.albedo, albedo, atol=1e-5)
    assert np.allclose(surface.roughness, roughness, atol=2e-6)
    assert np.allclose(surface.metallic, metallic, atol=2e-6)
    assert (surface.truth == truth).all()
    assert bool(table.materials[0].transparent) == ("dielectric" in bsdf)
    assert table.notes(mesh) and all(f"{len(mesh.faces)} faces)" in note for note in table.notes(mesh))


def test_an_unknown_bsdf_is_named(load):
    _, table, mesh = material_of(load, "<bsdf type='hair'/>")
    assert any("Hair: unknown BSDF" in note for note in table.notes(mesh))


def test_masks_drop_thin_faces_only(load):
    body = "".join(
        f"""<shape type="rectangle"><transform name="to_world"><translate z="{z}"/></transform>
        <bsdf type="mask"><float name="opacity" value="{o}"/><bsdf type="diffuse"/></bsdf></shape>"""
        for z, o in ((0, 0.4), (1, 0.6))
    )
    _, mesh, table = load(body + '<shape type="cube"><bsdf type="null"/></shape>')
    opacity = table.face_opacity(mesh)
    for index, expected in ((0, 0.4), (1, 0.6), (2, 0.0)):
        assert np.allclose(opacity[mesh.shape == index], expected)


@pytest.mark.parametrize("bump", ["", "bumpmap"])
@pytest.mark.parametrize("raw", ["true", "false"])
def test_textures_are_linear_and_follow_their_uv(load, tmp_path, bump, raw):
    """Compare the albedo with pi f / cos of Mitsuba's own diffuse BSDF at the same points."""
    import drjit as dr
    import mitsuba as mi

    picture = (np.random.default_rng(3).random((8, 8, 3)) * 255).astype(np.uint8)
    mi.Bitmap(picture).write(str(tmp_path / "t.png"))
    diffuse = f"""<bsdf type="diffuse"><texture name="reflectance" type="bitmap">
      <string name="filename" value="t.png"/><boolean name="raw" value="{raw}"/>
      <transform name="to_uv"><scale x="2" y="-3"/><translate x="0.3"/></transform></texture></bsdf>"""
    wrapped = f'<bsdf type="bumpmap"><texture type="checkerboard" name="map"/>{diffuse}</bsdf>' if bump else diffuse
    loaded, mesh, table = load(f'<shape type="rectangle"><bsdf type="twosided">{diffuse}</bsdf></shape>')
    rng = np.random.default_rng(1)
    face, b = rng.integers(0, 2, 200), rng.dirichlet([1, 1, 1], 200)[:, 1:]
    surface = table.evaluate(mesh, face, b)
    corners = mesh.vertices[mesh.faces[face]]
    p = corners[:, 0] + b[:, :1] * (corners[:, 1] - corners[:, 0]) + b[:, 1:] * (corners[:, 2] - corners[:, 0])
    origin = (p + [0, 0, 1]).astype(np.float32)
    si = loaded.scene.ray_intersect(mi.Ray3f(mi.Point3f(*origin.T), mi.Vector3f(0, 0, -1)))
    value = dr.pi * loaded.scene.shapes()[0].bsdf().eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1))
    assert np.allclose(surface.albedo, np.array(value).T, atol=2e-5)
    assert surface.albedo.std() > 0.1
    if bump:
        _, mesh, table = load(f'<shape type="rectangle">{wrapped}</shape>')
        assert np.allclose(table.evaluate(mesh, face, b).albedo, surface.albedo)
        assert any("geometric normal" in note for note in table.notes(mesh))


def test_mesh_attributes_reach_the_truth(load, tmp_path):
    import mitsuba as mi

    mesh = mi.Mesh("coloured", 4, 2)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = [0.0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0]
    parameters["faces"] = [0, 1, 2, 0, 2, 3]
    parameters.update()
    mesh.add_attribute("vertex_color", 3, [1.0, 0, 0, 0, 1, 0, 0, 0, 1, 1, 1, 1])
    mesh.write_ply(str(tmp_path / "c.ply"))
    body = """<shape type="ply"><string name="filename" value="c.ply"/><bsdf type="diffuse">
      <texture type="mesh_attribute" name="reflectance"><string name="name" value="vertex_color"/></texture>
      </bsdf></shape>"""
    _, flat, table = load(body)
    surface = table.evaluate(flat, np.array([0, 0, 1]), np.array([[0.0, 0.0], [0.5, 0.5], [0.0, 1.0]]))
    assert np.allclose(surface.albedo, [[1, 0, 0], [0, 0.5, 0.5], [1, 1, 1]], atol=1e-5)


# ---------------------------------------------------------------------------------------------------------- path


def trace_of(mesh):
    from iif_core.light.transport.geometry import build_geometry, trace

    geometry = build_geometry(mesh.vertices, mesh.faces, mesh.shape)
    return lambda origins, directions: trace(geometry, origins, directions)


def plan(mesh, count: int, seed: int = 0, start=(1.0, 1.0, 1.5), unit: float = 1.0):
    from iif_core.camera.pinhole import look_at
    from lab.mitsuba_scene import path

    start = np.array(start) * unit
    given = look_at(start, start + [1, 0.5, -0.1], [0, 0, 1])
    trace = trace_of(mesh)
    up = np.array([0.0, 0.0, 1.0])
    lens = path.Lens(0.77, 0.77)
    return path.plan_views(trace, trace, mesh.vertices, mesh.faces, [(given, lens)], lens, up, count, seed), given, trace


TABLE = """<shape type="cube" id="table"><transform name="to_world"><scale x="0.5" y="0.4" z="0.4"/>
  <translate x="2.5" y="1.5" z="0.4"/></transform></shape>"""


@pytest.mark.long
def test_the_camera_path_stays_inside_with_clearance_and_sees_the_room(load):
    from lab.mitsuba_scene.path import fibonacci_sphere

    _, mesh, _ = load(ROOM + TABLE)
    found, given, trace = plan(mesh, 10)
    assert found.poses.shape == (10, 4, 4) and found.given.tolist() == [True] + [False] * 9
    assert np.array_equal(found.poses[0], given)
    rotation = found.poses[:, :3, :3]
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(rotation), 1)
    sphere = fibonacci_sphere(3000)
    for origin in found.poses[1:, :3, 3]:
        assert (origin > 0).all() and (origin < [4, 3, 2.5]).all()
        _, t = trace(np.broadcast_to(origin, sphere.shape), sphere)
        assert t.min() > 0.33  # the search looked along fewer directions than this
        assert 0.9 < origin[2] < 2.0
    assert found.facts["coverage_1"] > 0.95 and found.facts["coverage_3"] > 0.5
    assert found.notes == []
    again, *_ = plan(mesh, 10)
    assert np.array_equal(again.poses, found.poses)
    other, *_ = plan(mesh, 10, seed=1)
    assert not np.array_equal(other.poses, found.poses)


@pytest.mark.long
def test_more_views_see_no_less(load):
    _, mesh, _ = load(ROOM + TABLE)
    seen = [plan(mesh, count)[0].facts for count in (1, 4, 12)]
    assert seen[0]["coverage_1"] < seen[1]["coverage_1"] <= seen[2]["coverage_1"]
    assert seen[0]["coverage_3"] == 0 < seen[2]["coverage_3"]


@pytest.mark.long
def test_the_path_does_not_leave_the_room_of_the_sensor(load):
    """A second, closed room next to the first is not reachable."""
    other = box((4.2, 0, 0), (9, 3, 2.5)).replace('id="box"', 'id="box2"')
    _, mesh, _ = load(ROOM + other)
    found, *_ = plan(mesh, 8)
    assert (found.poses[:, 0, 3] < 4).all()


@pytest.mark.long
def test_a_tiny_room_and_an_open_floor_still_give_a_path(load):
    _, small, _ = load(box((0, 0, 0), (0.9, 0.8, 2.2)))
    found, *_ = plan(small, 4, start=(0.45, 0.4, 1.5))
    assert len(found.poses) == 4 and 0 < found.facts["clearance_m"] < 0.35
    ground = '<shape type="rectangle"><transform name="to_world"><scale value="5"/></transform></shape>'
    _, floor, _ = load(ground + TABLE)
    found, *_ = plan(floor, 4, start=(1.0, 1.0, 1.5))
    assert len(found.poses) == 4 and found.facts["escape_share"] > 0.3
    assert (found.poses[:, 2, 3] > 0.9).all()


@pytest.mark.long
def test_a_room_in_millimetres_is_remarked_and_still_planned(load):
    _, mesh, _ = load(box((0, 0, 0), (4000, 3000, 2500)))
    found, *_ = plan(mesh, 5, unit=1000.0)
    assert len(found.poses) == 5 and any("unit the metre" in note for note in found.notes)
    assert (found.poses[1:, 2, 3] > 500).all() and found.facts["clearance_m"] > 100


def test_a_sensor_in_a_crevice_keeps_its_own_view_alone(load):
    _, mesh, _ = load(box((0, 0, 0), (0.004, 3, 0.004)))
    found, *_ = plan(mesh, 3, start=(0.002, 1.5, 0.002))
    assert len(found.poses) >= 1 and np.isfinite(found.poses).all()


def test_the_lazy_greedy_choice_is_the_greedy_choice():
    from lab.mitsuba_scene import path

    rng = np.random.default_rng(5)
    seen = rng.random((40, 90)) < 0.3
    counts = rng.integers(0, 2, 90)
    chosen = path._greedy(np.packbits(seen, axis=1), counts.copy(), 12)
    now, expected = counts.copy(), []
    for _ in range(12):
        weight = np.where(now < 3, np.array([1, 0.6, 0.4])[np.minimum(now, 2)], 0.02 / np.maximum(now, 1))
        gain = np.array([weight[row].sum() if i not in expected else -1 for i, row in enumerate(seen)])
        expected.append(int(gain.argmax()))
        now += seen[expected[-1]]
    assert chosen.tolist() == expected


# -------------------------------------------------------------------------------------------------------- render


def view_of(size: int, pose: np.ndarray, fov: float = 70.0):
    from workflow.scene.normal_form import View

    focal = size / 2 / np.tan(np.radians(fov / 2))
    return View(0, "000", size, size, focal, focal, size / 2, size / 2, pose)


def test_our_rays_make_the_picture_that_mitsuba_makes_of_the_sensor(load):
    """Orientation, field of view and pixel grid against `mi.render` with the scene's own sensor and film."""
    import mitsuba as mi

    from iif_core.camera.pinhole import look_at
    from lab.mitsuba_scene import render

    loaded, mesh, _ = load(ROOM + TABLE)
    pose = look_at([1, 1, 1.5], [3, 2, 1.2], [0, 0, 1])
    image, valid, dropped = render.render_view(loaded.scene, render.path_integrator(4), view_of(32, pose), 256, 1)
    reference = np.array(mi.render(loaded.scene, integrator=render.path_integrator(4), spp=256, seed=9))[..., :3]
    assert valid.all() and dropped == 0
    assert image.mean() == pytest.approx(reference.mean(), rel=0.02)
    assert np.corrcoef(image.ravel(), reference.ravel())[0, 1] > 0.97
    for flipped in (reference[::-1], reference[:, ::-1]):
        assert np.corrcoef(image.ravel(), flipped.ravel())[0, 1] < 0.9


def test_rendering_is_the_same_to_the_last_bit_and_balancing_lights_keeps_the_mean(load):
    import drjit as dr

    from iif_core.camera.pinhole import look_at
    from lab.mitsuba_scene import render

    small = LAMP.replace('id="lamp"', 'id="small"').replace('value="0.4"', 'value="0.05"').replace('x="2"', 'x="1"')
    loaded, *_ = load(ROOM + small)
    view = view_of(16, look_at([1, 1, 1.5], [3, 2, 1.2], [0, 0, 1]))
    images = []
    for threads in (1, 2):
        dr.set_thread_count(threads)
        images.append(render.render_view(loaded.scene, render.path_integrator(5), view, 300, 7)[0])
    assert np.array_equal(*images)
    assert not np.array_equal(images[0], render.render_view(loaded.scene, render.path_integrator(5), view, 300, 8)[0])
    render.balance_lights(loaded.scene, loaded.scene.shapes())
    balanced = render.render_view(loaded.scene, render.path_integrator(5), view, 300, 7)[0]
    assert not np.array_equal(balanced, images[0])
    assert balanced.mean() == pytest.approx(images[0].mean(), rel=0.03)


def test_denoising_needs_its_package(monkeypatch):
    import sys

    from workflow.models.denoise import require_denoiser

    require_denoiser()
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with refused("pyoidn", "bash envs/setup.sh", "denoiser: off"):
        require_denoiser()


# ------------------------------------------------------------------------------------------------ the whole stage


def capture(folder: Path, monkeypatch, body: str, capture: str = "", extra: str = "", sensor: str | None = None):
    """Run the stage in `folder` on a scene of `body`; returns its CaptureReader."""
    from workflow.artifacts import StageReader
    from workflow.runtime import fingerprint
    from workflow.runtime.job import run_stage
    from workflow.scene.normal_form import CaptureReader

    folder.mkdir(parents=True, exist_ok=True)
    write(folder, body, sensor)
    (folder / "config/scenes").mkdir(parents=True, exist_ok=True)
    (folder / "config/scenes/s.yaml").write_text(
        f"source: {{kind: mitsuba, path: scene.xml{extra}}}\n"
        f"capture: {{views: 3, width: 24, height: 16, samples: 8{capture}}}\nprior: {{kind: simulated}}\n"
    )
    monkeypatch.chdir(folder)
    fingerprint.resolved.cache_clear()
    fingerprint.fingerprint.cache_clear()
    run_stage("capture", "s", "draft", 2)
    return CaptureReader(StageReader(folder / "results/s/capture", "capture", "s"))


def digests(reader) -> dict[str, str]:
    folder = reader.reader.directory
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name != "manifest.json"
    }


PANE = """<shape type="rectangle" id="pane"><transform name="to_world"><scale value="0.5"/><rotate y="1" angle="90"/>
  <translate x="2.2" y="1.6" z="1.3"/></transform><bsdf type="thindielectric"/></shape>"""


def test_capture_of_a_tiny_scene(llvm, tmp_path, monkeypatch):
    reader = capture(tmp_path / "a", monkeypatch, ROOM + TABLE + PANE, ", test_every: 3")
    views = list(reader)
    assert [v.split for v in views] == ["train", "train", "test"]
    assert (views[0].width, views[0].height) == (24, 16) and views[0].fx == views[0].fy
    vertices, faces = reader.mesh()
    assert len(faces) == 12 + 2 + 12  # the pane is left out
    names = reader.reader.table("instances.parquet")["name"].tolist()
    assert names == ["walls/box", "diffuse/lamp", "table"]
    emission = np.stack([reader.faces()[f"emission_{c}"] for c in "rgb"], 1)
    lamp = reader.faces()["instance_id"] == 1
    assert np.allclose(emission[lamp], [5, 4, 3]) and not emission[~lamp].any()
    assert reader.facts["path"]["coverage_1"] > 0.5
    assert any("transparent faces left out" in note for note in reader.facts["notes"])
    assert np.array(reader.facts["response_truth"]).shape == (3, 101)

    depth, face = reader.gbuffer(views[0])
    truth = reader.truth(views[0])
    assert (face >= 0).all() and (depth > 0).all()
    assert 0 < (~truth.valid).sum() < truth.valid.size / 2  # behind the pane, and only there
    points = reader.points(views[0], depth)
    origin = views[0].world_from_camera[:3, 3]
    at = (2.2 - origin[0]) / (points[..., 0] - origin[0])
    crossing = origin + at[..., None] * (points - origin)
    behind = (at > 0) & (at < 1) & (np.abs(crossing[..., 1:] - [1.6, 1.3]) < 0.5).all(-1)
    assert np.array_equal(behind, ~truth.valid), np.argwhere(behind == truth.valid)
    assert set(np.unique(truth.albedo.round(4))) <= {0.0, 0.5} and set(np.unique(truth.roughness)) == {1.0}

    photo, valid = reader.photo(views[0])
    assert valid.all() and photo.min() >= 0 and photo.max() <= 1 and photo.std() > 0.02
    from lab.simulated.photographs import expose, response_curve

    assert np.allclose(photo, expose(truth.radiance, views[0].exposure, response_curve()), atol=1e-6)

    again = capture(tmp_path / "b", monkeypatch, ROOM + TABLE + PANE, ", test_every: 3")
    assert digests(again) == digests(reader)


@pytest.mark.long
def test_a_killed_capture_goes_on_where_it_was(llvm, tmp_path, monkeypatch):
    """Also where a pixel has no finite sample and where a finished view was damaged meanwhile."""
    from lab.mitsuba_scene import render

    whole, calls = render.render_view, []

    def spoilt(scene, integrator, view, *rest):
        calls.append(view.name)
        if calls == ["000", "001", "002"]:
            raise KeyboardInterrupt
        image, valid, dropped = whole(scene, integrator, view, *rest)
        valid[3, view.view_id] = False
        return image, valid, dropped + 1

    monkeypatch.setattr(render, "render_view", spoilt)
    with pytest.raises(KeyboardInterrupt):
        capture(tmp_path / "a", monkeypatch, ROOM + TABLE)
    damaged = tmp_path / "a/results/s/capture/truth/001.exr"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    resumed = capture(tmp_path / "a", monkeypatch, ROOM + TABLE)
    assert calls == ["000", "001", "002", "001", "002"]
    assert not resumed.photo(resumed.views[1])[1][3, 1] and any("3 path samples" in note for note in resumed.facts["notes"])
    undisturbed = capture(tmp_path / "b", monkeypatch, ROOM + TABLE)
    assert digests(resumed) == digests(undisturbed)
    assert resumed.reader.manifest["files"] == undisturbed.reader.manifest["files"]


@pytest.mark.long
def test_capture_hdr_with_glass_kept(llvm, tmp_path, monkeypatch):
    reader = capture(tmp_path, monkeypatch, ROOM + PANE, ", dynamic_range: hdr", ", drop_transparent: false")
    assert len(reader.mesh()[1]) == 12 + 2 + 2 and reader.is_hdr and "response_truth" not in reader.facts
    view = next(iter(reader))
    photo, _ = reader.photo(view)
    truth = reader.truth(view)
    assert np.array_equal(photo, truth.radiance) and view.exposure == 1
    pane = reader.faces()["instance_id"][reader.gbuffer(view)[1]] == 2
    assert pane.any() and np.array_equal(~truth.valid, pane)


@pytest.mark.long
def test_lights_that_are_not_surface_are_noted(llvm, tmp_path, monkeypatch):
    body = (
        ROOM
        + """<emitter type="constant"><rgb name="radiance" value="0.5,1,2"/></emitter>
      <emitter type="point"><point name="position" x="1" y="1" z="2"/></emitter>"""
    )
    reader = capture(tmp_path, monkeypatch, body)
    assert reader.facts["environment"]["mean_radiance"] == pytest.approx([0.5, 1, 2], rel=1e-5)
    assert any("PointLight" in note for note in reader.facts["notes"])


@pytest.mark.long
def test_one_sided_surface_has_no_truth_behind(llvm, tmp_path, monkeypatch):
    card = """<shape type="rectangle" id="card"><transform name="to_world"><rotate y="1" angle="90"/>
      <translate x="2.2" y="1.6" z="1.3"/></transform><bsdf type="diffuse"/></shape>"""  # away from the sensor
    reader = capture(tmp_path, monkeypatch, ROOM + card)
    view = next(iter(reader))
    card_id = reader.reader.table("instances.parquet")["name"].tolist().index("diffuse/card")
    on_card = reader.faces()["instance_id"][reader.gbuffer(view)[1]] == card_id
    assert on_card.any() and not reader.truth(view).valid[on_card].any()


@pytest.mark.long
def test_exposures_can_be_estimated(llvm, tmp_path, monkeypatch):
    reader = capture(tmp_path, monkeypatch, ROOM + TABLE, ", exposure: estimate")
    exposures = np.array([view.exposure for view in reader])
    assert (exposures > 0).all() and len(reader.facts["exposure_truth"]) == 3
    assert any("exposures estimated" in note for note in reader.facts["notes"])


def test_a_sensor_that_sees_nothing_is_refused(llvm, tmp_path, monkeypatch):
    away = SENSOR.format("50,50,50", "60,60,60")
    with refused("scene.xml", "sensor", "surface"):
        capture(tmp_path, monkeypatch, ROOM, sensor=away)


def test_only_orthographic_sensors_are_refused(llvm, tmp_path, monkeypatch):
    with refused("scene.xml", "perspective"):
        capture(tmp_path, monkeypatch, ROOM, sensor='<sensor type="orthographic"/>')


def test_a_room_of_glass_is_refused(llvm, tmp_path, monkeypatch):
    with refused("scene.xml", "transparent"):
        capture(tmp_path, monkeypatch, box((0, 0, 0), (4, 3, 2.5), "<bsdf type='dielectric'/>"))


# ---------------------------------------------------------------------------------------------- scenes from outside


@pytest.mark.needs_scene
def test_modern_hall(llvm, test_scene):
    from lab.mitsuba_scene import flatten, materials, scene

    xml = test_scene("modern-hall") / "scene.xml"
    assert len(document.referenced_files(xml)) == 23
    mesh = flatten.flatten(scene.load(xml))
    table = materials.MaterialTable(mesh.shapes)
    assert len(mesh.shapes) == 32 and len(mesh.faces) == 28815
    assert int(mesh.emission.any(1).sum()) == 5 * 64 + 8 * 2
    wood = [i for i, shape in enumerate(mesh.shapes) if shape.name.startswith("Wood/")]
    faces = np.flatnonzero(np.isin(mesh.shape, wood))
    surface = table.evaluate(mesh, faces, np.full((len(faces), 2), 1 / 3))
    assert np.allclose(surface.roughness, np.sqrt(0.1)) and surface.albedo.std() > 0.05
    glass = table.of_faces(mesh, "transparent")
    assert glass.sum() == 36 and {mesh.shapes[i].name for i in mesh.shape[glass]} == {"Glass/Mesh014"}


@pytest.mark.long
@pytest.mark.needs_scene
def test_modern_hall_path(llvm, test_scene):
    from lab.mitsuba_scene import flatten, scene

    mesh = flatten.flatten(scene.load(test_scene("modern-hall") / "scene.xml"))
    from iif_core.camera.pinhole import look_at
    from lab.mitsuba_scene import path

    given = look_at([6.91182, 1.65163, 2.55414], [6.0, 1.65163, 2.12], [0, 1, 0])
    trace, lens = trace_of(mesh), path.Lens(0.77, 0.77)
    up = np.array([0.0, 1.0, 0.0])
    found = path.plan_views(trace, trace, mesh.vertices, mesh.faces, [(given, lens)], lens, up, 16, 0)
    assert len(found.poses) == 16 and found.facts["coverage_1"] > 0.95 and found.facts["clearance_m"] >= 0.35
