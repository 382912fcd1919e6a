"""What the photographs of a rendered room show without any model of light, next to the result (docs/method/evaluation.md#rivals).

    python lab/benchmarks/rivals.py kitchen--rooms_learned-raw-s0 ... [--quality draft] [--output FILE.csv]

Run it in the working folder of finished scenes. Every photograph is predicted by the others, by their mean and by a blend of the
nearest, and scored like its re-rendering, which has the advantage that the fit has seen it. Prints PSNR of sensor values in dB,
means over the photographs, and writes one row a scene.
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import numpy as np

import lab  # noqa: F401  for the sources of the laboratory
from iif_core.evaluation import metrics
from workflow.artifacts.store import rgb
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader
from workflow.scoring.rivals import OtherPhotographs

VARIANTS = ("result", "photo_mean", "photo_nearest")


def scores(scene: str, quality: str) -> dict[str, float]:
    """Return the mean PSNR of each of `VARIANTS`."""
    job = Job("metrics", scene, quality, 1)
    capture = CaptureReader(job.read("capture"))
    others, found = OtherPhotographs(job, capture), {name: [] for name in VARIANTS}
    for view in capture.used:
        (photo, valid), (_, face) = capture.photo(view), capture.gbuffer(view)
        counted = valid & (face >= 0)
        target = metrics.Target("rgb", photo, counted, encoded=True, networks={})
        pictures = {"result": rgb(job.read("render").exr(f"maps/{view.name}.exr"), "ldr")}
        pictures |= dict(others.predictions(view, photo, counted))
        for name, picture in pictures.items():
            found[name] += [s.value for s in target.scores(picture, ("psnr",)) if s.protocol == "raw"]
    return {name: round(float(np.mean(values)), 3) for name, values in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args()
    rows = []
    for scene in asked.scenes:
        rows.append({"scene": scene} | scores(scene, asked.quality))
        print(rows[-1], flush=True)
    if asked.output:
        with asked.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, ("scene", *VARIANTS), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
