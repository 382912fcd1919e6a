"""Whether the 95 % intervals of `objects.csv` hold the truth, and the numbers from which they are made.

    python lab/benchmarks/object_intervals.py sky--rooms_learned-raw-s0 [--quality draft]   measure scenes that are finished
    python lab/benchmarks/object_intervals.py --make sky lamps [--variant small]            photograph rooms, fit, measure
    python lab/benchmarks/object_intervals.py                                               the constants and tables alone

Run it in a working folder. `--make` takes any scenes of lab/config/studies/scenes.yaml, under the settings of a variant of study
`intervals`, up to stage affines, one after the other. The rows of each room, one for each object, replace those that it had in
lab/notebook/data/object_intervals.csv as soon as it is finished. The rooms there that were captured as they are, but for those of
the gates, then set the constants in workflow/decisions/intervals.json, which the product reads; all rooms are in the tables of
lab/notebook/intervals.md. Truth and estimate of an object are means over its surface cells, which have equal areas; truth is
known where photographs show it, and objects with fewer such cells than `--cells` are left out.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import numpy as np
from scipy.optimize import minimize
from scipy.special import stdtrit

import lab  # noqa: F401  for the sources of the laboratory
from iif_core.errors import InputError
from iif_core.fitting.intervals import (
    LEAST_SEEN,
    AlbedoIntervals,
    MeasuredErrors,
    MetallicIntervals,
    RoughnessIntervals,
    conformal_factor,
    roughness_error,
    student_width,
)
from iif_core.fitting.problem import Kinds
from iif_core.reflectance.material import CHANNELS
from workflow.decisions.held import FILE

REPOSITORY = Path(__file__).resolve().parents[2]
ROWS, PAGE = REPOSITORY / "lab/notebook/data/object_intervals.csv", REPOSITORY / "lab/notebook/intervals.md"
KINDS = ("probability", "brightness", "roughness", "deviation")
COLUMNS = (
    "scene", "object", "cells", "pixels", "room_error", "level", "seen",
    *CHANNELS, *(f"true_{name}" for name in CHANNELS), *(f"{name}_{k}" for name in KINDS for k in range(3)),
)  # fmt: skip
IDEAL = "--intervals-small-"
"""In the names of scenes that were captured without errors."""
KEPT_BACK = ("tiny", "tiny-gloss", "gloss")
"""Rooms that set no constant, because the gates of `make test` are on them (tests/lab/gates.py)."""
DARK, FEW = 0.1, 500
"""Objects of a lower albedo or of fewer pixels do not tell the error of hue: the additive error and borders hide it there."""
HELD = ("albedo", "roughness", "metallic")
"""What the product says something of: of roughness, about the objects whose interval is narrower than 0 to 1."""
SIZES = np.log([[1e-4, 0.3], [1e-3, 30.0]])
"""Logarithms of the limits of the additive error and of that of borders."""
ROUGHNESS = np.log([[1e-3, 1.0], [1e-3, 1.0]])
"""The same of the errors of roughness of non-metals and metals."""
NO_ERRORS = MeasuredErrors(*[1e-6] * 5, 1.0, 1.0, 1.0)
SIGMA = 0.6827
"""Share of a normal distribution within one standard deviation."""
Array = np.ndarray


@dataclass(frozen=True)
class Room:
    """Objects of a room: estimates and truths (O, 5) of `CHANNELS`, errors (O,) of their levels, error of the room's level, cells
    (O,) whose truth is known, pixels (O,) of the fit, and what it left open of kinds."""

    scene: str
    estimate: Array
    truth: Array
    level: Array
    room_error: float
    cells: Array
    pixels: Array
    kinds: Kinds

    @property
    def name(self) -> str:
        """Of the room, without study, variant and seed."""
        return self.scene.partition("--")[0]

    def albedo(self, errors: MeasuredErrors) -> AlbedoIntervals:
        return AlbedoIntervals.of(self.estimate[:, :3], self.level, self.pixels, self.room_error, self.kinds, errors)

    def roughness(self, errors: MeasuredErrors) -> RoughnessIntervals:
        return RoughnessIntervals.of(self.estimate[:, 3], self.kinds, errors)

    def metallic(self) -> MetallicIntervals:
        return MetallicIntervals.of(self.estimate[:, 4], self.kinds)

    @property
    def level_error(self) -> float:
        """Logarithm of the estimated over the true level of the room: median over its surface."""
        ratio = np.log(np.maximum(self.estimate[:, :3].mean(1), 1e-3) / np.maximum(self.truth[:, :3].mean(1), 1e-3))
        return _middle(ratio, self.cells)


def _middle(values: Array, weight: Array, share: float = 0.5) -> float:
    """Return the weighted median, or another quantile."""
    order = np.argsort(values)
    return float(values[order][np.searchsorted(np.cumsum(weight[order]), share * weight.sum())])


# ------------------------------------------------------------------------------------------------------------ measuring


def make(scene: str) -> None:
    """Run the stages of a scene up to the fit."""
    target = f"results/{scene}/affines/manifest.json"
    program = Path(sys.executable).with_name("snakemake")
    subprocess.run([program, "-s", REPOSITORY / "lab/Snakefile", "--cores", "1", target], check=True)


def measured(scene: str, quality: str, cells: int) -> Iterator[dict[str, Any]]:
    """Yield the rows of a scene whose fit is finished."""
    from workflow.exporters.object_table import kinds_of
    from workflow.runtime.job import Job
    from workflow.scene.base_scene import read_base
    from workflow.scene.normal_form import CaptureReader
    from workflow.scoring.scores import cell_truth

    job = Job("export", scene, quality, 1)
    base, fitted = read_base(job), job.read("affines")
    own, objects = base.table("cells.parquet")["object_id"], fitted.table("objects.parquet")
    found = fitted.table("cells.parquet", CHANNELS)
    estimate = np.stack([found[name] for name in CHANNELS], 1)
    of_cells = cell_truth(CaptureReader(job.read("capture")), job.read("segmentation"), base)
    truth = np.concatenate([of_cells[quantity] for quantity in ("albedo", "roughness", "metallic")], 1)
    known, n = np.isfinite(truth).all(1), len(objects["object_id"])
    count = np.bincount(own[known], minlength=n)[:n]
    estimates, truths = _means(estimate, own, n), _means(truth[known], own[known], n)
    kinds = kinds_of(objects, n)
    room_error = fitted.json("affines.json")["scale"]["relative_error"]
    for o in np.flatnonzero(count >= cells):
        facts = {"scene": scene, "object": int(o), "cells": int(count[o]), "pixels": int(objects["pixels"][o])}
        facts |= {"room_error": room_error, "level": objects["std_level"][o], "seen": kinds.seen[o]}
        facts |= dict(zip(CHANNELS, estimates[o], strict=True))
        facts |= {f"true_{name}": value for name, value in zip(CHANNELS, truths[o], strict=True)}
        facts |= {f"{name}_{k}": getattr(kinds, name)[o, k] for name in KINDS for k in range(3)}
        yield {key: f"{value:.5g}" if isinstance(value, float | np.floating) else value for key, value in facts.items()}


def _means(values: Array, owner: Array, n: int) -> Array:
    count = np.maximum(np.bincount(owner, minlength=n)[:n], 1)
    return np.stack([np.bincount(owner, column.astype(np.float64), n)[:n] for column in values.T], 1) / count[:, None]


def keep(scene: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Replace the rows of a scene in the table."""
    others = [row for row in _table() if row["scene"] != scene]
    every = sorted([*others, *rows], key=lambda row: (row["scene"], int(row["object"])))
    with ROWS.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(every)


