"""One room in the layouts of several programs: each capture is that of the room, to the pixel."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from iif_core.camera.distortion import Distortion, Pinhole
from iif_core.errors import InputError
from tests.errors import refused
from tests.unit import own_scene as own
from workflow.sources.folder_scene import inputs

COUNT = 4
TO_ARKIT = np.array([[1.0, 0, 0, -1.9], [0, 0, 1, -1.4], [0, -1, 0, 1.5], [0, 0, 0, 1]])
"""The room (z up) in the world of an app: y up, another origin."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """Pictures, depths and OpenCV poses of the room."""
    own.photographed(own.project(tmp_path_factory.mktemp("room")), 1)
    geometry = own.geometry()
    return [(pose, *own.shoot(geometry, pose)[:2]) for pose in own.poses(COUNT)]


def vertices_in(world):
    vertices, faces, _ = own.room_mesh()
    return vertices @ world[:3, :3].T + world[:3, 3], faces


def save_obj(path, vertices, faces):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()] + [
        "f " + " ".join(str(i + 1) for i in f) for f in faces.tolist()
    ]
    path.write_text("\n".join(lines))


def agrees(root, shots, world, camera=own.CAMERA):
    """The capture has the poses `world` @ pose, the photographs, and the depth of the mesh."""
    capture = own.run(root, "capture")
    assert len(list(capture)) == len(shots)
    for view, (pose, picture, depth) in zip(capture, shots, strict=True):
        np.testing.assert_allclose(view.world_from_camera, world @ pose, atol=1e-6)
        expected = (camera.fx, camera.fy, camera.cx, camera.cy)
        assert (view.fx, view.fy, view.cx, view.cy) == pytest.approx(expected, abs=1e-6)
        np.testing.assert_allclose(capture.gbuffer(view)[0], depth, rtol=1e-4)
        np.testing.assert_allclose(capture.photo(view)[0], picture, atol=0.003)
    return capture


def intrinsics(**names):
    values = dict(zip(("fx", "fy", "cx", "cy", "w", "h"), (60.0, 62.0, 33.0, 23.0, 64, 48), strict=True))
    return {name: values[key] for key, name in names.items()}


PROJECT = {"registration": "off"}


# --------------------------------------------------------------------------------------------------------------- Polycam


def polycam(root, shots, corrected=True, aligned=True):
    path = own.project(root, source=PROJECT)
    turn = np.eye(4)
    if aligned:
        turn[:3, :3] = Rotation.from_euler("y", 25, degrees=True).as_matrix()
        turn[:3, 3] = 0.3, -0.1, 2.0
    frames = path / "keyframes"
    prefix = "corrected_" if corrected else ""
    for folder in (f"{prefix}cameras", f"{prefix}images", "depth"):
        (frames / folder).mkdir(parents=True, exist_ok=True)
    if corrected:  # those of the session stay beside them, and are wrong
        (frames / "cameras").mkdir()
        (frames / "cameras/1000000.json").write_text(json.dumps({"t_00": 1}))
    for i, (pose, picture, depth) in enumerate(shots):
        name = str(1442008525605 + 250138 * i)
        matrix = TO_ARKIT @ pose @ OPENGL
        document = {f"t_{r}{c}": matrix[r, c] for r in range(3) for c in range(4)}
        document |= intrinsics(fx="fx", fy="fy", cx="cx", cy="cy", w="width", h="height") | {
            "blur_score": 42.0,
            "timestamp": int(name),
        }
        (frames / f"{prefix}cameras/{name}.json").write_text(json.dumps(document))
        own.save_png(frames / f"{prefix}images/{name}.png", picture)
        own.save_depth(frames / f"depth/{name}.png", depth)
    (path / "mesh_info.json").write_text(
        json.dumps({"alignmentTransform": turn.T.ravel().tolist(), "faceCount": 24} if aligned else {})
    )
    trimesh.Trimesh(*vertices_in(turn @ TO_ARKIT), process=False).export(path / "raw.glb")
    return path, turn @ TO_ARKIT


@pytest.mark.parametrize("corrected", [True, False])
@pytest.mark.parametrize("aligned", [True, False])
def test_polycam(tmp_path, shots, corrected, aligned):
    _, world = polycam(tmp_path, shots, corrected, aligned)
    capture = agrees(tmp_path, shots, world)
    assert capture.facts["alignment"]["depth_median_disagreement"] < 0.01
    assert any("not optimised" in note for note in capture.facts["notes"]) is not corrected


def test_polycam_without_what_it_says_of_its_mesh(tmp_path, shots):
    path, world = polycam(tmp_path, shots, aligned=False)
    (path / "mesh_info.json").unlink()
    capture = agrees(tmp_path, shots, world)
    assert capture.facts["alignment"]["depth_median_disagreement"] < 0.01


@pytest.mark.parametrize(
    "turn", [[float("nan")] * 16, [0.0] * 16, [-1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], [1.0], {"a": 1}]
)
def test_an_alignment_that_is_none_is_refused(tmp_path, shots, turn):
    path, _ = polycam(tmp_path, shots)
    (path / "mesh_info.json").write_text(json.dumps({"alignmentTransform": turn}))
    with refused("mesh_info.json"):
        own.run(tmp_path, "capture")


@pytest.mark.parametrize("which", ["mesh_info.json", "keyframes/corrected_cameras/1442008525605.json"])
def test_documents_of_another_kind_are_refused(tmp_path, shots, which):
    path, _ = polycam(tmp_path, shots)
    (path / which).write_text("[]")
    with refused(which.rpartition("/")[2], "list"):
        own.run(tmp_path, "capture")


def test_every_file_of_polycam_counts_for_the_fingerprint(tmp_path, shots):
    path, _ = polycam(tmp_path, shots)
    source = {"path": str(path), "cameras": None, "unit": "m", "mesh": None, "alignment": "check", "images": "images"}
    files = inputs.find_inputs(source, {"views": 9, "dynamic_range": "ldr", "test_every": 0}).files()
    assert {path / "mesh_info.json", path / "raw.glb", *(path / "keyframes/corrected_cameras").iterdir()} <= set(files)


def test_a_number_that_is_missing_is_named(tmp_path, shots):
    path, _ = polycam(tmp_path, shots)
    file = sorted((path / "keyframes/corrected_cameras").iterdir())[0]
    document = json.loads(file.read_text())
    del document["t_23"]
    file.write_text(json.dumps(document))
    with refused(file.name, "t_23"):
        own.run(tmp_path, "capture")


# -------------------------------------------------------------------------------------------------------------- Record3D


def record3d(root, shots, per_frame=True, name="metadata.json", below="rgb", factor=1):
    path = own.project(root, source=PROJECT)
    path.mkdir(parents=True)
    poses = []
    for i, (pose, picture, depth) in enumerate(shots):
        matrix = TO_ARKIT @ pose @ OPENGL
        poses.append([*Rotation.from_matrix(matrix[:3, :3]).as_quat(), *matrix[:3, 3]])
        own.save_png(path / f"{below}/{i}.png", picture)
        own.save_raw_exr(path / f"depth/{i}.exr", {"Y": depth.astype(np.float32)})
    lens = np.array([60.0, 62.0, 33.0, 23.0]) * factor  # at the size that w and h say, which may be another
    document = {"poses": poses, "w": 64 * factor, "h": 48 * factor, "dw": 64, "dh": 48, "fps": 60}
    document["K"] = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]]).T.ravel().tolist()
    if per_frame:
        document |= {"perFrameIntrinsicCoeffs": [lens.tolist()] * len(shots), "K": [0.0] * 9}
    (path / name).write_text(json.dumps(document))
    own.save_mesh(path / "mesh.ply", *vertices_in(TO_ARKIT))


@pytest.mark.parametrize(
    "per_frame, name, below, factor",
    [
        (True, "metadata", "rgbd", 1),
        (False, "metadata.json", "rgb", 2),
        (True, "metadata.json", "rgb", 2),
        (False, "metadata", "rgbd", 1),
    ],
)
def test_record3d(tmp_path, shots, per_frame, name, below, factor):
    record3d(tmp_path, shots, per_frame, name, below, factor)
    capture = agrees(tmp_path, shots, TO_ARKIT)
    assert capture.facts["alignment"]["depth_median_disagreement"] < 0.01


def test_frames_of_record3d_that_have_no_photograph_are_left_out(tmp_path, shots):
    path = own.project(tmp_path, source=PROJECT)
    path.mkdir(parents=True)
    matrix = TO_ARKIT @ shots[0][0] @ OPENGL
    pose = [*Rotation.from_matrix(matrix[:3, :3]).as_quat(), *matrix[:3, 3]]
    own.save_png(path / "rgb/1.png", shots[0][1])
    lens = [60.0, 62.0, 33.0, 23.0]
    document = {"poses": [[0.0, 0, 0, 1, 9, 9, 9], pose], "w": 64, "h": 48, "perFrameIntrinsicCoeffs": [lens, lens]}
    (path / "metadata.json").write_text(json.dumps(document))
    own.save_mesh(path / "mesh.ply", *vertices_in(TO_ARKIT))
    agrees(tmp_path, shots[:1], TO_ARKIT)
    (path / "metadata.json").write_text(json.dumps(document | {"poses": [[0.0] * 7, [0.0] * 7]}))
    with refused("metadata.json", "pose 1"):
        own.run(tmp_path, "capture")


# -------------------------------------------------------------------------------------------------------- 3D Scanner App


def scanner_app(root, shots):
    path = own.project(root, source=PROJECT)
    path.mkdir(parents=True)
    k = np.array([[60.0, 0, 33], [0, 62, 23], [0, 0, 1]])
    for i, (pose, picture, depth) in enumerate(shots):
        stem = f"{6 * i:05d}"
        matrix = TO_ARKIT @ pose @ OPENGL
        document = {"cameraPoseARFrame": matrix.ravel().tolist(), "intrinsics": k.ravel().tolist(), "frame_index": 6 * i}
        (path / f"frame_{stem}.json").write_text(json.dumps(document))
        (path / f"frame_{6 * i + 1:05d}.json").write_text(json.dumps(document))  # most frames have no photograph
        own.save_png(path / f"frame_{stem}.png", picture)
        own.save_depth(path / f"depth_{stem}.png", depth)
    save_obj(path / "export.obj", *vertices_in(TO_ARKIT))


def test_scanner_app(tmp_path, shots):
    scanner_app(tmp_path, shots)
    capture = agrees(tmp_path, shots, TO_ARKIT)
    assert capture.facts["alignment"]["depth_median_disagreement"] < 0.01


# ------------------------------------------------------------------------------------------------------------- Metashape


LENS = Distortion("radial_tangential", (-0.08, 0.02, 0.0, 0.0), (1e-3, -5e-4))


def xml(shots, place=None, reference="", calibration="", lens=(), sensor='type="frame"', extra="", component=False):
    """Cameras as Metashape writes them; `place`: rotation, translation and scale of the chunk."""
    rotation, translation, scale = place or (np.eye(3), np.zeros(3), 1.0)
    own_lens = "".join(f"<{name}>{value!r}</{name}>" for name, value in dict(lens).items())
    inner = "<f>62.0</f><b1>-2.0</b1><cx>1.0</cx><cy>-1.0</cy>" + own_lens + extra
    wrong = "<calibration class='initial'><f>1.0</f></calibration>"
    text = "<?xml version='1.0' encoding='UTF-8'?>\n<document version='1.5.0'><chunk label='Chunk 1' enabled='true'><sensors>"
    text += f"<sensor id='0' label='phone' {sensor}><resolution width='64' height='48'/>{wrong}"
    text += f"<calibration class='adjusted'>{inner}</calibration></sensor></sensors>"
    numbers = f"<rotation>{' '.join(map(repr, rotation.ravel().tolist()))}</rotation>"
    numbers += f"<translation>{' '.join(map(repr, translation.tolist()))}</translation><scale>{scale!r}</scale>"
    if component:
        text += f"<components><component id='7'><transform>{numbers}</transform></component></components>"
    text += "<cameras next_id='9' next_group_id='0'>"
    for i, (pose, _, _) in enumerate(shots):
        own_pose = np.linalg.inv(np.block([[scale * rotation, translation[:, None]], [np.zeros((1, 3)), 1.0]])) @ pose
        own_pose[:3, :3] *= scale  # poses are rotation and translation in the units of the chunk
        at = " component_id='7'" if component else ""
        row = " ".join(map(repr, own_pose.ravel().tolist()))
        text += f"<camera id='{i}' sensor_id='0' label='{i:03d}'{at}><transform>{row}</transform></camera>"
    text += "<camera id='90' sensor_id='0' label='lost'/><camera id='91' sensor_id='0' label='000' enabled='false'/></cameras>"
    text += f"<reference>{reference}</reference>" if reference else ""
    return text + ("" if component else f"<transform>{numbers}</transform>") + "</chunk></document>"


PLACE = Rotation.from_euler("xyz", (20, -35, 70), degrees=True).as_matrix(), np.array([1.5, -2.0, 0.7]), 0.37


def metashape(root, shots, **options):
    path = own.project(root, source=PROJECT)
    for i, (_, picture, _) in enumerate(shots):
        own.save_png(path / f"images/{i:03d}.png", picture)
    own.save_mesh(path / "mesh.ply", *own.room_mesh()[:2])
    (path / "cameras.xml").write_text(xml(shots, **options))
    return path


LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'


@pytest.mark.parametrize("place, component, reference", [(None, False, LOCAL), (PLACE, False, ""), (PLACE, True, LOCAL)])
def test_metashape(tmp_path, shots, place, component, reference):
    metashape(tmp_path, shots, place=place, component=component, reference=reference.replace('"', "&quot;"))
    capture = agrees(tmp_path, shots, np.eye(4))
    assert any("lost" in note for note in capture.facts["notes"])


def test_the_lens_of_metashape_has_its_tangential_numbers_the_other_way(tmp_path, shots):
    """x' = x (1 + k1 r^2 + ...) + p1 (r^2 + 2 x^2) + 2 p2 x y, by its manual; OpenCV has p2 where Metashape has p1."""
    path = metashape(tmp_path, shots, lens={"k1": -0.08, "k2": 0.02, "p1": -5e-4, "p2": 1e-3})
    source = {"path": str(path), "cameras": None, "unit": "m", "mesh": None, "alignment": "check", "images": "images"}
    (frame, *_) = inputs.find_inputs(source, {"views": 9, "dynamic_range": "ldr", "test_every": 0}).cameras.frames
    assert frame.lens == LENS
    assert (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy) == (60, 62, 33, 23)


