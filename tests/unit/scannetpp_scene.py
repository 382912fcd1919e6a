"""A miniature of a ScanNet++ release: a known room photographed through a fisheye, written in the released layout.

Conversions are written here a second time, from the description of the data set (rows of the matrices, quaternions of
SciPy, the fisheye formula point by point), so that they can prove the ones of the workflow.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from iif_core.camera.distortion import Distortion, Pinhole, undistort
from tests.unit import own_scene as own

CAMERA = Pinhole(65.8, 66.1, 72.4, 48.9, 146, 97)
LENS = Distortion("fisheye", (-0.031, -0.0052, 0.0021, -0.0006))
TEST = (2, 5)
"""Views of the test list."""
BAD = 4
MASKED = (1, 3)
HIDDEN = (slice(20, 46), slice(60, 95))
"""What the masks hide."""
UNLABELLED = "rug"
POINTS = 600
"""Sparse points of the COLMAP model."""


def room():
    from lab import rooms

    return rooms.build("tiny")


def geometry(of_room):
    from workflow.runtime import native

    native.prepare()
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    from iif_core.light.transport.geometry import build_geometry

    return build_geometry(of_room.vertices, of_room.faces, of_room.object_id)


def name(i):
    return f"DSC{i:05d}.JPG"


def nerfstudio_matrix(pose):
    """Return the release's transform_matrix of an OpenCV pose in the mesh's frame (docs/method/camera.md#axes-and-pixels)."""
    rows = np.stack([pose[1], pose[0], -pose[2], pose[3]])
    rows[:, 1:3] = -rows[:, 1:3]
    return rows


def fisheye_pixel(point, pose, camera=CAMERA, lens=LENS):
    """Pixel of one point: OpenCV's formula with scalars."""
    x, y, z = pose[:3, :3].T @ (np.asarray(point, float) - pose[:3, 3])
    r = float(np.hypot(x, y))
    theta = np.arctan2(r, z)
    k1, k2, k3, k4 = lens.k
    bent = theta + k1 * theta**3 + k2 * theta**5 + k3 * theta**7 + k4 * theta**9
    share = bent / r if r > 0 else 1.0
    return np.array([camera.fx * x * share + camera.cx, camera.fy * y * share + camera.cy])


def save_jpeg(path, picture):
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
    Image.fromarray(pixels).save(path, quality=100, subsampling=0, format="JPEG")


def photographs(of_room, count=6):
    """(pose, picture) of every view: a smooth pattern on the surfaces, without light."""
    shape = geometry(of_room)
    poses = of_room.cameras(count)
    return [(pose, own.shoot(shape, pose, CAMERA, LENS)[0]) for pose in poses]


def directions(camera, lens, pose):
    """(H W, 3) float32 world directions of the pixel centres."""
    u = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    at = np.stack(np.meshgrid(u, v), -1)
    at = at if lens.is_identity else undistort(lens, at)[0]
    local = np.concatenate([at, np.ones((*at.shape[:2], 1))], -1)
    return (local @ pose[:3, :3].T).reshape(-1, 3).astype(np.float32)


def traced(room, count, samples, camera=CAMERA, lens=LENS):
    """(pose, picture in [0, 1]) of every view: path traced, with one exposure for all."""
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene
    from lab.simulated.photographs import expose, response_curve

    shape = geometry(room)
    emitters = Emitters(shape, room.emission, np.ones(len(room.faces), np.int8))
    material, curve = room.materials.drjit(), response_curve("filmic")
    out = []
    for i, pose in enumerate(room.cameras(count)):
        rays = directions(camera, lens, pose)
        radiance = render(Scene(shape, material, emitters), pose[:3, 3], rays, PathOptions(samples, 12, 1000 + i))
        picture = expose(radiance, 0.6, curve).reshape(camera.height, camera.width, 3)
        out.append((pose, picture))
    return out


def release(home, of_room, views, garbage=1.0):
    """Write the released layout. views: (pose, picture [0, 1]); `garbage` is painted where masks hide something."""
    home = Path(home)
    own.save_mesh(home / "scans/mesh_aligned_0.05.ply", of_room.vertices, of_room.faces)
    (home / "dslr/nerfstudio").mkdir(parents=True)
    frames, tests = [], []
    for i, (pose, picture) in enumerate(views):
        mask = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
        if i in MASKED:
            mask[HIDDEN] = 0
            picture = np.where(mask[..., None] > 0, picture, garbage)
        save_jpeg(home / "dslr/resized_images" / name(i), picture)
        save_mask(home / "dslr/resized_anon_masks" / name(i).replace(".JPG", ".png"), mask)
        entry = {"file_path": name(i), "transform_matrix": nerfstudio_matrix(pose).tolist(), "is_bad": i == BAD}
        (tests if i in TEST else frames).append({**entry, "mask_path": name(i).replace(".JPG", ".png")})
    document = {**own.intrinsics(CAMERA), "camera_model": "OPENCV_FISHEYE", "has_mask": True}
    document |= {f"k{i + 1}": k for i, k in enumerate(LENS.k)}
    document |= {"frames": frames, "test_frames": tests}
    (home / "dslr/nerfstudio/transforms.json").write_text(json.dumps(document))
    lists = {"train": [f["file_path"] for f in frames], "test": [f["file_path"] for f in tests], "has_masks": True}
    (home / "dslr/train_test_lists.json").write_text(json.dumps(lists))
    colmap_text(home / "dslr/colmap", of_room, [pose for pose, _ in views])
    segments(home / "scans", of_room)
    return home


def save_mask(path, mask):
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask).save(path)


