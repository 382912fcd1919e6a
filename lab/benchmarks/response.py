"""How well the camera response comes back from shared surface: RMS per curve, scene and number of rows.

    python lab/benchmarks/response.py kitchen country-kitchen --output results/studies/response.parquet

Rendered radiance of finished captures (results/<scene>/capture, any dynamic range, with truth) is photographed again through
each curve at the capture's exposures, rounded to 8 bits, and calibrated from nothing else than mesh, cameras and exposures.
`rms` is per cent of the range, the worst channel; `rms_scaled` after the best factor on x, which light absorbs; `cpu_seconds`
of one thread for the choice among all families.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from iif_core.camera.calibration.choice import CANDIDATES, calibrate_response
from iif_core.camera.overlap import PatchRows, join_rows, patch_edge, patch_numbers, patch_rows
from iif_core.camera.response import Response, response
from iif_core.surface.cells import grid_origin
from iif_core.surface.triangles import face_geometry
from lab.simulated.photographs import expose, response_curve
from workflow.artifacts import StageReader
from workflow.scene.normal_form import CaptureReader

Curve = Callable[[np.ndarray], np.ndarray]
CURVES: dict[str, Curve] = {
    "gamma 1.9": response("gamma", np.array([1.9])),
    **{name: response_curve(name) for name in ("srgb", "filmic", "soft")},
}
X = np.linspace(0, 1, 101)[:, None].repeat(3, 1)


def photographs(scene: str) -> tuple[list[dict[str, np.ndarray]], np.ndarray]:
    """Per view radiance, patch, object and normal of the pixels inside objects; exposures (V,)."""
    capture = CaptureReader(StageReader(Path("results") / scene / "capture", "capture", scene))
    vertices, faces = capture.mesh()
    normals, owner = face_geometry(vertices, faces)[0], capture.faces()["instance_id"]
    depths = [capture.gbuffer(view)[0] for view in capture.views]
    edge = patch_edge(float(np.median([np.median(d[d > 0]) / v.fx for d, v in zip(depths, capture.views, strict=True)])))
    origin = grid_origin(vertices[faces.ravel()], edge)
    out = []
    for view, depth in zip(capture.views, depths, strict=True):
        face, valid = capture.gbuffer(view)[1], capture.photo(view)[1]
        object_id = np.where(face >= 0, owner[np.maximum(face, 0)], -2)
        near = [np.roll(object_id, (dy, dx), (0, 1)) == object_id for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        use = valid & (face >= 0) & (depth > 0) & np.logical_and.reduce(near)
        points = capture.points(view, depth)[use]
        facing = points - view.world_from_camera[:3, 3]
        normal = normals[face[use]]
        normal = np.where(np.einsum("ij,ij->i", normal, facing)[:, None] > 0, -normal, normal)
        patch = patch_numbers(points, object_id[use], edge, origin)
        radiance = capture.truth(view).radiance[use]
        out.append({"radiance": radiance, "patch": patch, "normal": normal, "object": object_id[use]})
    return out, capture.exposures()


def rows_through(views: list[dict[str, np.ndarray]], exposure: np.ndarray, curve: Curve) -> PatchRows:
    """What the calibration sees of the scene through a curve."""
    parts = [
        patch_rows(v["patch"], v["normal"], v["object"], expose(v["radiance"], float(e), curve), number)
        for number, (v, e) in enumerate(zip(views, exposure, strict=True))
    ]
    return join_rows(parts)


def errors(found: Response, truth: Curve) -> tuple[float, float]:
    """RMS in per cent of the worst channel: as it is, and after the best factor on x."""
    target, scales = truth(X), np.linspace(0.8, 1.25, 91)
    plain = np.sqrt(np.mean((found(X) - target) ** 2, 0))
    scaled = np.min([np.sqrt(np.mean((np.minimum(found(s * X), 1.0) - target) ** 2, 0)) for s in scales], 0)
    return 100 * float(plain.max()), 100 * float(scaled.max())


def measure(scenes: list[str], shares: list[float], seeds: int) -> list[dict[str, Any]]:
    """One row a scene, curve, share of the patches and seed (which patches)."""
    table = []
    for scene in scenes:
        views, exposure = photographs(scene)
        for name, curve in CURVES.items():
            rows = rows_through(views, exposure, curve)
            patches = int(rows.patch.max()) + 1
            for share in shares:
                for seed in range(seeds if share < 1 else 1):
                    keep = np.random.default_rng([seed, 0x7265]).random(patches) < share
                    some = rows.take(np.flatnonzero(keep[rows.patch]))
                    start = time.process_time()
                    found = calibrate_response(some, exposure, CANDIDATES)
                    seconds = time.process_time() - start
                    plain, scaled = errors(found.response, curve)
                    row = {"scene": scene, "curve": name, "patches": int(keep.sum()), "seed": seed, "rows": found.rows}
                    row |= {"family": found.response.family, "rms": plain, "rms_scaled": scaled, "cpu_seconds": seconds}
                    table.append(row)
                    print({key: round(v, 3) if isinstance(v, float) else v for key, v in row.items()}, flush=True)
    return table


def main() -> None:
    """Measure, print, write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--shares", type=float, nargs="+", default=[1.0, 0.1, 0.02])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    import pandas as pd

    frame = pd.DataFrame(measure(arguments.scenes, arguments.shares, arguments.seeds))
    print(frame.groupby(["scene", "curve", "patches"])[["rms", "rms_scaled", "cpu_seconds"]].mean().round(3).to_string())
    if arguments.output:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        frame.to_parquet(arguments.output)


if __name__ == "__main__":
    main()