def _table() -> list[dict[str, str]]:
    if not ROWS.is_file():
        return []
    with ROWS.open(newline="") as file:
        return list(csv.DictReader(file))


def rooms_of(table: Sequence[Mapping[str, str]]) -> list[Room]:
    """Return the rooms of the table."""
    rooms = []
    for scene in sorted({row["scene"] for row in table}):
        own = [row for row in table if row["scene"] == scene]

        def columns(*names: str, own: Sequence[Mapping[str, str]] = own) -> Array:
            return np.array([[float(row[name]) for name in names] for row in own])

        of_kinds = {name: columns(*(f"{name}_{k}" for k in range(3))) for name in KINDS}
        kinds = Kinds(**of_kinds, seen=columns("seen")[:, 0], witnesses=np.zeros((len(own), 3)))
        truth = columns(*(f"true_{name}" for name in CHANNELS))
        level, room_error, *counts = columns("level", "room_error", "cells", "pixels").T
        rooms.append(Room(scene, columns(*CHANNELS), truth, level, float(room_error[0]), *counts, kinds))
    return rooms


# ---------------------------------------------------------------------------------------------- errors, factors, coverage


def fitted(rooms: Sequence[Room]) -> MeasuredErrors:
    """Measure the error of hue, the most likely other errors, and the factors. Every room weighs the same.

    Raises:
        InputError: there are too few objects for a factor.
    """
    hue = _middle(*_weighted([_away_in_hue(room) for room in rooms]), SIGMA)
    additive, border = _likeliest(rooms, lambda room, e: _likely_albedo(room, hue, *e), [0.005, 0.4], SIZES)
    dielectric, metal = _likeliest(rooms, _likely_roughness, [0.1, 0.2], ROUGHNESS)
    errors = MeasuredErrors(additive, border, hue, dielectric, metal, 1.0, 1.0, 1.0)
    albedo, roughness = [room.albedo(errors) for room in rooms], [room.roughness(errors) for room in rooms]
    factors = {
        "albedo": _factor([(own.residual(room.truth[:, :3]), own.until) for room, own in zip(rooms, albedo, strict=True)]),
        "roughness": _factor([(own.residual(room.truth[:, 3]), own.until) for room, own in zip(rooms, roughness, strict=True)]),
        # Below 1 the evidence for a kind would count for more than the fit itself takes it for.
        "metallic": max(1.0, _factor([(room.metallic().residual(room.truth[:, 4]), np.inf) for room in rooms])),
    }
    if not np.isfinite(list(factors.values())).all():
        raise InputError(f"object_intervals: {factors} from {len(rooms)} rooms; measure more rooms (--make)")
    return replace(errors, **factors)