@pytest.mark.parametrize(
    "options, said",
    [
        ({"extra": "<k4>0.01</k4>"}, "k4"),
        ({"extra": "<b2>3.0</b2>"}, "b2"),
        ({"sensor": 'type="fisheye"'}, "fisheye"),
        ({"reference": "GEOGCS[&quot;WGS 84&quot;]"}, "GEOGCS"),
    ],
)
def test_what_metashape_has_and_is_not_read_is_refused_by_name(tmp_path, shots, options, said):
    metashape(tmp_path, shots, **options)
    with refused("cameras.xml", said):
        own.run(tmp_path, "capture")


def test_a_calibration_without_a_focal_length_and_a_label_that_is_no_name(tmp_path, shots):
    path = metashape(tmp_path, shots)
    text = (path / "cameras.xml").read_text()
    (path / "cameras.xml").write_text(text.replace("<f>62.0</f>", "<fx>62.0</fx><fy>62.0</fy>"))
    with refused("cameras.xml", "`f`"):
        own.run(tmp_path, "capture")
    (path / "cameras.xml").write_text(text.replace("label='000'", f"label='{'0' * 300}'"))
    with refused("cameras.xml"):
        own.run(tmp_path, "capture")


def test_xml_that_is_none(tmp_path, shots):
    path = metashape(tmp_path, shots)
    for text in ("<document>", "<document/>", "<!DOCTYPE a [<!ENTITY b 'c'>]><document/>", ""):
        (path / "cameras.xml").write_text(text)
        with refused("cameras.xml"):
            own.run(tmp_path, "capture")


