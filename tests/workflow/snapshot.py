"""Snapshot of rule outputs: files, counts and scores. Rewrite it from finished runs, and read the difference before committing:

python tests/workflow/snapshot.py <folder of the run of tiny> <folder of the run of kitchen>
"""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

PATH = Path(__file__).with_name("snapshot.json")
DECIBELS = 0.3
"""How far a score may move: PSNR directly, errors as 10 log10 of their ratio. Machines differ by less."""
FLOOR = 1e-4
"""Errors below it count as this much, so that two results without an error agree."""
LARGER_IS_BETTER = ("psnr", "iou")
GATED = (
    ("albedo", "psnr", "raw"),
    ("albedo", "psnr", "scaled"),
    ("albedo", "lpips", "raw"),
    ("rgb", "psnr", "raw"),
    ("rgb", "lpips", "raw"),
    ("roughness", "l2", "raw"),
    ("metallic", "l2", "raw"),
    ("emission", "log_l2", "raw"),
    ("emission", "iou", "raw"),
)
"""Scores that may not move; LPIPS needs pictures of 64 pixels, which tiny does not have."""


def take(folder: Path, scene: str) -> dict:
    """Files and channels of every stage (of tiny alone), counts that may not move at all, and scores as means over the views."""
    root = folder / "results" / scene
    structure, counts = {}, {}
    for path in sorted(root.glob("*/manifest.json")) if scene == "tiny" else ():
        if path.parent.name == "relight":  # made on demand
            continue
        files = json.loads(path.read_text())["files"]
        structure[path.parent.name] = {
            name: sorted(facts.get("channels", {})) for name, facts in files.items() if not name.startswith("pictures/")
        }
    for name in ("capture/faces", "capture/cameras", "segmentation/objects", "segmentation/segments", "base/cells"):
        counts[name] = pq.read_metadata(root / f"{name}.parquet").num_rows
    faces = pq.read_table(root / "segmentation/faces.parquet").to_pandas()
    counts["faces per object"] = np.bincount(faces["object_id"]).tolist()
    emitters = pq.read_table(root / "emission/emitters.parquet").to_pandas()
    counts["emitters"], counts["emitters kept"] = len(emitters), int(emitters["kept"].sum())
    metrics = pq.read_table(root / "metrics/metrics.parquet").to_pandas()
    means = metrics.groupby(["quantity", "metric", "protocol"])["value"].mean()
    scores = {"/".join(key): float(means[key]) for key in GATED if key in means.index}
    return {"counts": counts, "scores": scores, "structure": structure}


def moved(name: str, found: float, expected: float) -> float:
    """By how many decibels a score has moved, without its sign."""
    if name.split("/")[1] == "psnr":
        return abs(found - expected)
    return abs(10 * math.log10(max(found, FLOOR) / max(expected, FLOOR)))


def worsened(name: str, found: float, expected: float) -> float:
    """By how many decibels a score has become worse; 0 if it has become better."""
    larger_is_better = name.split("/")[1] in LARGER_IS_BETTER
    return moved(name, found, expected) if (found < expected) == larger_is_better else 0.0


if __name__ == "__main__":
    document = {scene: take(Path(folder), scene) for scene, folder in zip(("tiny", "kitchen"), sys.argv[1:], strict=True)}
    document["kitchen"] = {"scores": document["kitchen"]["scores"]}  # its counts differ from machine to machine
    PATH.write_text(json.dumps(document, indent=1, sort_keys=True) + "\n")