def _likeliest(
    rooms: Sequence[Room], likely: Callable[[Room, Array], float], start: Sequence[float], limits: Array
) -> list[float]:
    """Return the errors that maximise the sum of a log likelihood over rooms."""
    found = minimize(
        lambda x: -sum(likely(room, np.exp(x)) for room in rooms), np.log(start), method="Nelder-Mead", bounds=limits
    )
    return [float(value) for value in np.exp(found.x)]


def _away_in_hue(room: Room) -> Array:
    use = (room.estimate[:, :3].mean(1) >= DARK) & (room.pixels >= FEW)
    ratio = np.log(np.maximum(room.estimate[use, :3], 1e-3) / np.maximum(room.truth[use, :3], 1e-3))
    brightness = np.log(room.estimate[use, :3].mean(1) / np.maximum(room.truth[use, :3].mean(1), 1e-3))
    return np.abs(ratio - brightness[:, None]).ravel()


def _likely_albedo(room: Room, hue: float, additive: float, border: float) -> float:
    """Mean log density of the true albedos: Student's t on the scale of Eq. M.58, times its slope 1 / sqrt((s a)^2 + delta^2)."""
    known = room.level > 0
    estimate, truth = room.estimate[known, :3], room.truth[known, :3]
    relative = np.sqrt(room.level[known] ** 2 + room.room_error**2 + hue**2)[:, None]
    additive = np.hypot(additive, border / np.sqrt(np.maximum(room.pixels[known], 1.0)))[:, None]
    away = np.diff([np.arcsinh(relative * a / additive) / relative for a in (estimate, truth)], axis=0)
    z = away * stdtrit(4.0, 0.5 + 0.5 * SIGMA)
    return float((-2.5 * np.log1p(z**2 / 4.0) - np.log(np.hypot(relative * truth, additive))).mean())