# -------------------------------------------------------------------------------------------------------------- Meshroom


def meshroom(root, shots, middle=True, since_2023=False, kind="radial3", name="cameras.sfm", scale=1.0):
    path = own.project(root, source=PROJECT)
    for i, (_, picture, _) in enumerate(shots):
        own.save_png(path / f"images/{i:03d}.png", picture)
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(path / "mesh.ply", scale * vertices, faces)
    point = [1.0, -1.0] if middle else [33.0, 23.0]
    lens = {
        "intrinsicId": "5",
        "width": "64",
        "height": "48",
        "type": kind,
        "pxFocalLength": ["60.0", "62.0"],
        "principalPoint": point,
    }
    lens["distortionParams"] = ["0", "0", "0"]
    if since_2023:
        lens |= {"type": "pinhole", "distortionType": "radialk3"}
    views = [
        {"viewId": str(i), "poseId": str(i), "intrinsicId": "5", "path": f"C:\\scans\\{i:03d}.png"} for i in range(len(shots))
    ]
    views.append({"viewId": "9", "poseId": "9", "intrinsicId": "5", "path": "/lost.png"})
    poses = []
    for i, (pose, _, _) in enumerate(shots):
        world_to_camera = pose[:3, :3].T
        transform = {
            "rotation": [repr(v) for v in world_to_camera.T.ravel().tolist()],
            "center": [repr(v) for v in pose[:3, 3].tolist()],
        }
        poses.append({"poseId": str(i), "pose": {"transform": transform, "locked": "0"}})
    (path / name).write_text(json.dumps({"version": ["1", "2", "8"], "views": views, "intrinsics": [lens], "poses": poses}))
    return path


