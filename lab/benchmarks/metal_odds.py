"""The numbers by which an object is taken for a metal (docs/method/fitting.md, Eq. M.56), from rooms with truth.

    python lab/benchmarks/metal_odds.py drawn-16--s0 drawn-17--s0 ... [--quality draft]

Run it in the working folder, with scenes whose fit is finished and whose prior states its errors. It prints the numbers of
`iif_core.fitting.selection.METAL_ODDS` fitted to these rooms with their standard errors (rooms drawn with replacement), and what
they would find in rooms that did not fit them: metal found and wrongly found, by area, with those numbers and with the present
ones.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import numpy as np
from scipy.optimize import minimize

import lab  # noqa: F401  for the sources of the laboratory
from iif_core.fitting.selection import METAL_ODDS, metal_log_odds, metal_witnesses

Array = np.ndarray
Numbers = tuple[float, float, float, float]
METAL = 0.5
"""Mean true metallic from which an object is one."""
FOLDS, DRAWS = 7, 100
_RIDGE = 0.01  # keeps the numbers finite where metal and non-metal are apart
CLAIMS = (0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)
"""Limits of the classes of claimed probability."""


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

    def take(self, which: Array) -> Objects:
        return Objects(self.room[which], self.witnesses[which], self.is_metal[which], self.area[which])

    def found(self, log_odds: Array) -> tuple[float, float]:
        """Return the metal that is found, as a share of it, and the false metal, as a share of the surface; over all rooms."""
        taken = log_odds > 0
        rooms = len(np.unique(self.room))
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


def fitted(objects: Objects) -> Numbers:
    """Fit the numbers to objects by logistic regression; every object counts alike."""
    columns = np.column_stack([np.ones(len(objects.room)), metal_witnesses(objects.witnesses)])
    sign = np.where(objects.is_metal, 1.0, -1.0)

    def loss(numbers: Array) -> tuple[float, Array]:
        margin = sign * (columns @ numbers)
        wrong = np.exp(-np.logaddexp(0.0, margin))  # probability of the other answer
        pull = _RIDGE * np.r_[0.0, numbers[1:]]
        return np.logaddexp(0.0, -margin).sum() + 0.5 * pull @ numbers, pull - columns.T @ (sign * wrong)

    found = minimize(loss, np.zeros(4), jac=True, method="L-BFGS-B").x
    return tuple(float(x) for x in found)  # type: ignore[return-value]


def by_others(objects: Objects, rng: np.random.Generator) -> Array:
    """Return the logarithm of the odds of each object by numbers that other rooms have given."""
    rooms = np.unique(objects.room)
    fold = rng.permutation(len(rooms)) % FOLDS
    out = np.zeros(len(objects.room))
    for k in range(FOLDS):
        own = np.isin(objects.room, rooms[fold == k])
        out[own] = metal_log_odds(objects.witnesses[own], fitted(objects.take(~own)))
    return out


def errors(objects: Objects, rng: np.random.Generator) -> Array:
    """Return the standard errors (4,) of the numbers: rooms drawn with replacement."""
    rooms = np.unique(objects.room)
    of_room = [np.flatnonzero(objects.room == room) for room in rooms]
    drawn = (np.concatenate([of_room[k] for k in rng.integers(0, len(rooms), len(rooms))]) for _ in range(DRAWS))
    return np.std([fitted(objects.take(which)) for which in drawn], axis=0)


def report(objects: Objects) -> list[str]:
    """Return what is printed."""
    rng = np.random.default_rng(0)
    numbers, deviation, others = fitted(objects), errors(objects, rng), by_others(objects, rng)
    lines = [f"{len(np.unique(objects.room))} rooms, {len(objects.room)} objects, {int(objects.is_metal.sum())} metals"]
    names = ("constant", "stated odds", "evidence", "brightness")
    for name, new, error, present in zip(names, numbers, deviation, METAL_ODDS, strict=True):
        lines.append(f"{name:12} {new:6.2f} +- {error:.2f}   present {present:6.2f}")
    for name, odds in (("by other rooms", others), ("present numbers", metal_log_odds(objects.witnesses))):
        right, wrong = objects.found(odds)
        lines.append(f"{name}: {right:.0%} of the metal found, {wrong:.2%} of the surface wrongly")
    claimed = 1.0 / (1.0 + np.exp(-others))
    for low, high in zip(CLAIMS, CLAIMS[1:], strict=False):
        own = (claimed >= low) & (claimed < high if high < 1 else claimed <= 1)
        if own.any():
            said, is_one = claimed[own].mean(), objects.is_metal[own].mean()
            lines.append(f"claimed {low:.2f} to {high:.2f}: {own.sum()} objects, claimed {said:.2f}, are {is_one:.2f}")
    return lines


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