def _likely_roughness(room: Room, errors: Array) -> float:
    """Mean log density of the true roughness of objects whose roughness photographs tell: Student's t of the chosen kinds."""
    told = room.kinds.seen >= LEAST_SEEN
    if not told.any():
        return 0.0
    chosen = room.kinds.probability.argmax(1)
    error = roughness_error(room.kinds, replace(NO_ERRORS, dielectric=errors[0], metal=errors[1]))
    error = error[np.arange(len(chosen)), chosen][told]
    z = (room.estimate[:, 3] - room.truth[:, 3])[told] / error * stdtrit(4.0, 0.5 + 0.5 * SIGMA)
    return float((-2.5 * np.log1p(z**2 / 4.0) - np.log(error)).mean())


def _factor(claims: Sequence[tuple[Array, Array | float]]) -> float:
    """Return the factor of rooms, from the factors with which claims just hold the truth, and until which they are claims."""
    flat = [[column.ravel() for column in np.broadcast_arrays(*own)] for own in claims]
    residual, until = (np.concatenate(column) for column in zip(*flat, strict=True))
    return conformal_factor(residual, np.repeat(np.arange(len(flat)), [len(own[0]) for own in flat]), until)


def _weighted(found: Sequence[Array]) -> tuple[Array, Array]:
    """Join the values of rooms, with weights that add up to 1 in each."""
    return np.concatenate(found), np.concatenate([np.full(len(values), 1.0 / max(len(values), 1)) for values in found])


def coverage(room: Room, errors: MeasuredErrors) -> dict[str, float]:
    """Return shares of held truths, half widths (medians over the objects, the relative one over the surface), and how much is
    claimed, of a room under errors of others."""
    low, high = room.albedo(errors).ends(errors.albedo)
    truth, middle = room.truth, room.estimate[:, :3].mean(1)
    out = {
        "objects": float(len(truth)),
        "albedo": float(((low <= truth[:, :3]) & (truth[:, :3] <= high)).mean()),
        "brightness": float(((low.mean(1) <= truth[:, :3].mean(1)) & (truth[:, :3].mean(1) <= high.mean(1))).mean()),
        "albedo_width": float(np.median(0.5 * (high - low))),
        "relative_width": _middle(0.5 * (high - low).mean(1) / np.maximum(middle, 1e-3), room.cells),
        "level": float(abs(room.level_error) <= student_width(np.inf) * room.room_error),
    }
    of_roughness, factor = room.roughness(errors), errors.roughness
    low, high = of_roughness.ends(factor)
    inside, claimed, half = (low <= truth[:, 3]) & (truth[:, 3] <= high), of_roughness.until > factor, 0.5 * (high - low)
    out |= {"roughness": _mean(inside[claimed]), "roughness_claimed": float(claimed.mean())}
    out |= {"roughness_width": float(np.median(half[claimed])) if claimed.any() else np.nan}
    low, high = room.metallic().ends(errors.metallic)
    inside = (low <= truth[:, 4]) & (truth[:, 4] <= high)
    out |= {"metallic": float(inside.mean()), "metallic_width": float(np.median(0.5 * (high - low)))}
    metal = truth[:, 4] > 0.5
    out["metals"] = float(metal.sum())
    out["metals_held"] = _mean(inside[metal])
    return out


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else np.nan


def that_set(rooms: Sequence[Room]) -> list[Room]:
    """Return the rooms that set the constants."""
    return [room for room in rooms if IDEAL not in room.scene and room.name not in KEPT_BACK]


def left_out(rooms: Sequence[Room], told: Sequence[Room]) -> list[dict[str, float]]:
    """Return the coverage of each room under what the rooms of other names among those that were `told` say."""
    return [coverage(room, fitted([other for other in told if other.name != room.name])) for room in rooms]


