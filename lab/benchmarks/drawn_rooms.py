"""What the method does in two hundred rooms that are drawn at random, and what a change does to that (lab/docs/drawn.md).

    snakemake -s lab/Snakefile --cores 2 --keep-going results/studies/drawn.parquet    make the rooms that choose
    python lab/benchmarks/drawn_rooms.py --keep after.csv                              a row for each of them
    python lab/benchmarks/drawn_rooms.py --compare before.csv after.csv                what changed, room by room
    python lab/benchmarks/drawn_rooms.py --page                                        the page of the notebook

Run it in the working folder. The rooms of study `drawn` choose; those of `drawn_report` only report: make and `--keep` them
(`--study drawn_report`) once, when a change is finished. A row has the fingerprint of its result and of the code that measures
it, and is taken over from the file where that is unchanged. A room that the method refused, or failed in, has a row that says so.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import lab  # noqa: F401  for the sources of the laboratory
from iif_core.errors import InputError
from lab.prior import drawn
from workflow.artifacts import StageReader

Array = np.ndarray
Row = Mapping[str, str]
REPOSITORY = Path(__file__).resolve().parents[2]
DATA, PAGE = REPOSITORY / "lab/notebook/data", REPOSITORY / "lab/notebook/drawn.md"
PICTURE = REPOSITORY / "lab/notebook/pictures/drawn_worst.png"
STUDIES = "drawn", "drawn_report"
QUALITY = "draft"
AFTER_PRIOR = ("segmentation", "base", "emission", "shading", "second_look", "affines", "render", "metrics")
SEEN = 4
"""Pixels of all photographs that show a lamp which counts as seen."""
METAL = 0.5
"""Metallic above which a surface counts as metal."""
LEAST_CELLS = 50
"""Cells of known truth that an object needs for its interval to be judged."""
THROUGH = ("curtain", "blinds")
"""Objects that let light through and are closed in the delivered mesh: surface there may be found to shine."""


@dataclass(frozen=True)
class Column:
    """A number of a room.

    Attributes:
        label: for people.
        good: 1 if more is better, -1 if less is, 0 if neither.
        digits: after the point.
        bad: value beyond which something went wrong in the room.
    """

    label: str
    good: int = 0
    digits: int = 1
    bad: float | None = None


COLUMNS = {
    "albedo": Column("albedo as it is, dB", 1),
    "albedo_scaled": Column("albedo up to scale, dB", 1),
    "base": Column("base, as it is, dB", 1),
    "base_scaled": Column("base, up to scale, dB", 1),
    "raw": Column("predictions, as they are, dB", 1),
    "raw_scaled": Column("predictions, up to scale, dB", 1),
    "gain": Column("result above base, the lesser of both, dB", 1, 1, -0.3),
    "level": Column("error of the level of albedo, log", -1, 2),
    "roughness": Column("roughness, mean square", -1, 3),
    "metallic": Column("metallic, mean square", -1, 3),
    "rgb": Column("re-rendered, dB", 1),
    "rgb_held_out": Column("re-rendered, held out, dB", 1),
    "corrected": Column("corrected, held out, dB", 1),
    "iou": Column("lamps, intersection over union", 1, 2),
    "false_m2": Column("false lamps, photographed surface, m²", -1, 2),
    "false_power": Column("false lamps, share of the power found", -1, 3, 0.02),
    "stand_in": Column("unseen surface in the place of lamps, share of the power found", 0, 3),
    "missed_seen": Column("seen lamps missed, share of their power", -1, 3, 0.03),
    "missed_unseen": Column("unseen lamps missed, share of their power", -1, 3, 0.2),
    "unseen": Column("unseen lamps, share of the true power", 0, 3),
    "false_metal": Column("false metal, share of the surface", -1, 4, 0.003),
    "metal_found": Column("metal found, share of it", 1, 2, 0.6),
    "metal": Column("metal, share of the surface", 0, 3),
    "held_albedo": Column("intervals of albedo that hold", 0, 2),
    "held_roughness": Column("intervals of roughness that hold", 0, 2),
    "objects": Column("objects that were judged", 0, 0),
    "cpu": Column("CPU seconds after the prior", -1, 0),
}
HEAD = ("room", "variant", "fingerprint", "status", "light", "lamps")
COMPARED = ("", "rooms", "before", "after", "change", "its error", "25 %", "50 %", "75 %", "worst", "best")
DISTRIBUTION = ("", "rooms", "mean", "least", "10 %", "25 %", "50 %", "75 %", "90 %", "most", "went wrong")
WORST = ("albedo", "albedo_scaled", "base", "base_scaled", "rgb", "iou", "false_power", "false_metal")


# ------------------------------------------------------------------------------------------------------------- a room


def room_row(number: int, variant: str) -> dict[str, Any]:
    """Return the row of a room whose stages were made, or failed."""
    from workflow.artifacts.files import facts_in
    from workflow.runtime.fingerprint import home, missing_stages
    from workflow.runtime.job_state import state_file

    scene = scene_of(number, variant)
    row: dict[str, Any] = {"room": number, "variant": variant, "fingerprint": mark(scene), **light_of(number)}
    for stage in missing_stages(scene, QUALITY):
        state = facts_in(state_file(home(stage, scene, QUALITY), stage))
        if state.get("state") == "failed":
            return row | {"status": f"failed: {stage}: {state.get('reason', '')}"[:200]}
    metrics = facts_in(f"results/{home('metrics', scene, QUALITY)}/metrics/manifest.json").get("fingerprint")
    if metrics != row["fingerprint"].split("-")[0]:
        return row | {"status": "not made"}
    return row | {"status": "done"} | measured(number, scene)


def scene_of(number: int, variant: str) -> str:
    """Return the name of the scene of a room."""
    return f"{drawn.PREFIX}{number}--{STUDIES[number >= drawn.COUNT - drawn.REPORTED]}-{variant}-s0"


def mark(scene: str) -> str:
    """Return what a row is of: the fingerprint of the scores, and a digest of what measures them."""
    from workflow.decisions.held import FILE as INTERVALS
    from workflow.runtime.fingerprint import fingerprint, modules_digest

    own = modules_digest(["lab.benchmarks.drawn_rooms", "lab.benchmarks.object_intervals", "lab.rooms.lamps_found"])
    return f"{fingerprint('metrics', scene, QUALITY)}-{hashlib.sha256(own.encode() + INTERVALS.read_bytes()).hexdigest()[:8]}"


def opened(stage: str, scene: str) -> StageReader:
    """Return the reader of a finished stage that hides no truth."""
    from workflow.runtime.fingerprint import home
    from workflow.runtime.job import stage_directory

    at = home(stage, scene, QUALITY)
    return StageReader(stage_directory(at, stage), stage, at)


def measured(number: int, scene: str) -> dict[str, Any]:
    """Return the numbers of a room whose stages are finished."""
    from workflow.runtime.job import Job
    from workflow.scene.normal_form import CaptureReader

    job, capture = Job("export", scene, QUALITY, 1), CaptureReader(opened("capture", scene))
    found = scores(scene) | of_lamps(number, job, capture) | of_materials(job, capture) | held(job)
    return found | {"cpu": _cpu(scene)}


def light_of(number: int) -> dict[str, str]:
    """Say where the light of a room comes from."""
    room = drawn.generated(number)
    names = {part.name for part in room.parts}
    lamps = sorted({part.name.replace(" ", "_") for part in room.parts if part.radiance.any()})
    outside = [room.outside if "window frame" in names else "", *(name for name in THROUGH if name in names)]
    return {"light": " ".join(filter(None, outside)), "lamps": " ".join(lamps)}


def scores(scene: str) -> dict[str, float]:
    """Return the means of stage `metrics`."""
    means = opened("metrics", scene).json("summary.json")["means"]

    def mean(variant: str, quantity: str, protocol: str, metric: str) -> float:
        found: Any = means
        for key in (variant, quantity, protocol, metric):
            found = found.get(key, {})
        return found.get("mean", float("nan"))

    out = {}
    for name, variant in {"albedo": "result", "base": "base", "raw": "prior_mean_k"}.items():
        out |= {name: mean(variant, "albedo", "raw", "psnr"), f"{name}_scaled": mean(variant, "albedo", "scaled", "psnr")}
    out["gain"] = min(out["albedo"] - out["base"], out["albedo_scaled"] - out["base_scaled"])
    out |= {name: mean("result", name, "raw", "l2") for name in ("roughness", "metallic")}
    out |= {name: mean("result", name, "raw", "psnr") for name in ("rgb", "rgb_held_out")}
    out |= {"corrected": mean("corrected", "rgb_held_out", "raw", "psnr"), "iou": mean("result", "emission", "raw", "iou")}
    return out


def of_lamps(number: int, job: Any, capture: Any) -> dict[str, float]:
    """Return what is wrong with the lamps that were found."""
    from lab.rooms.lamps_found import lamps_found
    from workflow.artifacts.store import rgb
    from workflow.scene.recovered import read_recovered

    room, recovered = drawn.build(number), read_recovered(job)
    surface, shines = recovered.surface, np.flatnonzero(recovered.emitter_id >= 0)
    through = [i for i, name in enumerate(room.names) if name.split(" ")[0] in THROUGH]
    found = lamps_found(room, surface.vertices, surface.faces[shines], recovered.light.radiance.mean(1)[shines], through)
    owner, pixels = capture.faces()["instance_id"], np.zeros(len(room.names), int)
    shown = np.zeros(len(owner), bool)
    for view in capture.used:
        truth, face = capture.reader.exr(f"truth/{view.name}.exr"), capture.gbuffer(view)[1]
        shown[face[face >= 0]] = True
        # Photographs are of the true camera, faces of the delivered one: where both show the same object, truth is valid.
        shows = rgb(truth, "emission").any(-1) & (truth["valid"] > 0.5) & (face >= 0)
        pixels += np.bincount(owner[face[shows]], minlength=len(pixels))
    is_seen = np.isin(found.lamp, np.flatnonzero(pixels >= SEEN))
    total = found.power.sum()
    return {
        "false_m2": found.false_m2(shown[shines]),
        "false_power": found.false_power(shown[shines]),
        "stand_in": found.false_power(~shown[shines]),
        "missed_seen": found.missed_power(found.lamp[is_seen]),
        "missed_unseen": found.missed_power(found.lamp[~is_seen]),
        "unseen": float(found.power[~is_seen].sum() / total) if total > 0 else float("nan"),
    }


def of_materials(job: Any, capture: Any) -> dict[str, float]:
    """Return what is wrong with metals, and the error of the level of albedo: |median log ratio to the truth|."""
    from workflow.scene.base_scene import read_base
    from workflow.scoring.scores import cell_truth

    truth = cell_truth(capture, job.read("segmentation"), read_base(job))
    found = job.read("affines").table("cells.parquet", ("albedo_r", "albedo_g", "albedo_b", "metallic"))
    known = np.isfinite(truth["metallic"][:, 0])
    true, claimed = truth["metallic"][known, 0] > METAL, found["metallic"][known] > METAL
    coloured = np.isfinite(truth["albedo"]).all(1)  # mirrors have no albedo that counts
    albedo = np.stack([found[f"albedo_{c}"][coloured] for c in "rgb"], 1).mean(1)
    ratio = np.log(np.maximum(albedo, 1e-3) / np.maximum(truth["albedo"][coloured].mean(1), 1e-3))
    return {
        "false_metal": _mean(claimed & ~true),
        "metal_found": _mean(claimed[true]),
        "metal": _mean(true),
        "level": float(abs(np.median(ratio))) if len(ratio) else float("nan"),
    }


def held(job: Any) -> dict[str, float]:
    """Return which share of the objects' 95 % intervals, as the product makes them, hold the truth."""
    from iif_core.fitting.intervals import MeasuredErrors
    from lab.benchmarks import object_intervals
    from workflow.decisions.held import measured as shipped

    rows = list(object_intervals.measured(job.scene, QUALITY, LEAST_CELLS))
    if not rows:
        return {"objects": 0}
    (room,) = object_intervals.rooms_of(rows)
    found = object_intervals.coverage(room, MeasuredErrors(**shipped()["errors"]))
    return {"held_albedo": found["albedo"], "held_roughness": found["roughness"], "objects": found["objects"]}


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _cpu(scene: str) -> float:
    from workflow.runtime.fingerprint import home
    from workflow.runtime.timings import read_parts

    return sum(read_parts(home(stage, scene, QUALITY), stage)["job"]["cpu_seconds"] for stage in AFTER_PRIOR)


