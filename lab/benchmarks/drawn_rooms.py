"""The bed of drawn rooms: what a change does in many rooms that nobody looked at (lab/docs/drawn.md).

    python lab/benchmarks/drawn_rooms.py FOLDER [--rooms 0:120] [--variant ours] [--jobs 2] [--file ROWS]   run and measure
    python lab/benchmarks/drawn_rooms.py --compare BEFORE AFTER    what changed between two files, room by room
    python lab/benchmarks/drawn_rooms.py FOLDER --page             the tables and the picture of lab/notebook/drawn.md

Rooms are scenes `drawn-<number>--drawn-<variant>-s0` of a working folder, made by the ordinary stages, but several rooms to a
process, because starting a process for each stage would take as long as the stages. Stages whose settings and code are unchanged
are not made again, so photographs are rendered once. A row for each room is added to the file as it is finished, with the
fingerprint of its result; a room that has a row of that fingerprint is left out.

The last `drawn.REPORTED` rooms only report: they are run if `--report` asks for them, once for each change that is finished, and
nothing is chosen by them.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
import traceback
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import lab  # noqa: F401  for the sources of the laboratory
from iif_core.errors import InputError
from lab.rooms import drawn
from workflow.artifacts import StageReader

Array = np.ndarray
REPOSITORY = Path(__file__).resolve().parents[2]
FILE, PAGE = REPOSITORY / "lab/notebook/data/drawn_rooms.csv", REPOSITORY / "lab/notebook/drawn.md"
PICTURE = REPOSITORY / "lab/notebook/pictures/drawn_worst.png"
QUALITY = "draft"
STAGES = (
    *("capture", "plan", "prior", "segmentation", "base", "emission"),
    *("shading", "second_look", "affines", "render", "metrics"),
)
AFTER_PRIOR = STAGES[STAGES.index("prior") + 1 :]
SEEN = 4
"""Pixels of all photographs that show a lamp which counts as seen."""
LEAST_CELLS = 50
"""Cells of known truth that an object needs for its interval to be judged."""
METAL = 0.5
"""Metallic from which on a surface counts as metal."""
CHOOSE = range(drawn.COUNT - drawn.REPORTED)
REPORT = range(drawn.COUNT - drawn.REPORTED, drawn.COUNT)


@dataclass(frozen=True)
class Column:
    """A number of a room.

    Attributes:
        label: for people.
        good: 1 if more is better, -1 if less is, 0 if neither.
        digits: after the point.
    """

    label: str
    good: int = 0
    digits: int = 1


COLUMNS = {
    "albedo": Column("albedo as it is, dB", 1),
    "albedo_scaled": Column("albedo up to scale, dB", 1),
    "base": Column("base, as it is, dB", 1),
    "base_scaled": Column("base, up to scale, dB", 1),
    "raw": Column("predictions, as they are, dB", 1),
    "raw_scaled": Column("predictions, up to scale, dB", 1),
    "roughness": Column("roughness, mean square", -1, 3),
    "metallic": Column("metallic, mean square", -1, 3),
    "rgb": Column("re-rendered, dB", 1),
    "rgb_held_out": Column("re-rendered, held out, dB", 1),
    "corrected": Column("corrected, held out, dB", 1),
    "iou": Column("lamps, intersection over union", 1, 2),
    "false_m2": Column("false lamps, m²", -1, 2),
    "false_power": Column("false lamps, share of the power", -1, 3),
    "missed_seen": Column("seen lamps missed, share of the power", -1, 3),
    "missed_unseen": Column("unseen lamps missed, share of the power", -1, 3),
    "lamps_seen": Column("power of the seen lamps", 0, 3),
    "lamps_unseen": Column("power of the unseen lamps", 0, 3),
    "false_metal": Column("false metal, share of the surface", -1, 4),
    "metal_found": Column("metal found, share of it", 1, 2),
    "metal": Column("metal, share of the surface", 0, 3),
    "held_albedo": Column("intervals of albedo that hold", 0, 2),
    "held_roughness": Column("intervals of roughness that hold", 0, 2),
    "objects": Column("objects that were judged", 0, 0),
    "level": Column("albedo over true albedo", 0, 2),
    "cpu": Column("CPU seconds after the prior", -1, 0),
}
COMPARED = ["", "rooms", "before", "after", "change", "its error", "25 %", "50 %", "75 %", "worst", "best"]
DISTRIBUTION = ["", "rooms", "mean", "least", "10 %", "25 %", "50 %", "75 %", "90 %", "most"]
SHOWN = ("albedo", "albedo_scaled", "base", "base_scaled", "rgb", "iou", "false_power", "false_metal")
"""What the table of the worst rooms shows; COMPARED and DISTRIBUTION are heads of tables."""
HEAD = ("room", "variant", "fingerprint", "status", "outside", "lamps")


# ------------------------------------------------------------------------------------------------------------- a room


def scene_of(number: int, variant: str) -> str:
    """Return the name of the scene of a room."""
    return f"{drawn.PREFIX}{number}--drawn-{variant}-s0"


def room_row(number: int, variant: str) -> dict[str, Any]:
    """Make what is missing of a room in the working folder, and return its row; a refusal of the product is one, too."""
    from workflow.runtime import device, native
    from workflow.runtime.fingerprint import fingerprint, home
    from workflow.runtime.job import Planned, run_stage

    native.prepare()
    device.mitsuba()
    scene = scene_of(number, variant)
    row: dict[str, Any] = {"room": number, "variant": variant, "fingerprint": fingerprint("metrics", scene, QUALITY)}
    try:
        for stage in STAGES:
            try:
                Planned().reader(stage, scene, QUALITY)
            except InputError:
                run_stage(stage, home(stage, scene, QUALITY), QUALITY, threads=1)
        return row | {"status": "done"} | measured(number, scene)
    except InputError as error:
        return row | {"status": f"refused: {error}"[:200]}


def measured(number: int, scene: str) -> dict[str, Any]:
    """Return the numbers of a room whose stages are finished."""
    from workflow.runtime.job import Job
    from workflow.scene.normal_form import CaptureReader

    room, job = drawn.build(number), Job("export", scene, QUALITY, 1)
    capture = CaptureReader(opened("capture", scene))
    found = scores(scene) | of_lamps(room, job, capture) | of_materials(job, capture) | held(job)
    return light_of(room) | found | {"cpu": _cpu(scene)}


def opened(stage: str, scene: str) -> StageReader:
    """Return the reader of a finished stage that hides no truth."""
    from workflow.runtime.fingerprint import home
    from workflow.runtime.job import stage_directory

    at = home(stage, scene, QUALITY)
    return StageReader(stage_directory(at, stage), stage, at)


def light_of(room: Any) -> dict[str, str]:
    """Say where the light of a room comes from."""
    names = [name.rsplit(" ", 1)[0] for name in room.names]
    lamps = sorted({names[i] for i in np.unique(room.object_id[room.emission.any(1)])})
    windows = "window frame" in names and "window pane" not in names
    sky = room.environment.mean(-1)
    outside = "" if not windows else "sun" if sky.max() > 50 * np.median(sky) else "dusk" if sky.max() < 1 else "sky"
    cover = [name for name in ("curtain", "blinds") if name in names]
    return {"outside": " ".join([outside, *cover]).strip(), "lamps": " ".join(name.replace(" ", "_") for name in lamps)}


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
    out |= {name: mean("result", name, "raw", "l2") for name in ("roughness", "metallic")}
    out |= {name: mean("result", name, "raw", "psnr") for name in ("rgb", "rgb_held_out")}
    return out | {
        "corrected": mean("corrected", "rgb_held_out", "raw", "psnr"),
        "iou": mean("result", "emission", "raw", "iou"),
    }


def of_lamps(room: Any, job: Any, capture: Any) -> dict[str, float]:
    """Return what is wrong with the lamps that were found."""
    from lab.rooms.lamps_found import lamps_found
    from workflow.artifacts.store import rgb
    from workflow.scene.recovered import read_recovered

    recovered = read_recovered(job)
    surface, shines = recovered.surface, np.flatnonzero(recovered.emitter_id >= 0)
    found = lamps_found(room, surface.vertices, surface.faces[shines], recovered.light.radiance.mean(1)[shines])
    owner, pixels = capture.faces()["instance_id"], np.zeros(len(room.names), int)
    for view in capture.used:
        emits = rgb(capture.reader.exr(f"truth/{view.name}.exr"), "emission").any(-1)
        face = capture.gbuffer(view)[1]
        pixels += np.bincount(owner[face[emits & (face >= 0)]], minlength=len(pixels))
    seen = np.flatnonzero(pixels >= SEEN)
    is_seen = np.isin(found.lamp, seen)
    return {
        "false_m2": found.false_m2,
        "false_power": found.false_power,
        "missed_seen": found.missed_power(seen),
        "missed_unseen": found.missed_power(found.lamp[~is_seen]),
        "lamps_seen": float(found.power[is_seen].sum()),
        "lamps_unseen": float(found.power[~is_seen].sum()),
    }


def of_materials(job: Any, capture: Any) -> dict[str, float]:
    """Return what is wrong with metals, and the level of the albedo."""
    from workflow.scene.base_scene import read_base
    from workflow.scoring.scores import cell_truth

    base = read_base(job)
    truth = cell_truth(capture, job.read("segmentation"), base)
    found = job.read("affines").table("cells.parquet", ("albedo_r", "albedo_g", "albedo_b", "metallic"))
    known = np.isfinite(truth["metallic"][:, 0]) & np.isfinite(truth["albedo"]).all(1)
    true, claimed = truth["metallic"][known, 0] > METAL, found["metallic"][known] > METAL
    albedo = np.stack([found[f"albedo_{c}"][known] for c in "rgb"], 1).mean(1)
    ratio = np.log(np.maximum(albedo, 1e-3) / np.maximum(truth["albedo"][known].mean(1), 1e-3))
    share = float(true.mean()) if known.any() else float("nan")
    return {
        "false_metal": float((claimed & ~true).mean()) if known.any() else float("nan"),
        "metal_found": float(claimed[true].mean()) if true.any() else float("nan"),
        "metal": share,
        "level": float(np.exp(np.median(ratio))) if known.any() else float("nan"),
    }


def held(job: Any) -> dict[str, float]:
    """Return which share of the objects' 95 % intervals, as the product makes them, hold the truth."""
    from iif_core.fitting.intervals import MeasuredErrors
    from lab.benchmarks import object_intervals
    from workflow.decisions.held import measured as shipped

    rows = list(object_intervals.measured(job.scene, QUALITY, LEAST_CELLS))
    if not rows:
        return {"held_albedo": float("nan"), "held_roughness": float("nan"), "objects": 0}
    (room,) = object_intervals.rooms_of(rows)
    found = object_intervals.coverage(room, MeasuredErrors(**shipped()["errors"]))
    return {"held_albedo": found["albedo"], "held_roughness": found["roughness"], "objects": found["objects"]}


