"""Are the levels of the albedos of finished rooms as right as they claim: of all objects together, and of each one?

    python lab/benchmarks/levels.py FOLDER ROOM...

FOLDER is the working folder of the runs; ROOM is the name of a derived scene in it, such as `sky--rooms-ours-s0`. Objects count
with their interior pixels, of which they need more than 100; metals do not count. The error of the level of the room is the mean
over those pixels of the logarithm of each object's mean albedo over the true one. An object is held if its mean albedo, divided
by that level, is within the mean of the map `uncertainty` of the true one.

`--shared` prints instead how far the levels of the rooms would be off with other values of SHARED_LEVEL_ERROR, the error of the
level of the light that all objects share. That follows from the runs as they are: the error enters through the weights of
Eq. M.43 alone.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from iif_core.light.emission.gains import PRIOR_LEVEL_ERROR, SHARED_LEVEL_ERROR
from workflow.artifacts.store import StageReader, ids_from_disk, material_maps
from workflow.scene.normal_form import CaptureReader

FEWEST_PIXELS = 100
SHARED_ERRORS = (0.05, 0.1, 0.15, 0.2, 0.3)
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


def level_error(sums: np.ndarray) -> tuple[np.ndarray, float]:
    """Which objects (O,) count, and the error of the level of the room."""
    fitted, true, _, metal = (sums[:, :4] / np.maximum(sums[:, 4:], 1)).T
    use = (sums[:, 4] > FEWEST_PIXELS) & (metal < 0.5) & (true > DARKEST)
    pixels = sums[use, 4]
    return use, float(pixels @ np.log(np.maximum(fitted[use], DARKEST) / true[use]) / pixels.sum())


def with_other_errors(folders: list[Path]) -> None:
    """Print the error of the levels over the rooms for several values of SHARED_LEVEL_ERROR."""
    rooms = []
    for folder in folders:
        error = level_error(sums_of_objects(folder))[1]
        scale = read(folder, "affines").json("affines.json")["scale"]
        share = min((scale["relative_error"] / PRIOR_LEVEL_ERROR) ** 2, 1 - 1e-12)
        squared = PRIOR_LEVEL_ERROR**2 * share / (1 - share)
        apart = np.log(scale["factor"]) / share  # of the levels of light and base
        rooms.append((error + share * apart, apart, max(squared - SHARED_LEVEL_ERROR**2, 0.0)))
    with_light, apart, own = np.array(rooms).T
    print("| shared error | root mean square error of the level | mean | largest | error over claim |\n|---|---|---|---|---|")
    for shared in SHARED_ERRORS:
        share = 1 / (1 + PRIOR_LEVEL_ERROR**2 / (own + shared**2))
        error = with_light - share * apart
        over = np.sqrt(np.mean((error / (PRIOR_LEVEL_ERROR * np.sqrt(share))) ** 2))
        print(f"| {shared} | {np.sqrt(np.mean(error**2)):.3f} | {error.mean():+.3f} | {np.abs(error).max():.3f} | {over:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("rooms", nargs="+")
    parser.add_argument("--shared", action="store_true", help="other values of SHARED_LEVEL_ERROR instead")
    given = parser.parse_args()
    if given.shared:
        return with_other_errors([given.folder / "results" / room for room in given.rooms])
    held = []
    print("| room | level too bright by | claimed error | objects | held | normalised discrepancy |")
    print("|---|---|---|---|---|---|")
    for room in given.rooms:
        folder = given.folder / "results" / room
        sums = sums_of_objects(folder)
        use, level = level_error(sums)
        fitted, true, claimed = (sums[use, :3] / sums[use, 4:]).T
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
