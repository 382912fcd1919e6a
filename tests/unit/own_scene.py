"""A small room with known cameras, written as a `folder` scene in many variants."""

from __future__ import annotations

import json
import os
import struct
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import yaml

from iif_core.camera.distortion import Distortion, Pinhole, undistort
from iif_core.camera.pinhole import look_at, pixel_directions

# Not at the origin: a turned or scaled frame must not fit by chance.
ROOM = ((1.0, -2.0, 0.5), (5.0, 1.0, 3.0))
BLOCK = ((2.5, -0.8, 0.5), (3.3, -0.2, 1.3))
CAMERA = Pinhole(60.0, 62.0, 33.0, 23.0, 64, 48)


def box(low, high, inward):
    """8 vertices, 12 faces; normals inwards for a room, outwards for a thing."""
    low, high = np.array(low), np.array(high)
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return low + corners * (high - low), faces[:, ::-1] if inward else faces


def room_mesh():
    """Vertices (16, 3), faces (24, 3) and the thing (0 room, 1 block) of each face."""
    a, fa = box(*ROOM, inward=True)
    b, fb = box(*BLOCK, inward=False)
    return np.concatenate([a, b]), np.concatenate([fa, fb + len(a)]), np.repeat([0, 1], 12)


def poses(count):
    """OpenCV poses in the upper half of the room, looking down at the block from all around."""
    angle = 2 * np.pi * np.arange(count) / count + 0.3
    eyes = np.stack([3 + 1.5 * np.cos(angle), -0.5 + 1.1 * np.sin(angle), np.full(count, 2.2)], 1)
    return [look_at(eye, (2.9, -0.5, 0.9), (0, 0, 1)) for eye in eyes]


def geometry():
    from workflow.runtime import native

    native.prepare()
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    from iif_core.light.transport.geometry import build_geometry

    vertices, faces, thing = room_mesh()
    return build_geometry(vertices, faces, thing.astype(np.int32))


def pattern(points):
    """Colour in (0.1, 0.9) of a surface point (metres), smooth, the same from everywhere."""
    x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    waves = (np.sin(2.1 * x + 0.4), np.sin(1.7 * y + z), np.cos(2.3 * z + x))
    return 0.5 + 0.3 * np.stack(waves, -1)


def shoot(geometry, pose, camera=CAMERA, lens=None):
    """Picture, z-depth and face ids as this camera sees them, through a lens if given."""
    from iif_core.light.transport.geometry import trace

    directions = pixel_directions(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, pose)
    if lens is not None:
        u = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        v = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        at, _ = undistort(lens, np.stack(np.meshgrid(u, v), -1))
        directions = (np.concatenate([at, np.ones((*at.shape[:2], 1))], -1) @ pose[:3, :3].T).astype(np.float32)
    face, t = trace(geometry, pose[:3, 3], directions.reshape(-1, 3))
    shape = directions.shape[:2]
    points = pose[:3, 3] + np.where(face >= 0, t, 0).reshape(shape)[..., None] * directions
    return pattern(points), np.where(face >= 0, t, 0).reshape(shape), face.reshape(shape)


def save_png(path, picture):
    """[0, 1] to 8-bit RGB."""
    from PIL import Image

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)).save(path)


def save_exr(path, channels):
    from workflow.artifacts.files import write_exr

    write_exr(Path(path), channels)


def save_raw_exr(path, channels):
    """EXR that may hold NaN (the project's own writer refuses them)."""
    import OpenEXR

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(path))


def save_depth(path, depth, unit=0.001):
    from PIL import Image

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(depth / unit).astype(np.uint16)).save(path)


def save_mesh(path, vertices, faces, instance=None):
    """ASCII PLY, with an `instance` face property if given."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property double {c}" for c in "xyz")]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    lines += ["property int instance"] if instance is not None else []
    lines += ["end_header", *(" ".join(repr(float(c)) for c in v) for v in vertices)]
    tail = [""] * len(faces) if instance is None else [f" {i}" for i in instance]
    lines += [f"3 {a} {b} {c}{t}" for (a, b, c), t in zip(faces, tail, strict=True)]
    Path(path).write_text("\n".join(lines) + "\n")


def rewrite_glb(path, change):
    """Let `change` change the JSON of a GLB in place."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    path.write_bytes(struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest)


