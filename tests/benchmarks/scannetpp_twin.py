"""The same room as a ScanNet++ release and as `folder` scenes: how far apart are the materials?

    python tests/benchmarks/scannetpp_twin.py --work /tmp/twin --output results/studies/scannetpp_twin.json

The tiny room is path traced through a fisheye and written twice: as a release, and as a folder (same photographs; poses in the
mesh's frame, masks as alpha, ids in the mesh). A third scene is photographed by a perfect pinhole camera at the same places:
what resampling and other noise cost. A fourth is the release with noise written where its masks hide something: what is hidden
must leave no trace. Mean and largest absolute difference of albedo, roughness and metallic (base and final maps), over
pixels that see the mesh; prior `retinex`, segmentation `given`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from iif_core.camera.distortion import Distortion, Pinhole, pinhole_inside, undistort, undistort_image
from tests.unit import own_scene as own
from tests.unit import scannetpp_scene as mini
from workflow.runtime import native

STAGES = ("capture", "prior", "segmentation", "base", "emission", "shading", "affines")


def directions(camera: Pinhole, lens: Distortion, pose: np.ndarray) -> np.ndarray:
    """(H W, 3) float32 world directions of the pixel centres."""
    u = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    at = np.stack(np.meshgrid(u, v), -1)
    at = at if lens.is_identity else undistort(lens, at)[0]
    local = np.concatenate([at, np.ones((*at.shape[:2], 1))], -1)
    return (local @ pose[:3, :3].T).reshape(-1, 3).astype(np.float32)


def photographs(room, count: int, camera: Pinhole, lens: Distortion, samples: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """(pose, picture in [0, 1]) with one exposure for all views."""
    from iif_core.camera.simulation import expose, response_curve
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene

    geometry = mini.geometry(room)
    native.limit_threads(1)
    emitters = Emitters(geometry, room.emission, np.ones(len(room.faces), np.int8))
    material, curve = room.materials.drjit(), response_curve("filmic")
    out = []
    for i, pose in enumerate(room.cameras(count)):
        rays = directions(camera, lens, pose)
        radiance = render(Scene(geometry, material, emitters), pose[:3, 3], rays, PathOptions(samples, 12, 1000 + i))
        picture = expose(radiance, 0.6, curve).reshape(camera.height, camera.width, 3)
        out.append((pose, picture))
    return out


def pinhole_folder(path: Path, room, views, camera: Pinhole) -> None:
    """The folder of `mini.twin` with photographs of a pinhole camera."""
    shutil.rmtree(path / "images")
    document = json.loads((path / "transforms.json").read_text())
    document |= {**own.intrinsics(camera), "camera_model": "PINHOLE", "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0}
    for entry in document["frames"]:
        i = int(Path(entry["file_path"]).stem[3:])
        mask = np.ones((mini.CAMERA.height, mini.CAMERA.width), bool)
        if i in mini.MASKED:
            mask[mini.HIDDEN] = False
        _, seen = undistort_image(mask, mini.LENS, mini.CAMERA, camera, mask)
        rgba = np.concatenate([views[i][1], seen[..., None]], -1)
        (path / entry["file_path"]).parent.mkdir(exist_ok=True)
        Image.fromarray(np.rint(np.clip(rgba, 0, 1) * 255).astype(np.uint8)).save(path / entry["file_path"])
    own.write_transforms(path, document)


@contextmanager
def noise_under_masks() -> Iterator[None]:
    """The capture writes noise, instead of 0, where pixels do not count."""
    from workflow.scene.normal_form import CaptureWriter

    write = CaptureWriter.photo

    def noisy(self, name, image, valid=None, encoded=True):
        noise = np.random.default_rng(len(name)).random(image.shape)
        write(self, name, np.where(valid[..., None], image, noise).astype(np.float32), valid, encoded)

    CaptureWriter.photo = noisy
    try:
        yield
    finally:
        CaptureWriter.photo = write


def maps(root: Path, stage: str) -> dict[str, dict[str, np.ndarray]]:
    """View -> channel -> picture of the training views."""
    from workflow.artifacts.files import read_exr

    return {p.stem: read_exr(p) for p in sorted((root / "results/own" / stage / "maps").glob("*.exr"))}


def differences(a: Path, b: Path) -> dict[str, dict[str, float]]:
    """Mean and largest absolute difference a stage and property."""
    out = {}
    for stage, names in (
        ("base", ("albedo", "roughness", "metallic")),
        ("affines", ("albedo", "roughness", "metallic")),
    ):
        ours, theirs = maps(a, stage), maps(b, stage)
        if set(ours) != set(theirs):
            raise SystemExit(f"views differ: {sorted(ours)}, {sorted(theirs)}")
        for name in names:
            gaps = [
                np.abs(ours[view][channel] - theirs[view][channel]).ravel()
                for view in ours
                for channel in ours[view]
                if channel == name or channel.startswith(f"{name}.")
            ]
            joined = np.concatenate(gaps)
            out[f"{stage}.{name}"] = {"mean": float(joined.mean()), "max": float(joined.max())}
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--samples", type=int, default=256)
    options = parser.parse_args()
    native.prepare()
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    room, capture = mini.room(), {"width": 128, "height": 128, "views": options.views}
    views = photographs(room, options.views, mini.CAMERA, mini.LENS, options.samples)
    home = mini.release(options.work / "data/release", room, views)
    own.project(options.work / "a", {"kind": "scannetpp", "path": str(home)}, capture, {"kind": "given"})
    path = own.project(options.work / "b", None, capture, {"kind": "given"})
    mini.twin(home, path, room, views)
    camera = pinhole_inside(mini.LENS, mini.CAMERA)
    ideal = photographs(room, options.views, camera, Distortion("radial_tangential"), options.samples)
    path = own.project(options.work / "c", None, capture, {"kind": "given"})
    mini.twin(home, path, room, views)
    pinhole_folder(path, room, ideal, camera)
    own.project(options.work / "d", {"kind": "scannetpp", "path": str(home)}, capture, {"kind": "given"})
    for name in "abc":
        own.run(options.work / name, *STAGES)
    with noise_under_masks():
        own.run(options.work / "d", *STAGES)
    names = {"b": "same photographs", "c": "pinhole photographs", "d": "noise under masks"}
    found = {text: differences(options.work / "a", options.work / name) for name, text in names.items()}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