def colmap_text(folder, of_room, poses, prefix=""):
    """cameras.txt, images.txt, points3D.txt: world-to-camera quaternions, mesh frame, points on the surface."""
    from scipy.spatial.transform import Rotation

    folder.mkdir(parents=True)
    k = " ".join(map(repr, LENS.k))
    lens = f"OPENCV_FISHEYE {CAMERA.width} {CAMERA.height} {CAMERA.fx} {CAMERA.fy} {CAMERA.cx} {CAMERA.cy} {k}"
    (folder / "cameras.txt").write_text(f"# one camera\n1 {lens}\n")
    from lab.rooms.coverage import surface_points

    points = surface_points(of_room, POINTS)
    shape = geometry(of_room)
    lines = ["# Image list", "# two lines an image"]
    for i, pose in enumerate(poses):
        w2c = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(w2c[:3, :3]).as_quat().tolist()
        numbers = [i + 1, w, x, y, z, *w2c[:3, 3], 1, prefix + name(i)]
        keypoints = []
        for j in np.flatnonzero(visible(shape, pose, points)):
            pixel = fisheye_pixel(points[j], pose)
            if (pixel > 1).all() and (pixel < [CAMERA.width - 1, CAMERA.height - 1]).all():
                keypoints += [*pixel, j + 1]
        keypoints += [5.0, 5.0, -1]
        lines += [" ".join(map(str, numbers)), " ".join(map(str, keypoints))]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{j + 1} {p[0]} {p[1]} {p[2]} 128 128 128 0.5 1 0" for j, p in enumerate(points)]
    (folder / "points3D.txt").write_text("# points\n" + "\n".join(rows) + "\n")


def visible(shape, pose, points):
    """(n,) bool: nothing is before the point."""
    from iif_core.light.transport.geometry import trace

    away = (points - pose[:3, 3]).astype(np.float32)
    face, t = trace(shape, pose[:3, 3], away)
    return (face >= 0) & (t > 0.995) & ((away @ pose[:3, 2]) > 0.05)


def segments(scans, of_room):
    """segments.json (two segments an object) and segments_anno.json; the rug stays without label."""
    owner = np.zeros(len(of_room.vertices), int)
    owner[of_room.faces.ravel()] = np.repeat(of_room.object_id, 3)
    middle = np.array([np.median(of_room.vertices[owner == o, 0]) for o in range(len(of_room.names))])
    index = 100 + 2 * owner + (of_room.vertices[:, 0] > middle[owner])
    (scans / "segments.json").write_text(json.dumps({"params": {}, "segIndices": index.tolist()}))
    groups = [
        {"id": o + 1, "objectId": o + 1, "label": label, "segments": [100 + 2 * o, 101 + 2 * o], "obb": {}}
        for o, label in enumerate(of_room.names)
        if label != UNLABELLED
    ]
    (scans / "segments_anno.json").write_text(json.dumps({"sceneId": "mini", "segGroups": groups}))


def twin(home, path, of_room, views):
    """The same photographs, cameras and objects as a `folder` scene: mesh frame, alpha instead of masks, ids in the PLY."""
    path = Path(path)
    instance = np.where(of_room.object_id == of_room.names.index(UNLABELLED), -1, of_room.object_id + 1)
    own.save_mesh(path / "mesh.ply", of_room.vertices, of_room.faces, instance)
    document = {**own.intrinsics(CAMERA), "camera_model": "OPENCV_FISHEYE", "frames": []}
    document |= {f"k{i + 1}": k for i, k in enumerate(LENS.k)}
    for i, (pose, _) in enumerate(views):
        if i == BAD:
            continue
        save_rgba(Path(home) / "dslr", path / f"images/DSC{i:05d}.png", i)
        document["frames"].append(own.frame(i, pose) | {"file_path": f"images/DSC{i:05d}.png"})
    files = [f["file_path"] for f in document["frames"]]
    document["test_filenames"] = [f"images/DSC{i:05d}.png" for i in TEST]
    document["train_filenames"] = [f for f in files if f not in document["test_filenames"]]
    own.write_transforms(path, document)


def save_rgba(dslr, path, i):
    """The released photograph as png, its mask as alpha."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.open(dslr / "resized_images" / name(i)).convert("RGB")
    picture.putalpha(Image.open(dslr / "resized_anon_masks" / name(i).replace(".JPG", ".png")))
    picture.save(path)
