"""Whether the 95 % intervals of `objects.csv` hold the truth.

    python lab/benchmarks/object_intervals.py kitchen modern-hall country-kitchen [--quality draft] [--pixels 100]

Run it in a working folder where the scenes, which need a truth, are finished. The truth of an object is the mean of the true map
over all its pixels that count in stage `metrics`; objects with fewer pixels, or without an interval, are left out. Rows are
kept in lab/notebook/data/object_intervals.json, and the table of lab/notebook/intervals.md is made anew.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import numpy as np

import lab  # noqa: F401  for the sources of the laboratory

ROWS, PAGE = Path("lab/notebook/data/object_intervals.json"), Path("lab/notebook/intervals.md")


def truths(job: Any) -> dict[str, dict[int, tuple[int, np.ndarray]]]:
    """Quantity -> object -> number of pixels and mean of the true map."""
    from workflow.scene.normal_form import CaptureReader
    from workflow.scoring.scores import material_truth

    capture, segmentation = CaptureReader(job.read("capture")), job.read("segmentation")
    sums: dict[str, dict[int, list[Any]]] = {"albedo": {}, "roughness": {}}
    for view in capture.views:
        truth = material_truth(capture, segmentation, view)
        for quantity, found in sums.items():
            mask = truth.masks[quantity] & (truth.object_id >= 0)
            values, owner = truth.targets[quantity].truth[mask].reshape(mask.sum(), -1), truth.object_id[mask]
            for number in np.unique(owner).tolist():
                own = owner == number
                entry = found.setdefault(number, [0, 0.0])
                entry[0] += int(own.sum())
                entry[1] = entry[1] + values[own].sum(0, dtype=np.float64)
    return {q: {o: (count, total / count) for o, (count, total) in found.items()} for q, found in sums.items()}


def measured(scene: str, quality: str, pixels: int) -> dict[str, Any]:
    """The row of one scene."""
    from workflow.exporters.object_table import read_csv
    from workflow.runtime.job import Job

    job = Job("publish", scene, quality, 1)
    rows = read_csv(job.read("export").path("objects.csv").read_bytes())
    true = truths(job)
    inside: dict[str, list[bool]] = {"albedo": [], "channels": [], "roughness": []}
    errors, widths = [], []
    for row in rows:
        number = int(row["object_id"])
        count, mean = true["albedo"].get(number, (0, None))
        if count >= pixels and row["base_colour_r_low"]:
            value, low, high = (np.array([float(row[f"base_colour_{c}{end}"]) for c in "rgb"]) for end in ("", "_low", "_high"))
            inside["channels"] += ((low <= mean) & (mean <= high)).tolist()
            wide = float(np.log(value.max() / low[value.argmax()]))  # of the level, which all channels share
            errors.append(abs(float(np.log(mean.mean() / value.mean()))))
            widths.append(wide)
            inside["albedo"].append(errors[-1] <= wide)
        count, mean = true["roughness"].get(number, (0, None))
        if count >= pixels and row["roughness_low"]:
            inside["roughness"].append(float(row["roughness_low"]) <= mean[0] <= float(row["roughness_high"]))
    shares = {f"{name}_inside": float(np.mean(found)) for name, found in inside.items()}
    numbers = {"objects": len(errors), "with_roughness": len(inside["roughness"])}
    quantiles = {f"error_{round(100 * q)}": float(np.quantile(errors, q)) for q in (0.5, 0.9)}
    return {"scene": scene} | numbers | shares | quantiles | {"half_width": float(np.median(widths))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--pixels", type=int, default=100)
    asked = parser.parse_args()
    from workflow.report.blocks import fill, markdown

    rows = json.loads(ROWS.read_text()) if ROWS.is_file() else []
    for scene in asked.scenes:
        row = measured(scene, asked.quality, asked.pixels)
        print(row)
        rows = sorted([other for other in rows if other["scene"] != scene] + [row], key=lambda row: row["scene"])
        ROWS.write_text(json.dumps(rows, indent=1) + "\n")
    shown = [
        [
            row["scene"],
            f"{row['objects']}",
            *(f"{100 * row[name]:.0f} %" for name in ("albedo_inside", "channels_inside", "roughness_inside")),
            f"{100 * np.expm1(row['half_width']):.0f} %",
            *(f"{100 * np.expm1(row[name]):.0f} %" for name in ("error_50", "error_90")),
        ]
        for row in rows
    ]
    heads = ["scene", "objects", "brightness", "R, G, B by themselves", "roughness", "half the interval", "error, median"]
    table = "\n".join(markdown([*heads, "error, 90 % of the objects"], shown))
    PAGE.write_text(fill(PAGE.read_text(), {"intervals": table}))


if __name__ == "__main__":
    main()
