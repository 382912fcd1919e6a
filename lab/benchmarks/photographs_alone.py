"""Rooms of the laboratory from photographs alone, next to the truth and to the same with their cameras and mesh.

    python lab/benchmarks/photographs_alone.py FOLDER ROOM [ROOM ...] [--views 40] [--width 640] [--height 480] [--keep]

Photographs a built-in room as people are asked to, on a walk along its walls, and as cameras do (exposure, white balance, blur,
noise), saves the photographs as JPEG without anything else, and lets the product make the scene of them (`kind: photographs`,
with the height of the room) and of the same photographs with true cameras and mesh (`kind: folder`), up to the scores. FOLDER
keeps all of it, and what is finished is not made again. `--keep` adds the rows to lab/notebook/data/photographs_alone.csv.

Cameras are compared after the similarity that fits their places best; the error of the metre is that of the similarity. The mesh
is moved by it, and its error is the distance of points on it from the true surface; *complete* is the share of the true surface
with mesh within 5 cm. Depth as seen is along the rays of the true cameras. Albedo is that of the fit in the photographs that it
used.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import trimesh
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import lab  # noqa: F401  for the sources of the laboratory
from lab import rooms
from lab.loose import Loose, document_of
from lab.packing import pack
from lab.rooms.room import Room
from lab.sources.builtin import photograph_room
from workflow.artifacts import StageReader
from workflow.artifacts.files import read_exr
from workflow.runtime import native
from workflow.scene.normal_form import CaptureReader

REPOSITORY = Path(__file__).resolve().parents[2]
FILE = REPOSITORY / "lab/notebook/data/photographs_alone.csv"
JPEG = 92
NEAR = 0.05
SAMPLES, RAYS = 40_000, 4_000
KINDS = ("alone", "given")


def make(folder: Path, *targets: str) -> None:
    """Run Snakemake in `folder`; raises with its last words if it fails."""
    command = [str(Path(sys.executable).with_name("snakemake")), "-s", str(REPOSITORY / "lab/Snakefile"), "-d", str(folder)]
    done = subprocess.run([*command, "--cores", "2", *targets], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])


def walk(room: Room, count: int) -> np.ndarray:
    """Return positions and targets (count, 2, 3) of a walk around a room, looking across it, as the guide asks people to.

    Cameras stand on an ellipse, as near to the walls as furniture allows, between 1 and 1.6 m high.
    """
    half, shots = room.size / 2, []
    for a in 2 * np.pi * np.arange(count) / count:
        target = half - (0.76, 0.88, 0.12) * half * (np.cos(a + 0.5), np.sin(a + 0.5), -4.8 * np.sin(2 * a + 1))
        tall = 1.3 + 0.3 * np.sin(3 * a)
        for share in np.arange(0.7, 0.1, -0.05):
            eye = np.array([half[0] * (1 + share * np.cos(a)), half[1] * (1 + share * np.sin(a)), tall])
            if room.is_free(eye):
                break
        shots.append((eye, target))
    return np.array(shots)


def photographed(folder: Path, room: str, views: int, width: int, height: int) -> Path:
    """Return the folder of the packed capture of a room, beside which the JPEGs lie in `<room>-alone`."""
    packed, alone = folder / "data" / room, folder / "data" / f"{room}-alone"
    if not (packed / "mesh.ply").is_file():
        effects = {name: False for name in ("cameras", "mesh", "unguided", "jpeg")}  # the truth stays true
        capture = {"realism": {**effects, "reduced": 1}, "dynamic_range": "ldr", "samples": 32, "denoise": True}
        capture |= {"views": views, "width": width, "height": height}
        loose = Loose(
            folder / "rooms" / room, document_of({"source": {"kind": "builtin", "scene": room}, "capture": capture}), room
        )
        job, made = loose.job("capture", 2), rooms.build(room)
        photograph_room(job, replace(made, shots=walk(made, views)))
        job.writer.finish()
        pack(folder / "rooms" / room / "capture", packed)
    alone.mkdir(parents=True, exist_ok=True)
    for path in sorted((packed / "images").glob("*.png")):
        target = alone / f"{path.stem}.jpg"
        if not target.is_file():
            Image.open(path).convert("RGB").save(target, quality=JPEG)
    return packed


def similarity(found: np.ndarray, true: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return s, R, t of the least squares of s R found + t - true, places (n, 3) (Umeyama 1991)."""
    a, b = found - found.mean(0), true - true.mean(0)
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ np.diag(sign) @ vt
    scale = float((d * sign).sum() / (a * a).sum())
    return scale, turn, true.mean(0) - scale * turn @ found.mean(0)


