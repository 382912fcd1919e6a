"""How well the two estimates of each object's level are weighed (Eq. M.34 to M.36), and what other priors of the factors would
do, without a run: from what the fits of finished rooms knew, and the truth.

    python lab/benchmarks/level_factors.py [--try CENTRE_BASE WIDTH_BASE CENTRE_LIGHT WIDTH_LIGHT] [--table FILE.csv]
    python lab/benchmarks/level_factors.py --from FOLDER SCENE... --table FILE.csv

The first form reads `lab/notebook/data/object_levels.csv` (simulated predictions) or another table, whose rows are objects: what
the last comparison of a fit was given (mean base albedo, level that the photographs ask for, scatter of the predictions, smooth
error of the light, pixels, the error of the base that the prior states), the true mean albedo, and the pixels that show it. It
prints the true factors, the scale of Student's t of the real errors over what Eq. M.32 and M.33 say, and PSNR in dB of the
objects' levels, up to scale and as they are. Where the error of the base is stated, only CENTRE_LIGHT is tried. The second form
adds rows: it makes stage affines of finished rooms again, such as `sky--rooms-ours-s0`, and FOLDER is the working folder of runs
of this very code.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import lab  # noqa: F401  for the sources of the laboratory
from iif_core.fitting import direct, object_levels
from iif_core.fitting.object_levels import ObjectLevels, compare_levels

TABLE = Path(__file__).resolve().parents[2] / "lab/notebook/data/object_levels.csv"
COLOURS = ("base", "shown", "true")
COLUMNS = ("room", "object", *(f"{n}_{c}" for n in COLOURS for c in "rgb"), "scatter", "smooth", "pixels", "count", "stated")
LEAST_OBJECTS = 3
"""A room of fewer objects tells nothing about its factors."""


def measured(folder: Path, scene: str) -> pd.DataFrame:
    """Make stage affines of a scene again; return the rows of its objects."""
    os.chdir(folder)
    from workflow.artifacts.store import StageReader, ids_from_disk
    from workflow.runtime.job import run_stage
    from workflow.scene.normal_form import CaptureReader

    asked, stated, objects = [], [], []
    compare, measure = object_levels.compare_levels, direct.measure_texture

    def compared(*arguments: Any) -> ObjectLevels:
        asked.append([np.array(a) for a in arguments[:5]])
        stated.append(arguments[6])
        return compare(*arguments)

    def fitted(found, options):
        texture = measure(found, options)
        objects.append(np.flatnonzero(texture.enough))
        return texture

    object_levels.compare_levels, direct.measure_texture = compared, fitted
    try:
        run_stage("affines", scene, "draft", 1, None)
    finally:
        object_levels.compare_levels, direct.measure_texture = compare, measure
    base, shown, scatter, smooth, pixels = asked[-1]
    own = objects[0]
    assert len(own) == len(base), f"{scene}: {len(own)} objects with pixels, {len(base)} in the fit"

    def reader(stage: str) -> StageReader:
        return StageReader(Path("results") / scene / stage, stage, scene)

    capture, segmentation = CaptureReader(reader("capture")), reader("segmentation")
    total, count = np.zeros((own.max() + 1, 3)), np.zeros(own.max() + 1)
    for view in capture.views:
        truth, number = capture.truth(view), ids_from_disk(segmentation.exr(f"maps/{view.name}.exr")["object.id"])
        counts = (number >= 0) & (number < len(count)) & truth.valid & (truth.metallic < 0.5)
        np.add.at(total, number[counts], truth.albedo[counts])
        np.add.at(count, number[counts], 1)
    true, room = (total / np.maximum(count, 1)[:, None])[own], np.full(len(own), scene.split("--")[0], object)
    parts = [room, own, *base.T, *shown.T, *true.T, scatter, smooth, pixels, count[own], stated[-1]]
    return pd.DataFrame(dict(zip(COLUMNS, parts, strict=True)))


def columns(rows: pd.DataFrame, name: str) -> np.ndarray:
    return rows[[f"{name}_{c}" for c in "rgb"]].to_numpy(np.float64)


def levels(rows: pd.DataFrame) -> ObjectLevels:
    numbers = (rows[name].to_numpy(np.float64) for name in ("scatter", "smooth", "pixels"))
    return compare_levels(columns(rows, "base"), columns(rows, "shown"), *numbers, stated=stated_error(rows))


def stated_error(rows: pd.DataFrame) -> float | None:
    """What the prior of a room states (`PredictionErrors.brightness`)."""
    stated = rows["stated"].iloc[0] if "stated" in rows else None
    return None if pd.isna(stated) else float(stated)


def weight(rows: pd.DataFrame) -> np.ndarray:
    return np.where(rows["pixels"] > 0, rows["count"], 0.0)


def psnr(level: np.ndarray, rows: pd.DataFrame, scaled: bool) -> float:
    """Of levels (O, 3), by the pixels that show the objects."""
    w, true, level = weight(rows)[:, None], columns(rows, "true"), np.clip(level, 0.0, 1.0)
    scale = (w * level * true).sum() / (w * level**2).sum() if scaled else 1.0
    return float(-10 * np.log10((w * (scale * level - true) ** 2).sum() / (3 * w.sum())))


def scale_of_t(error: np.ndarray, w: np.ndarray) -> float:
    """Maximum likelihood scale of Student's t of four degrees of freedom, around the weighted median."""
    order = np.argsort(error)
    away = error - error[order][np.searchsorted(np.cumsum(w[order]), 0.5 * w.sum())]
    scales = np.geomspace(0.01, 20, 300)
    return float(scales[np.argmax([(w * (-np.log(s) - 2.5 * np.log1p((away / s) ** 2 / 4))).sum() for s in scales])])