def frame(i, pose, folder="images", suffix=".png"):
    """Entry of transforms.json for an OpenCV pose."""
    matrix = np.asarray(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return {"file_path": f"{folder}/{i:03d}{suffix}", "transform_matrix": matrix.tolist()}


def intrinsics(camera=CAMERA):
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
    }


def bare(folder, count=3):
    """transforms.json, grey pictures and the mesh: enough for every check before work. Returns the document."""
    folder = Path(folder)
    vertices, faces, _ = room_mesh()
    save_mesh(folder / "mesh.ply", vertices, faces)
    document = {**intrinsics(), "frames": [frame(i, p) for i, p in enumerate(poses(count))]}
    for entry in document["frames"]:
        save_png(folder / entry["file_path"], np.full((CAMERA.height, CAMERA.width, 3), 0.5))
    write_transforms(folder, document)
    return document


def photographed(folder, count=4, depth=True, lens: Distortion | None = None, hdr=False, gains=None):
    """A complete scene with real pictures (and depth). Returns (document, shots)."""
    folder, shape = Path(folder), geometry()
    vertices, faces, _ = room_mesh()
    save_mesh(folder / "mesh.ply", vertices, faces)
    document, shots = {**intrinsics(), "frames": []}, []
    for i, pose in enumerate(poses(count)):
        picture, z, face = shoot(shape, pose, lens=lens)
        picture = picture * (1.0 if gains is None else gains[i])
        entry = frame(i, pose, suffix=".exr" if hdr else ".png")
        if hdr:
            save_exr(folder / entry["file_path"], {c: picture[..., k].astype(np.float32) for k, c in enumerate("RGB")})
        else:
            save_png(folder / entry["file_path"], picture)
        if depth:
            entry["depth_file_path"] = f"depth/{i:03d}.png"
            save_depth(folder / entry["depth_file_path"], z)
        document["frames"].append(entry)
        shots.append((pose, picture, z, face))
    write_transforms(folder, document)
    return document, shots


def write_transforms(folder, document):
    (Path(folder) / "transforms.json").write_text(json.dumps(document))


def settings_of(folder, source=None, capture=None):
    """Dumped settings of a folder scene."""
    from workflow import settings

    tree = {
        "source": {"kind": "folder", "path": str(folder), **(source or {})},
        "capture": {"width": 64, "height": 48, **(capture or {})},
        "prior": {"kind": "retinex"},
    }
    return settings.dump(settings.SceneSettings.model_validate(tree))


def project(root, source=None, capture=None, segmentation=None, scene="own"):
    """A working directory with config/scenes/<scene>.yaml that reads data/<scene>."""
    root = Path(root)
    (root / "config/scenes").mkdir(parents=True, exist_ok=True)
    tree = {
        "source": {"kind": "folder", "path": f"data/{scene}", **(source or {})},
        "capture": {"width": 64, "height": 48, **(capture or {})},
        "prior": {"kind": "retinex"},
        "segmentation": segmentation or {"kind": "geometry"},
    }
    (root / f"config/scenes/{scene}.yaml").write_text(yaml.safe_dump(tree))
    return root / "data" / scene


@contextmanager
def working_in(root):
    """Run stages in `root`, with no settings remembered from another test."""
    from workflow.runtime import fingerprint

    before = os.getcwd()
    os.chdir(root)
    fingerprint.resolved.cache_clear()
    fingerprint.fingerprint.cache_clear()
    try:
        yield
    finally:
        os.chdir(before)
        fingerprint.resolved.cache_clear()
        fingerprint.fingerprint.cache_clear()


def run(root, *stages, scene="own"):
    """Run stages of the scene, and the prior before the segmentation, which reads it; return a reader of the capture."""
    from workflow.artifacts import StageReader
    from workflow.runtime.job import run_stage
    from workflow.scene.normal_form import CaptureReader

    with working_in(root):
        for stage in stages:
            if stage == "segmentation" and not (Path("results") / scene / "prior/manifest.json").exists():
                run_stage("prior", scene, "draft", 2)
            run_stage(stage, scene, "draft", 2)
    return CaptureReader(StageReader(Path(root) / "results" / scene / "capture", "capture", scene))