def _cpu(scene: str) -> float:
    from workflow.runtime.fingerprint import home
    from workflow.runtime.timings import read_parts

    return sum(read_parts(home(stage, scene, QUALITY), stage)["job"]["cpu_seconds"] for stage in AFTER_PRIOR)


# ---------------------------------------------------------------------------------------------------------- many rooms


def run(folder: Path, numbers: Iterable[int], variant: str, jobs: int, file: Path) -> None:
    """Make rooms, and add a row of each to a file."""
    from workflow.runtime.fingerprint import fingerprint

    os.chdir(folder)
    known = {(row["room"], row["fingerprint"]) for row in read_rows(file)}
    wanted = {number: fingerprint("metrics", scene_of(number, variant), QUALITY) for number in numbers}
    todo = [number for number, mark in wanted.items() if (str(number), mark) not in known]
    with file.open("a", newline="") as opened_file:
        table = csv.DictWriter(opened_file, (*HEAD, *COLUMNS), lineterminator="\n")
        if not opened_file.tell():
            table.writeheader()
        # A worker is replaced from time to time, because compiled kernels and caches of files stay in its memory.
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), max_tasks_per_child=20) as pool:
            futures = {pool.submit(_worked, number, variant, folder): number for number in todo}
            for future in as_completed(futures):
                row = future.result()
                table.writerow({key: _short(value) for key, value in row.items()})
                opened_file.flush()
                words = (f"{name} {_short(row.get(name, ''))}" for name in ("albedo", "albedo_scaled", "rgb", "iou", "cpu"))
                print(f"room {row['room']}: {row['status']}, {', '.join(words)}", flush=True)