def scene_of(vertices: np.ndarray, faces: np.ndarray) -> Any:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    mesh = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.int32)))
    scene.add_triangles(mesh)
    return scene


def distances(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    import open3d as o3d

    return scene_of(vertices, faces).compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()


def geometry(packed: Path, made: Path) -> dict[str, float]:
    """Return how far cameras and mesh of stage reconstruction (`made`) are from those of the packed capture."""
    truth, found = (json.loads((path / "transforms.json").read_text()) for path in (packed, made))
    poses = {Path(frame["file_path"]).stem: np.array(frame["transform_matrix"]) for frame in truth["frames"]}
    names = [Path(frame["file_path"]).stem for frame in found["frames"]]
    true, own = np.array([poses[name] for name in names]), np.array([frame["transform_matrix"] for frame in found["frames"]])
    scale, turn, shift = similarity(own[:, :3, 3], true[:, :3, 3])
    cosine = (np.einsum("nij,nij->n", turn @ own[:, :3, :3], true[:, :3, :3]) - 1) / 2
    angles = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    places = np.linalg.norm(scale * own[:, :3, 3] @ turn.T + shift - true[:, :3, 3], axis=1)
    room, mesh = (trimesh.load(path / "mesh.ply", process=False) for path in (packed, made))
    moved = scale * np.asarray(mesh.vertices) @ turn.T + shift
    on_mesh = trimesh.sample.sample_surface(trimesh.Trimesh(moved, mesh.faces, process=False), SAMPLES, seed=0)[0]
    on_room = trimesh.sample.sample_surface(trimesh.Trimesh(room.vertices, room.faces, process=False), SAMPLES, seed=0)[0]
    error, missing = distances(on_mesh, room.vertices, room.faces), distances(on_room, moved, mesh.faces)
    seen = [_along_rays(frame, room, moved, mesh.faces) for frame in truth["frames"]]
    depth = np.concatenate([np.abs(a - b)[np.isfinite(a) & np.isfinite(b)] for a, b in seen])
    diagonal = float(np.linalg.norm(np.ptp(room.vertices, axis=0)))
    return {
        "photographs": len(poses),
        "placed": len(names),
        "angle": float(np.median(angles)),
        "angle_most": float(angles.max()),
        "place": float(np.median(places)),
        "place_most": float(places.max()),
        "place_most_of_room": float(places.max() / diagonal),
        "metre": abs(scale - 1),
        "mesh": float(np.median(error)),
        "mesh_90": float(np.quantile(error, 0.9)),
        "complete": float((missing < NEAR).mean()),
        "depth": float(np.median(depth)),
        "depth_90": float(np.quantile(depth, 0.9)),
        "no_surface": float(np.mean([(~np.isfinite(b) & np.isfinite(a)).mean() for a, b in seen])),
    }


def _along_rays(frame: dict[str, Any], room: Any, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances of the true and of the found surface along some rays of a true camera."""
    import open3d as o3d

    rng, pose = np.random.default_rng(0), np.array(frame["transform_matrix"])
    x, y = rng.uniform(0, frame["w"], RAYS), rng.uniform(0, frame["h"], RAYS)
    rays = np.stack([(x - frame["cx"]) / frame["fl_x"], -(y - frame["cy"]) / frame["fl_y"], -np.ones(RAYS)], 1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    both = o3d.core.Tensor(np.concatenate([np.repeat(pose[None, :3, 3], RAYS, 0), rays], 1).astype(np.float32))
    return tuple(
        scene_of(np.asarray(v), f).cast_rays(both)["t_hit"].numpy() for v, f in ((room.vertices, room.faces), (vertices, faces))
    )


def materials(packed: Path, results: Path, scene: str) -> dict[str, float]:
    """Return the accuracy of the albedo of the fit in its photographs, dB, and of the re-renderings."""
    capture = CaptureReader(StageReader(results / scene / "capture", "capture", scene))
    found, true = [], []
    for view in capture.used:
        maps = read_exr(results / scene / f"affines/maps/{view.name}.exr")
        own = np.stack([maps[f"albedo.{c}"] for c in "RGB"], -1).astype(np.float64)
        truth = read_exr(packed / f"truth/albedo/{view.name}.exr")
        height, width = own.shape[:2]
        wanted = [Image.fromarray(truth[c].astype(np.float32)).resize((width, height), Image.Resampling.BOX) for c in "RGB"]
        wanted = np.stack([np.asarray(channel) for channel in wanted], -1)
        _, face = capture.gbuffer(view)
        # No emitter, which has no albedo, and nothing that is not finite.
        kept = (face >= 0) & (wanted.max(-1) > 0.01) & np.isfinite(own).all(-1) & np.isfinite(wanted).all(-1)
        found.append(own[kept])
        true.append(wanted[kept])
    a, b = np.concatenate(found), np.concatenate(true)
    level = float((a * b).sum() / (a * a).sum())
    scores = pd.read_parquet(results / scene / "metrics/metrics.parquet")
    rgb = scores[(scores["quantity"] == "rgb") & (scores["metric"] == "psnr")]["value"]
    return {"albedo": _db(a, b), "albedo_scaled": _db(level * a, b), "rendered": float(rgb.mean())}


def _db(found: np.ndarray, true: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(np.clip(found, 0, 1) - true).mean()))


def row_of(folder: Path, room: str, views: int, width: int, height: int) -> dict[str, Any]:
    """Make a room both ways and return what there is to say of them."""
    packed = photographed(folder, room, views, width, height)
    tall = float(rooms.build(room).size[2])
    sources = {
        "alone": f"{{kind: photographs, path: data/{room}-alone, room_height: {tall:.3f}}}",
        "given": f"{{kind: folder, path: data/{room}}}",
    }
    for kind in KINDS:
        text = f"source: {sources[kind]}\ncapture: {{exposure: estimate}}\n"
        path = folder / f"config/scenes/{room}-{kind}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        make(folder, f"results/{room}-{kind}/metrics/manifest.json")
    results = folder / "results"
    job = json.loads((results / f"{room}-alone/benchmarks/reconstruction.parts.json").read_text())["job"]
    found = geometry(packed, results / f"{room}-alone/reconstruction")
    for kind in KINDS:
        found |= {f"{name}_{kind}": value for name, value in materials(packed, results, f"{room}-{kind}").items()}
    cost = {"cpu_seconds": job["cpu_seconds"], "seconds": job["seconds"], "memory_mb": job["max_rss_mb"]}
    return {"room": room, "width": width, "height": height, **{name: f"{value:.4g}" for name, value in (found | cost).items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("rooms", nargs="+")
    for name, default in (("views", 40), ("width", 640), ("height", 480)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--keep", action="store_true")
    options = parser.parse_args()
    native.prepare()
    for room in options.rooms:
        row = row_of(options.folder.resolve(), room, options.views, options.width, options.height)
        print(json.dumps(row), flush=True)
        if options.keep:
            known = list(csv.DictReader(FILE.open())) if FILE.is_file() else []
            rows = sorted([*(one for one in known if one["room"] != room), row], key=lambda one: one["room"])
            with FILE.open("w", newline="") as file:
                writer = csv.DictWriter(file, list(row), lineterminator="\n")
                writer.writeheader()
                writer.writerows(rows)


if __name__ == "__main__":
    main()