def true_factors(rows: pd.DataFrame) -> tuple[float, float]:
    """(kappa_B, kappa_L) of the real errors."""
    own = weight(rows) > 0
    true = np.maximum(columns(rows, "true").sum(1), 1e-3)
    found = levels(rows)
    # The claims of the fit are its factors times these; `compare_levels` keeps the product.
    smooth = np.maximum(rows["smooth"].to_numpy(np.float64), object_levels._SMALLEST_ERROR)
    brightness = [np.log(np.maximum(columns(rows, name).sum(1), 1e-3) / true) for name in ("base", "shown")]
    unit = found.base_error / base_factor(rows, found)
    errors = brightness[0] / unit, brightness[1] / smooth
    return tuple(scale_of_t(error[own], weight(rows)[own]) for error in errors)  # type: ignore[return-value]


def base_factor(rows: pd.DataFrame, found: ObjectLevels) -> float:
    """The factor of the base that a fit has learnt: its claim over that with the factor held at 1. Nothing is learnt where the
    error is stated."""
    if stated_error(rows) is not None:
        return 1.0
    kept = object_levels._BASE_FACTORS
    object_levels._BASE_FACTORS = np.ones(1)
    try:
        return float(np.median(found.base_error / levels(rows).base_error))
    finally:
        object_levels._BASE_FACTORS = kept


def with_priors(centre_base: float, width_base: float, centre_light: float, width_light: float) -> None:
    object_levels._BASE_FACTOR, object_levels._BASE_FACTOR_WIDTH = centre_base, width_base
    object_levels._LIGHT_FACTOR, object_levels._LIGHT_FACTOR_WIDTH = centre_light, width_light
    object_levels._LIGHT_FACTORS = np.geomspace(0.2, 5.0, 17)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--try", dest="tried", nargs=4, type=float, help="centres and widths of the priors of Eq. M.35")
    parser.add_argument("--from", dest="runs", nargs="+", help="working folder and scenes to measure")
    parser.add_argument("--table", type=Path, default=TABLE)
    arguments = parser.parse_args()
    table = arguments.table.resolve()
    if arguments.runs:
        new = [measured(Path(arguments.runs[0]).resolve(), scene) for scene in arguments.runs[1:]]
        old = [pd.read_csv(table)] if table.exists() else []
        every = pd.concat(old + new).drop_duplicates(["room", "object"], keep="last").sort_values(["room", "object"])
        every.to_csv(table, index=False, float_format="%.5g", lineterminator="\n")
        return
    rooms = [(room, rows) for room, rows in pd.read_csv(table).groupby("room") if (rows["count"] > 0).sum() >= LEAST_OBJECTS]
    now = {room: levels(rows) for room, rows in rooms}
    factors = {room: true_factors(rows) for room, rows in rooms}
    if arguments.tried:
        with_priors(*arguments.tried)
    print("room                      true kappa_B kappa_L | base         photographs  result       with the priors tried")
    scores = []
    for room, rows in rooms:
        tried = levels(rows) if arguments.tried else now[room]
        given = [columns(rows, "base"), columns(rows, "shown"), *(x.shown / x.light_gain[:, None] for x in (now[room], tried))]
        scores.append([psnr(level, rows, scaled) for level in given for scaled in (True, False)])
        print(f"{room:24s} {factors[room][0]:8.2f} {factors[room][1]:8.2f}     |" + pairs(scores[-1]))
    print(f"{'mean':24s} {'':21s} |" + pairs(np.mean(scores, 0).tolist()))
    log = np.log(list(factors.values()))
    for name, values in zip(("kappa_B", "kappa_L"), log.T, strict=True):
        print(f"true {name}: centre {np.exp(values.mean()):.2f}, width of the logarithm {values.std():.2f}")


def pairs(values: list[float]) -> str:
    return "".join(f" {a:5.2f} {b:5.2f} " for a, b in zip(values[::2], values[1::2], strict=True))


if __name__ == "__main__":
    main()