def terms(rooms: Sequence[Room], told: Sequence[Room]) -> list[list[str]]:
    """Return what each term adds to the intervals of albedo: shares of channels held and half widths, means over the rooms."""
    everything = fitted(told)
    none = replace(everything, additive=1e-6, hue=1e-6, border=1e-6)
    normal = float(student_width(np.inf) / student_width(4.0))

    def without(room: Room, level: bool = True) -> Room:
        kinds = replace(room.kinds, probability=np.zeros_like(room.kinds.probability))
        return replace(room, kinds=kinds, room_error=room.room_error if level else 0.0)

    steps: list[tuple[str, Callable[[Room], Room], MeasuredErrors, float]] = [
        ("error of the object's level, times 1.96", lambda room: without(room, False), none, normal),
        ("Student's t of four degrees of freedom", lambda room: without(room, False), none, 1.0),
        ("error of the room's level", without, none, 1.0),
        ("error of hue", without, replace(none, hue=everything.hue), 1.0),
        ("additive error", without, replace(everything, border=1e-6), 1.0),
        ("error of borders", without, everything, 1.0),
        ("other kinds", lambda room: room, everything, 1.0),
    ]
    out = []
    for name, change, errors, factor in steps:
        found = [coverage(change(room), replace(errors, albedo=factor)) for room in rooms]
        out.append([name, *_summary(found)])
    return [*out, ["the factor, from the other rooms", *_summary(left_out(rooms, told))]]


def _summary(found: Sequence[Mapping[str, float]]) -> list[str]:
    share, width = ([row[name] for row in found] for name in ("albedo", "relative_width"))
    return [_percent(np.mean(share)), f"{_percent(min(share))} to {_percent(max(share))}", _percent(np.mean(width))]


# -------------------------------------------------------------------------------------------------------------- writing


def document(told: Sequence[Room], found: Sequence[Mapping[str, float]], errors: MeasuredErrors) -> dict[str, Any]:
    """Return what the product reads: `errors` of the rooms that were `told`, and what was `found` in rooms as captured."""
    held = {}
    for name in HELD:
        shares = [row[name] for row in found if np.isfinite(row[name])]
        held[name] = {"pooled": float(np.mean(shares)), "lowest": min(shares), "highest": max(shares)}
        held[name]["half_width"] = float(np.nanmean([row[f"{name}_width"] for row in found]))
    # With less than its factor an object is lost, so factors are rounded up.
    numbers = {name: _up(value) if name in HELD else float(f"{value:.4g}") for name, value in vars(errors).items()}
    held = {name: {key: round(value, 4) for key, value in entry.items()} for name, entry in held.items()}
    metals, inside = _metals(found)
    return {
        "errors": numbers,
        "held": held,
        "metals": {"true": metals, "held": inside},
        "rooms": len(found),
        "told_by": [room.scene for room in told],
    }


def _up(value: float) -> float:
    """Round a number above 0 up to four digits."""
    step = 10.0 ** (np.floor(np.log10(value)) - 3)
    return float(f"{np.ceil(value / step) * step:.4g}")


def _metals(found: Sequence[Mapping[str, float]]) -> tuple[int, int]:
    """Return how many objects are metal, and of how many of them the interval of metallic holds that."""
    held = sum(row["metals"] * np.nan_to_num(row["metals_held"]) for row in found)
    return round(sum(row["metals"] for row in found)), round(held)


SHARES = ("albedo", "brightness", "roughness", "metallic")