@pytest.mark.parametrize(
    "name, middle, since_2023", [("cameras.sfm", True, False), ("sfm.json", False, True), ("cameras.sfm", False, False)]
)
def test_meshroom(tmp_path, shots, name, middle, since_2023):
    meshroom(tmp_path, shots, middle, since_2023, name=name)
    capture = agrees(tmp_path, shots, np.eye(4))
    assert any("lost" in note for note in capture.facts["notes"])


def test_a_lens_of_meshroom_that_is_not_read_is_refused_by_name(tmp_path, shots):
    meshroom(tmp_path, shots, kind="fisheye4")
    with refused("cameras.sfm", "fisheye4"):
        own.run(tmp_path, "capture")


def test_a_focal_length_in_millimetres(tmp_path, shots):
    path = meshroom(tmp_path, shots)
    document = json.loads((path / "cameras.sfm").read_text())
    del document["intrinsics"][0]["pxFocalLength"]
    document["intrinsics"][0] |= {"focalLength": "33.75", "sensorWidth": "36.0", "sensorHeight": "27.0"}
    (path / "cameras.sfm").write_text(json.dumps(document))
    source = {"path": str(path), "cameras": None, "unit": "m", "mesh": None, "alignment": "check", "images": "images"}
    (frame, *_) = inputs.find_inputs(source, {"views": 9, "dynamic_range": "ldr", "test_every": 0}).cameras.frames
    assert (frame.camera.fx, frame.camera.fy) == (60, 60)


