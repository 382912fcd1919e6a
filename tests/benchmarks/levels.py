"""Are the levels of the albedos of finished rooms as right as they claim: of all objects together, and of each one?

    python tests/benchmarks/levels.py FOLDER ROOM...

FOLDER is the working folder of the runs; ROOM is the name of a derived scene in it, such as `sky--rooms-ours-s0`. Objects count
with their interior pixels, of which they need more than 100; metals do not count. The error of the level of the room is the mean
over those pixels of the logarithm of each object's mean albedo over the true one. An object is held if its mean albedo, divided
by that level, is within the mean of the map `uncertainty` of the true one.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from workflow.artifacts.store import StageReader, ids_from_disk
from workflow.scene.normal_form import CaptureReader
from workflow.scoring.scores import material_maps

FEWEST_PIXELS = 100
DARKEST = 1e-3  # objects with a darker mean albedo have no ratio


def read(folder: Path, stage: str) -> StageReader:
    return StageReader(folder / stage, stage, folder.name)


def sums_of_objects(folder: Path) -> np.ndarray:
    """Sums over the interior pixels of each object, (O, 5): fitted albedo, true albedo, uncertainty, metallic, 1."""
    capture, affines, segmentation = (read(folder, stage) for stage in ("capture", "affines", "segmentation"))
    rows, ids = [], []
    for view in CaptureReader(capture).views:
        file = f"maps/{view.name}.exr"
        if not affines.has(file):
            continue
        fitted, truth, parts = affines.exr(file), capture.exr(f"truth/{view.name}.exr"), segmentation.exr(file)
        object_id = ids_from_disk(parts["object.id"]).ravel()
        true = material_maps(truth)
        shines = sum(truth[f"emission.{c}"] for c in "RGB").ravel() > 0
        use = (truth["valid"].ravel() > 0.5) & (parts["interior"].ravel() > 0.5) & (object_id >= 0) & ~shines
        albedo = [maps["albedo"].reshape(-1, 3).mean(1) for maps in (material_maps(fitted), true)]
        columns = [*albedo, fitted["uncertainty"].ravel(), true["metallic"].ravel(), np.ones(len(use))]
        rows.append(np.stack(columns, 1)[use])
        ids.append(object_id[use])
    values, owner = np.concatenate(rows).astype(np.float64), np.concatenate(ids)
    return np.stack([np.bincount(owner, column) for column in values.T], 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("rooms", nargs="+")
    given = parser.parse_args()
    held = []
    print("| room | level too bright by | claimed error | objects | held | normalised discrepancy |")
    print("|---|---|---|---|---|---|")
    for room in given.rooms:
        folder = given.folder / "results" / room
        sums = sums_of_objects(folder)
        sums = sums[sums[:, 4] > FEWEST_PIXELS]
        fitted, true, claimed, metal = (sums[:, :4] / sums[:, 4:]).T
        use = (metal < 0.5) & (true > DARKEST)
        fitted, true, claimed, pixels = fitted[use], true[use], claimed[use], sums[use, 4]
        level = float(pixels @ np.log(np.maximum(fitted, DARKEST) / true) / pixels.sum())
        held.append(np.abs(fitted * np.exp(-level) - true) <= claimed)
        facts = read(folder, "affines").json("affines.json")
        discrepancy = facts.get("level_errors", {}).get("normalised_discrepancy", float("nan"))
        print(
            f"| {room.split('--')[0]} | {np.expm1(level):+.1%} | {facts['scale']['relative_error']:.1%} "
            f"| {len(true)} | {held[-1].mean():.0%} | {discrepancy:.2f} |",
            flush=True,
        )
    everything = np.concatenate(held)
    print(f"\n{everything.mean():.1%} of {len(everything)} objects are held.")


if __name__ == "__main__":
    main()