def of_rooms(pairs: Sequence[tuple[Room, Mapping[str, float]]]) -> list[str]:
    """Return the table of coverage, with a line for each room."""
    from workflow.report.blocks import markdown

    shares, rows, found = SHARES, [], [row for _, row in pairs]
    for room, row in pairs:
        level = f"{room.level_error:+.2f} ± {student_width(np.inf) * room.room_error:.2f}"
        rows.append([room.name, f"{row['objects']:.0f}", *(_percent(row[name]) for name in shares), level, *_widths(row)])
    means = {name: float(np.nanmean([row[name] for row in found])) for name in found[0]}
    inside = f"{sum(row['level'] for row in found):.0f} of {len(found)} inside"
    objects = f"{sum(row['objects'] for row in found):.0f}"
    rows.append(["**mean of the rooms**", objects, *(_percent(means[name]) for name in shares), inside, *_widths(means)])
    pooled = []
    for name in shares:
        value = np.array([row[name] for row in found])
        weight = np.array([row["objects"] * (row["roughness_claimed"] if name.startswith("roughness") else 1.0) for row in found])
        pooled.append(_percent(np.average(np.nan_to_num(value), weights=weight)))
    rows.append(["**all objects**", objects, *pooled, *[""] * 5])
    heads = [
        "room",
        "objects",
        "R, G, B",
        "brightness",
        "roughness, where claimed",
        "metallic",
        "level of the room, error ± half of 95 %",
    ]
    heads += ["half width: R, G, B", "relative, of the surface", "roughness", "roughness claimed of"]
    return markdown(heads, rows)


def tables(
    rooms: Sequence[Room], told: Sequence[Room], found: Sequence[Mapping[str, float]], errors: MeasuredErrors
) -> dict[str, str]:
    """Return the tables of the page: what was `found` in all rooms, by those that were `told`."""
    from workflow.report.blocks import markdown

    pairs = list(zip(rooms, found, strict=True))
    captured, ideal = ([pair for pair in pairs if (IDEAL in pair[0].scene) == which] for which in (False, True))
    metals, held = _metals([row for _, row in captured])
    numbers = [[name, f"{value:.3g}"] for name, value in vars(errors).items()]
    numbers += [["true metals that their interval holds", f"{held} of {metals}"]]
    numbers += [["level of the room: mean error, and root mean square in claimed errors", _level([room for room, _ in captured])]]
    heads = ["with", "R, G, B held", "in a room", "half width, relative, of the surface"]
    return {
        "intervals": "\n".join(of_rooms(captured)),
        "ideal": "\n".join(of_rooms(ideal)),
        "terms": "\n".join(markdown(heads, terms([room for room, _ in captured], told))),
        "constants": "\n".join(markdown(["number", "value"], numbers)),
    }


def _level(rooms: Sequence[Room]) -> str:
    errors = np.array([room.level_error for room in rooms])
    ratio = errors / [room.room_error for room in rooms]
    return f"{np.mean(errors):+.2f}, {np.sqrt(np.mean(ratio**2)):.1f}"


def _widths(row: Mapping[str, float]) -> list[str]:
    narrow = f"{width:.2f}" if np.isfinite(width := row["roughness_width"]) else "-"
    return [f"{row['albedo_width']:.3f}", _percent(row["relative_width"]), narrow, _percent(row["roughness_claimed"])]


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if np.isfinite(share) else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--make", action="store_true")
    parser.add_argument("--variant", default="small", help="of study `intervals`, for --make")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--cells", type=int, default=50)
    asked = parser.parse_args()
    from workflow.report.blocks import fill

    for scene in asked.scenes:
        if asked.make:
            scene = f"{scene}--intervals-{asked.variant}-s0"
            make(scene)
        rows = list(measured(scene, asked.quality, asked.cells))
        keep(scene, rows)
        print(f"{scene}: {len(rows)} objects")
    rooms = rooms_of(_table())
    told = that_set(rooms)
    found, errors = left_out(rooms, told), fitted(told)
    as_captured = [row for room, row in zip(rooms, found, strict=True) if IDEAL not in room.scene]
    FILE.write_text(json.dumps(document(told, as_captured, errors), indent=1) + "\n")
    PAGE.write_text(fill(PAGE.read_text(), tables(rooms, told, found, errors)))
    print(FILE.read_text())


if __name__ == "__main__":
    main()