# ------------------------------------------------------------------------------------------------------- what is not known


def test_a_folder_of_no_known_program_is_refused_with_the_page(tmp_path, shots):
    path = own.project(tmp_path)
    own.save_png(path / "images/000.png", shots[0][1])
    own.save_mesh(path / "mesh.ply", *own.room_mesh()[:2])
    with refused("transforms.json", "COLMAP", "docs/guide/programs.md"):
        own.run(tmp_path, "capture")


def message(run, *arguments):
    with pytest.raises(InputError) as caught:
        run(*arguments)
    return str(caught.value)


@pytest.mark.parametrize(
    "name, text, said",
    [
        ("registration.csv", "#name,x,y,alt,heading,pitch,roll,f\n", "#realityscan"),
        ("images/0001.xmp", "<x:xmpmeta/>", "#realityscan"),
        ("room.psx", "", "#metashape"),
        ("room.blend", "BLENDER", "#blender"),
        ("scan.zip", "PK", "unpack"),
    ],
)
def test_files_of_programs_that_hold_no_cameras_are_pointed_out(tmp_path, name, text, said):
    path = own.project(tmp_path)
    (path / name).parent.mkdir(parents=True)
    (path / name).write_text(text)
    with refused("data/own", name) as error:
        own.run(tmp_path, "capture")
    (path / name).rename(path / f"{Path(name).stem}.csv")
    (path / f"{Path(name).stem}.csv").write_text("notes,of mine\n")
    with refused("data/own") as other:
        own.run(tmp_path, "capture")
    assert said in str(error.value) and said not in str(other.value)


