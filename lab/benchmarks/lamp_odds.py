"""The numbers of the probability of a lamp (docs/method/light.md#probability-of-a-lamp), from drawn rooms.

    python lab/benchmarks/lamp_odds.py 16 17 ... [--variant ours] [--quality draft]

Run it in the working folder, with drawn rooms whose light is finished. Lamps of one kind count once. It prints the numbers of
`iif_core.light.emission.odds.PROBABILITY` fitted to these rooms, and how often claims hold in rooms that did not fit them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import numpy as np

import lab  # noqa: F401  for the sources of the laboratory
from iif_core.light.emission.odds import PROBABILITY, LampEvidence
from lab.benchmarks import logistic
from lab.benchmarks.drawn_rooms import THROUGH, scene_of
from lab.prior import drawn
from workflow.runtime import native

Array = np.ndarray
NAMES = ("constant", "overhead and saturated", "seen, saturated", "unseen", "needed")
FALSE = 0.5
"""Share of the area of an emitter that is no lamp, from which the emitter is none."""


def emitters_of(number: int, variant: str, quality: str) -> tuple[Array, Array]:
    """Return the columns (n, 4) of the emitters of a room that may be lamps, and which of them are (n,); lamps of one kind that
    look alike count once. Of a room with curtains, which are lit and light at once, there are none."""
    from lab.rooms.lamps_found import lamps_found
    from workflow.runtime.job import Job
    from workflow.scene.normal_form import CaptureReader

    room = drawn.build(number)
    if any(name.split(" ")[0] in THROUGH for name in room.names):
        return np.zeros((0, 4)), np.zeros(0, bool)
    job = Job("shading", scene_of(number, variant), quality, 1)
    table, faces = (job.read("emission").table(f"{name}.parquet") for name in ("emitters", "emitter_faces"))
    own, rows = faces["emitter_id"], len(table["emitter_id"])
    vertices, mesh = CaptureReader(job.read("capture")).mesh()
    radiance = np.stack([table[f"radiance_{c}"] for c in "rgb"], 1).mean(1)[own]
    found = lamps_found(room, vertices, mesh[faces["face_id"]], radiance, [])
    area, false = np.bincount(own, found.area, rows), np.bincount(own, found.area * found.false, rows)
    asked = np.flatnonzero((table["probability"] >= 0) & (area > 0))
    columns = LampEvidence(*(table[name][asked] for name in ("is_likely", "is_saturated", "is_hidden", "needed"))).columns
    kinds, of = np.unique(columns, axis=0, return_inverse=True)
    return kinds, np.bincount(of.ravel(), false[asked]) < FALSE * np.bincount(of.ravel(), area[asked])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="+", type=int)
    parser.add_argument("--variant", default="ours", help="of lab/config/studies/drawn.yaml")
    parser.add_argument("--quality", default="draft")
    args = parser.parse_args()
    native.prepare()
    parts = [emitters_of(number, args.variant, args.quality) for number in args.rooms]
    columns, truth = (np.concatenate(values) for values in zip(*parts, strict=True))
    room = np.repeat(np.arange(len(parts)), [len(values) for _, values in parts])
    others = logistic.by_others(columns, truth, room, np.random.default_rng(0))
    print(f"{len(parts)} rooms, {len(room)} emitters, {int(truth.sum())} lamps")
    print("\n".join(logistic.told(NAMES, columns, truth, room, PROBABILITY, others)))


if __name__ == "__main__":
    main()