# ---------------------------------------------------------------------------------------------------------- many rooms


def keep(file: Path, study: str, variant: str) -> None:
    """Write the row of every room of a study to a file, those that are unchanged as they are there."""
    from workflow.runtime import device, native

    native.prepare()
    native.limit_threads(1)
    device.mitsuba()
    numbers = range(drawn.COUNT - drawn.REPORTED) if study == STUDIES[0] else range(drawn.COUNT - drawn.REPORTED, drawn.COUNT)
    known = {(row["room"], row["fingerprint"]): row for row in read_rows(file)} if file.is_file() else {}
    rows: list[Mapping[str, Any]] = []
    for number in numbers:
        before = known.get((str(number), mark(scene_of(number, variant))))
        row = before if before and before["status"] == "done" else room_row(number, variant)
        rows.append({key: _short(value) for key, value in row.items()})
        print(f"room {number}: {row['status']}", file=sys.stderr, flush=True)
        _write(file, rows)
    print("\n".join(_table(DISTRIBUTION, distribution(read_rows(file)))))


def _write(file: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    with file.open("w", newline="") as opened_file:
        table = csv.DictWriter(opened_file, (*HEAD, *COLUMNS), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def _short(value: Any) -> Any:
    return f"{value:.5g}" if isinstance(value, float | np.floating) else value


def read_rows(file: Path) -> list[dict[str, str]]:
    """Return the rows of a file.

    Raises:
        InputError: it has other columns.
    """
    with file.open(newline="") as opened_file:
        table = csv.DictReader(opened_file)
        if tuple(table.fieldnames or ()) != (*HEAD, *COLUMNS):
            raise InputError(f"{file}: its columns are not those of this program; keep the rows again (--keep)")
        return list(table)


def done(rows: Sequence[Row]) -> dict[str, Row]:
    """Return number -> row of the rooms that have a result."""
    return {row["room"]: row for row in rows if row["status"] == "done"}


def column(rows: Sequence[Row], name: str) -> Array:
    """Return a column as numbers, NaN where a row has none."""
    return np.array([float(row[name] or "nan") for row in rows])


def compare(before: Sequence[Row], after: Sequence[Row]) -> list[list[str]]:
    """Return a table of what changed in the rooms that both have a result of: means, mean change and its standard error over
    rooms, quartiles of the change, the worst and the best room; first, in how many rooms there is a result."""
    a, b = done(before), done(after)
    both = sorted(set(a) & set(b), key=int)
    lost, new = (", ".join(sorted(of, key=int)) or "none" for of in (set(a) - set(b), set(b) - set(a)))
    out = [["rooms with a result", f"{len(both)}", f"{len(a)}", f"{len(b)}", *[""] * 5, f"lost: {lost}", f"new: {new}"]]
    for name, of in COLUMNS.items():
        was, now = (column([rows[room] for room in both], name) for rows in (a, b))
        known = np.isfinite(was) & np.isfinite(now)
        if not known.any():
            continue
        change, rooms, digits = (now - was)[known], np.array(both)[known], max(of.digits, 2)
        error = change.std(ddof=1) / np.sqrt(len(change)) if len(change) > 1 else float("nan")
        order = np.argsort((of.good or 1) * change)
        numbers = [was[known].mean(), now[known].mean(), change.mean(), error, *np.quantile(change, (0.25, 0.5, 0.75))]
        ends = [f"{change[i]:+.{digits}f} (room {rooms[i]})" for i in order[[0, -1]]]
        out.append([of.label, f"{len(change)}", *(f"{x:.{digits}f}" for x in numbers), *ends])
    return out


def distribution(rows: Sequence[Row]) -> list[list[str]]:
    """Return a table of the distribution of each number over rooms, and of how many it went wrong in; first, in how many there is
    a result."""
    found = list(done(rows).values())
    failed = sum(row["status"].startswith("failed") for row in rows)
    out = [["rooms with a result", f"{len(found)}", *[""] * 8, f"{failed} of {len(rows)} failed"]]
    for name, of in COLUMNS.items():
        values = column(found, name)
        values = values[np.isfinite(values)]
        if len(values):
            numbers = [values.mean(), *np.quantile(values, (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0))]
            wrong = "" if of.bad is None else f"{(of.good * values < of.good * of.bad).sum()}"
            out.append([of.label, f"{len(values)}", *(f"{x:.{of.digits}f}" for x in numbers), wrong])
    return out


# ------------------------------------------------------------------------------------------------------------ the page


def sheet(rows: Sequence[Row]) -> Array:
    """Return a picture (H, W, 3) uint8 with a line for each room: a photograph, then true and found albedo, roughness, metallic.

    Raises:
        InputError: the results in the working folder are not those of the rows.
    """
    from iif_core.numerics.color import srgb_from_linear
    from workflow.artifacts.store import rgb
    from workflow.scene.normal_form import CaptureReader

    lines = []
    for row in rows:
        scene = scene_of(int(row["room"]), row["variant"])
        if mark(scene) != row["fingerprint"]:
            raise InputError(f"room {row['room']}: its row is of other results than those here; keep the rows again (--keep)")
        capture = CaptureReader(opened("capture", scene))
        view = capture.used[len(capture.used) // 2]
        pair = capture.reader.exr(f"truth/{view.name}.exr"), opened("affines", scene).exr(f"maps/{view.name}.exr")
        tiles = [capture.photo(view)[0], *(srgb_from_linear(np.clip(rgb(maps, "albedo"), 0, 1)) for maps in pair)]
        tiles += [np.repeat(maps[name][..., None], 3, -1) for name in ("roughness", "metallic") for maps in pair]
        lines.append(np.concatenate(tiles, 1))
    return np.rint(255 * np.clip(np.nan_to_num(np.concatenate(lines)), 0, 1)).astype(np.uint8)


def write_page(count: int = 10) -> None:
    """Fill the tables of the page from the rows of the notebook, and write its picture of the worst rooms that choose."""
    from PIL import Image

    from workflow.report.blocks import fill

    tables = {}
    for study in STUDIES:
        rows = read_rows(DATA / f"{study}.csv") if (DATA / f"{study}.csv").is_file() else []
        tables[study] = "\n".join(_table(DISTRIBUTION, distribution(rows))) if rows else "*not made yet*"
    chosen = list(done(read_rows(DATA / f"{STUDIES[0]}.csv")).values())
    last = [chosen[i] for i in np.argsort(column(chosen, "albedo"))[:count]]
    picture = Image.fromarray(sheet(last))
    picture.resize((2 * picture.width, 2 * picture.height), Image.Resampling.NEAREST).save(PICTURE, optimize=True)
    heads = ["room", "light from outside", "lamps", *(COLUMNS[name].label for name in WORST)]
    words = [[row["room"], row["light"] or "-", row["lamps"].replace("_", " ") or "-"] for row in last]
    cells = [[f"{float(row[name]):.{COLUMNS[name].digits}f}" if row[name] else "-" for name in WORST] for row in last]
    tables["worst"] = "\n".join(_table(heads, [a + b for a, b in zip(words, cells, strict=True)], 3))
    PAGE.write_text(fill(PAGE.read_text(), tables))


def _table(head: Sequence[str], body: Sequence[Sequence[str]], words: int = 1) -> list[str]:
    from workflow.report.blocks import markdown

    return markdown(head, body, words)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, nargs="?", const="", help="file of rows, by default the notebook's")
    parser.add_argument("--study", choices=STUDIES, default=STUDIES[0])
    parser.add_argument("--variant", default="ours", help="of lab/config/studies/drawn.yaml")
    parser.add_argument("--compare", type=Path, nargs=2)
    parser.add_argument("--page", action="store_true")
    asked = parser.parse_args()
    try:
        if asked.keep is not None:
            keep(DATA / f"{asked.study}.csv" if asked.keep == Path("") else asked.keep, asked.study, asked.variant)
        if asked.compare:
            print("\n".join(_table(COMPARED, compare(*(read_rows(file) for file in asked.compare)))))
        if asked.page:
            write_page()
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