def test_cameras_under_another_name_and_in_a_folder_below_are_pointed_out(tmp_path, shots):
    path = metashape(tmp_path, shots)
    (path / "cameras.xml").rename(path / "my cameras.xml")
    assert "Found my cameras.xml: name it with `source.cameras`" in message(own.run, tmp_path, "capture")
    own.project(tmp_path, source=PROJECT | {"cameras": "my camera.xml"})
    said = message(own.run, tmp_path, "capture")
    assert "not found" in said and "my cameras.xml" in said and "COLMAP" not in said
    own.project(tmp_path, source=PROJECT | {"cameras": "my cameras.xml"})
    agrees(tmp_path, shots, np.eye(4))
    below = tmp_path / "data/more"
    below.mkdir()
    path.rename(below / "scan")
    (below / "scan/my cameras.xml").rename(below / "scan/cameras.xml")
    below.rename(path)
    own.project(tmp_path, source=PROJECT)
    assert "own/scan: set `source.path` to it" in message(own.run, tmp_path, "capture")


def test_photographs_in_another_folder_are_pointed_out(tmp_path, shots):
    path = metashape(tmp_path, shots)
    (path / "images").rename(path / "photos")
    assert "set `source.images: photos`" in message(own.run, tmp_path, "capture")
    own.project(tmp_path, source=PROJECT | {"images": "photo"})
    assert "Did you mean data/own/photos?" in message(own.run, tmp_path, "capture")
    own.project(tmp_path, source=PROJECT | {"images": "photos"})
    agrees(tmp_path, shots, np.eye(4))


def test_the_mesh_of_the_app_is_named_where_there_is_none(tmp_path, shots):
    path, _ = polycam(tmp_path, shots)
    (path / "raw.glb").unlink()
    assert "raw.glb" in message(own.run, tmp_path, "capture")


# -------------------------------------------------------------------------------------------------- the page of each program

PAGE = Path(__file__).parents[2] / "docs/guide/programs.md"
UNIT = 0.42  # metres in a unit of a reconstruction without a metre, as the page has it
HERE = np.eye(4)
CENTRED = Pinhole(60.0, 60.0, 32.0, 24.0, 64, 48)


def in_units(pose, scale=1 / UNIT):
    moved = pose.copy()
    moved[:3, 3] *= scale
    return moved


def photographs(path, shots):
    for i, (_, picture, _) in enumerate(shots):
        own.save_png(path / f"images/{i:03d}.png", picture)


