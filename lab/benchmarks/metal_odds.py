"""The numbers by which an object is taken for a metal (docs/method/fitting.md, Eq. M.56), from rooms with truth.

    python lab/benchmarks/metal_odds.py drawn-16--s0 drawn-17--s0 ... [--quality draft]

Run it in the working folder, with scenes whose fit is finished and whose prior states its errors. It prints the numbers of
`iif_core.fitting.selection.METAL_ODDS` fitted to these rooms, and what they would find in rooms that did not fit them: metal
found and wrongly found, by area, with those numbers and with the present ones.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import numpy as np

import lab  # noqa: F401  for the sources of the laboratory
from iif_core.fitting.selection import METAL_ODDS, metal_log_odds, metal_witnesses
from lab.benchmarks import logistic

Array = np.ndarray
METAL = 0.5
"""Mean true metallic from which an object is one."""
NAMES = ("constant", "stated odds", "evidence", "brightness")


@dataclass(frozen=True)
class Objects:
    """Objects whose kind was chosen.

    Attributes:
        room: (n,) int; witnesses: (n, 3); is_metal: (n,) bool; area: (n,) share of the seen surface of its room.
    """

    room: Array
    witnesses: Array
    is_metal: Array
    area: Array

    def found(self, log_odds: Array) -> tuple[float, float]:
        """Return the metal that is found, as a share of it, and the false metal, as a share of the surface; over all rooms."""
        taken, rooms = log_odds > 0, len(np.unique(self.room))
        metal = self.area[self.is_metal].sum()
        return self.area[taken & self.is_metal].sum() / max(metal, 1e-12), self.area[taken & ~self.is_metal].sum() / rooms


def objects_of(scene: str, quality: str, number: int) -> Objects:
    """Return the objects of a room whose kind was chosen, of which truth is known."""
    from workflow.artifacts.store import ids_from_disk
    from workflow.runtime.job import Job
    from workflow.scene.normal_form import CaptureReader
    from workflow.scoring.scores import material_truth

    job = Job("export", scene, quality, 1)
    capture, segmentation, fit = CaptureReader(job.read("capture")), job.read("segmentation"), job.read("affines")
    table = fit.table("objects.parquet")
    count = len(table["object_id"])
    pixels, metal = np.zeros(count), np.zeros(count)
    for view in capture.views:
        name = f"maps/{view.name}.exr"
        if not segmentation.has(name):
            continue
        target = material_truth(capture, segmentation, view)
        own = ids_from_disk(segmentation.exr(name)["object.id"])
        use = (own >= 0) & target.masks["albedo"]
        pixels += np.bincount(own[use], minlength=count)
        metal += np.bincount(own[use], target.truth.metallic[use] >= METAL, count)
    own = table["object_id"]
    chosen = (table["kind_probability"].sum(1) > 0) & (pixels[own] > 0)
    own, share, area = own[chosen], metal / np.maximum(pixels, 1), pixels / max(pixels.sum(), 1)
    return Objects(np.full(len(own), number), table["kind_witnesses"][chosen], share[own] >= METAL, area[own])


def report(objects: Objects) -> list[str]:
    """Return what is printed."""
    columns, truth, room = metal_witnesses(objects.witnesses), objects.is_metal, objects.room
    others = logistic.by_others(columns, truth, room, np.random.default_rng(0))
    lines = [f"{len(np.unique(room))} rooms, {len(room)} objects, {int(truth.sum())} metals"]
    for name, odds in (("by other rooms", others), ("present numbers", metal_log_odds(objects.witnesses))):
        right, wrong = objects.found(odds)
        lines.append(f"{name}: {right:.0%} of the metal found, {wrong:.2%} of the surface wrongly")
    return lines + logistic.told(NAMES, columns, truth, room, METAL_ODDS, others)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--quality", default="draft")
    args = parser.parse_args()
    parts = [objects_of(scene, args.quality, number) for number, scene in enumerate(args.scenes)]
    joined = Objects(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))
    print("\n".join(report(joined)))


if __name__ == "__main__":
    main()
