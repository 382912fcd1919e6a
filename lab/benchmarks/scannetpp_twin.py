"""The same room as a ScanNet++ release and as `folder` scenes: how far apart are the materials?

    python lab/benchmarks/scannetpp_twin.py --work /tmp/twin --output results/studies/scannetpp_twin.json

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

from iif_core.camera.distortion import Distortion, Pinhole, pinhole_inside, undistort_image
from tests.unit import own_scene as own
from tests.unit import scannetpp_scene as mini
from workflow.runtime import native

STAGES = ("capture", "prior", "segmentation", "base", "emission", "shading", "affines")


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
    views = mini.traced(room, options.views, options.samples)
    home = mini.release(options.work / "data/release", room, views)
    own.project(options.work / "a", {"kind": "scannetpp", "path": str(home)}, capture, {"kind": "given"})
    path = own.project(options.work / "b", None, capture, {"kind": "given"})
    mini.twin(home, path, room, views)
    camera = pinhole_inside(mini.LENS, mini.CAMERA)
    ideal = mini.traced(room, options.views, options.samples, camera, Distortion("radial_tangential"))
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
