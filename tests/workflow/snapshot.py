"""Snapshot of the tiny scene's rule outputs, in three tiers. Rewrite with: python tests/workflow/snapshot.py <run folder>."""

import json
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

PATH = Path(__file__).with_name("snapshot.json")


def take(folder: Path) -> dict:
    """exact: numbers that may not move; tolerance: [value, allowed]; structure: which files, columns and channels there are."""
    root = folder / "results/tiny"
    exact, tolerance, structure = {}, {}, {}
    for path in sorted(root.glob("*/manifest.json")):
        stage = path.parent.name
        files = json.loads(path.read_text())["files"]
        structure[stage] = {
            name: sorted(facts.get("channels", {})) for name, facts in files.items() if not name.startswith("pictures/")
        }
    for name in ("capture/faces", "capture/cameras", "segmentation/objects", "segmentation/segments", "base/cells"):
        exact[name] = pq.read_metadata(root / f"{name}.parquet").num_rows
    faces = pq.read_table(root / "segmentation/faces.parquet").to_pandas()
    exact["faces per object"] = np.bincount(faces["object_id"]).tolist()
    segments = pq.read_table(root / "segmentation/segments.parquet").to_pandas()
    exact["pixels per segment"] = segments["pixels"].tolist()

    cells = pq.read_table(root / "base/cells.parquet").to_pandas()
    for name in ("albedo_r", "albedo_g", "albedo_b", "roughness", "metallic"):
        tolerance[f"base/{name}"] = [round(float(cells[name].mean()), 4), 0.02]
    emitters = pq.read_table(root / "emission/emitters.parquet").to_pandas()
    exact["emitters"] = len(emitters)
    kept = emitters[emitters["kept"].astype(bool)]
    power = float((kept["area_m2"] * kept["radiance_g"]).sum())
    tolerance["emission/power"] = [round(power, 4), round(0.15 * power, 4)]
    metrics = pq.read_table(root / "metrics/metrics.parquet").to_pandas()
    means = metrics.groupby(["quantity", "metric", "protocol"])["value"].mean()
    for key in (("albedo", "psnr", "scaled"), ("albedo", "psnr", "raw"), ("rgb", "psnr", "raw")):
        tolerance["/".join(key)] = [round(float(means[key]), 2), 2.0]
    return {"exact": exact, "tolerance": tolerance, "structure": structure}


if __name__ == "__main__":
    PATH.write_text(json.dumps(take(Path(sys.argv[1])), indent=1, sort_keys=True) + "\n")