def _worked(number: int, variant: str, folder: Path) -> dict[str, Any]:
    os.chdir(folder)
    try:
        return room_row(number, variant)
    except Exception as error:  # of the product: it is a result of this room, and the other rooms go on
        traceback.print_exc()
        return {"room": number, "variant": variant, "status": f"failed: {type(error).__name__}: {error}"[:200]}


def _short(value: Any) -> Any:
    return f"{value:.5g}" if isinstance(value, float | np.floating) else value


def read_rows(file: Path) -> list[dict[str, str]]:
    """Return the rows of a file; none if it is not there."""
    if not file.is_file():
        return []
    with file.open(newline="") as opened_file:
        return list(csv.DictReader(opened_file))


def columns(rows: Sequence[Mapping[str, str]], name: str) -> Array:
    """Return a column as numbers, NaN where a row has none."""
    return np.array([float(row.get(name) or "nan") for row in rows])


def compare(before: Sequence[Mapping[str, str]], after: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Return a table of what changed in the rooms of both: mean, its standard error, quartiles, the worst and the best room."""
    pairs = [({row["room"]: row for row in rows if row["status"] == "done"}) for rows in (before, after)]
    both = sorted(set(pairs[0]) & set(pairs[1]), key=int)
    out = []
    for name, column in COLUMNS.items():
        a, b = (columns([of[room] for room in both], name) for of in pairs)
        known = np.isfinite(a) & np.isfinite(b)
        if not known.any():
            continue
        gain, rooms = (b - a)[known], np.array(both)[known]
        sign = column.good or 1
        error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else float("nan")
        digits = max(column.digits, 2)
        worst, best = (sign * gain).argmin(), (sign * gain).argmax()
        numbers = [a[known].mean(), b[known].mean(), gain.mean(), error, *np.quantile(gain, (0.25, 0.5, 0.75))]
        ends = [f"{gain[i]:+.{digits}f} (room {rooms[i]})" for i in (worst, best)]
        out.append([column.label, f"{len(gain)}", *(f"{x:.{digits}f}" for x in numbers), *ends])
    return out


def distribution(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Return a table of the distribution of each number over rooms."""
    out = []
    for name, column in COLUMNS.items():
        values = columns(rows, name)
        values = values[np.isfinite(values)]
        if len(values):
            numbers = [values.mean(), *np.quantile(values, (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0))]
            out.append([column.label, f"{len(values)}", *(f"{x:.{column.digits}f}" for x in numbers)])
    return out


def counts(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Return a table of in how many rooms something went wrong."""
    gains = [columns(rows, f"albedo{end}") - columns(rows, f"base{end}") for end in ("", "_scaled")]
    lowest = np.min(gains, axis=0)
    below = {"result below its base by more than 0.3 dB, as it is or up to scale": lowest < -0.3}
    below |= {"false lamps of more than 2 % of the power": columns(rows, "false_power") > 0.02}
    below |= {"seen lamps missed, more than 3 % of their power": columns(rows, "missed_seen") > 0.03}
    below |= {"false metal on more than 0.3 % of the surface": columns(rows, "false_metal") > 0.003}
    return [[label, f"{wrong.sum()} of {len(rows)}"] for label, wrong in below.items()]


# ------------------------------------------------------------------------------------------------------------ the page


def worst(rows: Sequence[Mapping[str, str]], count: int = 10) -> list[Mapping[str, str]]:
    """Return the rooms with the worst albedo as it is."""
    done = [row for row in rows if row["status"] == "done"]
    return [done[i] for i in np.argsort(columns(done, "albedo"))[:count]]


def sheet(rows: Sequence[Mapping[str, str]]) -> Array:
    """Return a picture (H, W, 3) uint8 of rooms, a row for each: photograph, true and found albedo, roughness, metallic and
    re-rendering of the photograph with the median score of albedo."""
    from iif_core.numerics.color import srgb_from_linear
    from workflow.artifacts.store import rgb
    from workflow.scene.normal_form import CaptureReader

    lines = []
    for row in rows:
        scene = scene_of(int(row["room"]), row["variant"])
        capture = CaptureReader(opened("capture", scene))
        view = capture.used[len(capture.used) // 2]
        true, found = capture.reader.exr(f"truth/{view.name}.exr"), opened("affines", scene).exr(f"maps/{view.name}.exr")
        tiles = [capture.photo(view)[0]]
        for maps in (true, found):
            tiles += [srgb_from_linear(np.clip(rgb(maps, "albedo"), 0, 1))]
            tiles += [np.repeat(maps[name][..., None], 3, -1) for name in ("roughness", "metallic")]
        lines.append(np.concatenate([tiles[i] for i in (0, 1, 4, 2, 5, 3, 6)], 1))
    return np.rint(255 * np.clip(np.nan_to_num(np.concatenate(lines)), 0, 1)).astype(np.uint8)


def write_page(folder: Path, file: Path) -> None:
    """Fill the tables of the page, and write its picture."""
    from PIL import Image

    from workflow.report.blocks import fill, markdown

    os.chdir(folder)
    rows = [row for row in read_rows(file) if row["status"] == "done" and row["variant"] == "ours"]
    tables = {}
    for name, numbers in {"choose": CHOOSE, "report": REPORT}.items():
        of = [row for row in rows if int(row["room"]) in numbers]
        if of:
            tables[name] = "\n".join(markdown(DISTRIBUTION, distribution(of)))
            tables[f"{name} counts"] = "\n".join(markdown(["", "rooms"], counts(of)))
    last = worst([row for row in rows if int(row["room"]) in CHOOSE])
    picture = Image.fromarray(sheet(last))
    picture.resize((2 * picture.width, 2 * picture.height), Image.Resampling.NEAREST).save(PICTURE, optimize=True)
    heads = ["room", "light from outside", "lamps", *(COLUMNS[name].label for name in SHOWN)]
    words = [[row["room"], row["outside"] or "-", row["lamps"].replace("_", " ") or "-"] for row in last]
    lines = [own + [_cell(row, name) for name in SHOWN] for own, row in zip(words, last, strict=True)]
    tables["worst"] = "\n".join(markdown(heads, lines, 3))
    PAGE.write_text(fill(PAGE.read_text(), tables))


def _cell(row: Mapping[str, str], name: str) -> str:
    return f"{float(row[name]):.{COLUMNS[name].digits}f}" if row[name] else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--rooms", default=f"0:{len(CHOOSE)}", help="from : to, the last one left out")
    parser.add_argument("--report", action="store_true", help="also the rooms by which nothing is chosen")
    parser.add_argument("--variant", default="ours", help="of lab/config/studies/drawn.yaml")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--file", type=Path, default=FILE)
    parser.add_argument("--compare", type=Path, nargs=2)
    parser.add_argument("--page", action="store_true")
    asked = parser.parse_args()
    if asked.compare:
        from workflow.report.blocks import markdown

        return print("\n".join(markdown(COMPARED, compare(*(read_rows(file) for file in asked.compare)))))
    if asked.folder is None:
        parser.error("FOLDER is needed: where rooms are made, or were")
    asked.folder.mkdir(parents=True, exist_ok=True)
    if asked.page:
        return write_page(asked.folder.resolve(), asked.file.resolve())
    first, last = (int(number) for number in asked.rooms.split(":"))
    numbers = [number for number in range(first, last) if asked.report or number in CHOOSE]
    run(asked.folder.resolve(), numbers, asked.variant, asked.jobs, asked.file.resolve())


if __name__ == "__main__":
    main()