def colmap(path, shots, mesh, scale):
    """A sparse model as text, in units of 1 / scale metres."""
    photographs(path, shots)
    (path / "sparse/0").mkdir(parents=True)
    (path / "sparse/0/cameras.txt").write_text("# cameras\n1 PINHOLE 64 48 60 62 33 23\n")
    (path / "sparse/0/points3D.txt").write_text("# points\n")
    lines = ["# images"]
    for i, (pose, _, _) in enumerate(shots):
        to_camera = np.linalg.inv(in_units(pose, scale))
        quaternion = Rotation.from_matrix(to_camera[:3, :3]).as_quat(scalar_first=True)
        lines += [" ".join(map(repr, [i + 1, *quaternion.tolist(), *to_camera[:3, 3].tolist(), 1])) + f" {i:03d}.png", ""]
    (path / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(path / mesh, vertices * scale, faces)


def transforms(path, shots, axes=OPENGL, world=HERE, scale=1.0, **more):
    photographs(path, shots)
    frames = [
        {"file_path": f"images/{i:03d}.png", "transform_matrix": (world @ in_units(pose, scale) @ axes).tolist()}
        for i, (pose, _, _) in enumerate(shots)
    ]
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(path / "mesh.ply", vertices * scale, faces)
    document = own.intrinsics() | {"frames": frames} | more
    own.write_transforms(path, document)
    return document


def nerfstudio(root, shots):
    applied = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    transforms(root / "data/own", shots, world=applied, scale=1 / UNIT, applied_transform=applied[:3].tolist())


def rgbd(root, shots):
    document = transforms(root / "data/own", shots, axes=HERE)
    for i, (_, _, depth) in enumerate(shots):
        own.save_depth(root / f"data/own/depth/{i:03d}.png", depth)
        document["frames"][i]["depth_file_path"] = f"depth/{i:03d}.png"
    own.write_transforms(root / "data/own", document)


def blender(root, shots):
    """What the script on the page writes; `camera.matrix_world` has OpenGL axes."""
    path, frames = root / "data/own", []
    for i, (pose, picture, _) in enumerate(shots):
        own.save_exr(path / f"images/Camera.{i:03d}.exr", {c: picture[..., k].astype(np.float32) for k, c in enumerate("RGB")})
        angle = 2 * np.arctan(0.5 * 64 / CENTRED.fx)
        matrix = (pose @ OPENGL).tolist()
        frames.append({"file_path": f"images/Camera.{i:03d}.exr", "camera_angle_x": angle, "transform_matrix": matrix})
    own.save_mesh(path / "mesh.ply", *own.room_mesh()[:2])
    own.write_transforms(path, {"w": 64, "h": 48, "frames": frames})


def metashape_with_a_place(root, shots):
    metashape(root, shots, place=PLACE)


def meshroom_in_units(root, shots):
    meshroom(root, [(in_units(pose), picture, depth) for pose, picture, depth in shots], scale=1 / UNIT)


def instant_ngp(root, shots):
    transforms(root / "data/own", shots, scale=1 / UNIT, aabb_scale=16)


def colmap_in_units(root, shots):
    colmap(root / "data/own", shots, "dense/0/meshed-poisson.ply", 1 / UNIT)


def realityscan(root, shots):
    colmap(root / "data/own", shots, "model.ply", 1.0)


PROGRAMS = {
    "Polycam": lambda root, shots: polycam(root, shots, aligned=False),
    "Record3D": record3d,
    "3D Scanner App": scanner_app,
    "COLMAP": colmap_in_units,
    "RealityScan": realityscan,
    "Metashape": metashape_with_a_place,
    "Meshroom": meshroom_in_units,
    "nerfstudio": nerfstudio,
    "instant-ngp": instant_ngp,
    "Blender": blender,
    "RGB-D data sets": rgbd,
}
"""Writers of the layouts; the apps have worlds of their own."""
APPS = {"Polycam", "Record3D", "3D Scanner App"}


def pages():
    """Section of the page -> its YAML."""
    sections = re.split(r"^## (.+)$", PAGE.read_text(), flags=re.MULTILINE)[1:]
    blocks = {
        name: re.findall(r"```yaml\n(.*?)```", text, re.DOTALL) for name, text in zip(sections[::2], sections[1::2], strict=True)
    }
    return {name: found[0] for name, found in blocks.items() if found}


def test_every_program_of_the_page_is_tried():
    assert set(pages()) == {"Photographs alone", *PROGRAMS}  # the former by test_photographs_alone.py


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_page_of_a_program_is_enough(tmp_path, shots, program):
    """Its layout, and its YAML with the folder's name alone changed: poses, lens, photographs and depth are those of the room."""
    camera = own.CAMERA
    if program == "Blender":
        geometry, camera = own.geometry(), CENTRED
        shots = [(pose, *own.shoot(geometry, pose, camera)[:2]) for pose in own.poses(COUNT)]
    own.project(tmp_path)
    PROGRAMS[program](tmp_path, shots)
    text = pages()[program].replace("data/livingroom", "data/own")
    (tmp_path / "config/scenes/own.yaml").write_text(text)
    agrees(tmp_path, shots, TO_ARKIT if program in APPS else HERE, camera)
