"""The front of speed and accuracy over the rooms of a study, and the points taken from it (`python -m lab points`)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iif_core.errors import InputError
from lab.points.picture import PICTURE, Pooled, draw
from lab.studies.files import load_study
from workflow.artifacts.files import write_atomically
from workflow.settings.names import REPOSITORY
from workflow.settings.scene import SceneSettings
from workflow.trade.points import SCORES, SHIPPED, Point, named

if TYPE_CHECKING:
    import pandas as pd

STUDY = "tradeoff"
TABLE = Path("lab/notebook/data/tradeoff.csv")
STEP = 1.2
"""Of the runs that cost less than this many times the cheapest of them, the best one becomes a point."""
LEAST_GAIN = 0.1
"""And has at least this many dB more."""


def pool(frame: pd.DataFrame) -> list[Pooled]:
    """Return the variants that were run in every room, the cheapest first; seeds are averaged.

    Args:
        frame: rows of the study (`lab.studies.table.KEPT`).
    """
    rooms = sorted(frame["scene"].unique())
    out = []
    for variant, rows in frame.groupby("variant"):
        of_room: dict[str, dict[str, float]] = {}
        for room, own in rows.groupby("scene"):
            scores = {
                name: float(own[(own["quantity"] == q) & (own["metric"] == m) & (own["protocol"] == p)]["value"].mean())
                for name, (q, m, p) in SCORES.items()
            }
            costs = {name: float(own.groupby("seed")[name].first().mean()) for name in ("cpu_seconds", "max_rss_mb", "disk_mb")}
            of_room[str(room)] = {**scores, **costs}
        values = [value for found in of_room.values() for value in found.values()]
        if len(of_room) < len(rooms) or not all(map(math.isfinite, values)):
            continue
        cost = math.exp(sum(math.log(found["cpu_seconds"]) for found in of_room.values()) / len(rooms))
        albedo = sum(found["albedo"] for found in of_room.values()) / len(rooms)
        out.append(Pooled(str(variant), cost, albedo, of_room))
    return sorted(out, key=lambda one: (one.cpu_seconds, -one.albedo))


def front(pooled: list[Pooled], step: float = STEP, gain: float = LEAST_GAIN) -> list[Pooled]:
    """Return the Pareto front, thinned: of the points within a factor `step` of the first of them the best one is kept.

    Every point is at least `gain` dB better than the one before.

    Args:
        pooled: the cheapest first, at least one.
    """
    out, opened = [pooled[0]], pooled[0].cpu_seconds
    for one in pooled[1:]:
        if one.albedo < out[-1].albedo + gain:
            continue
        if one.cpu_seconds < step * opened:
            out[-1] = one
        else:
            out.append(one)
            opened = one.cpu_seconds
    return out


SIZES = {"capture": ("views", "width", "height"), "prior": ("samples",)}
"""Settings that a point names even where they are the defaults."""
OF_THE_PHOTOGRAPHS = {"capture": ("samples", "denoise", "dynamic_range")}
"""Settings that no point names: they say what the photographs are, not what is made of them."""
OTHER_METHODS = ("published", "published_repaired")
"""Variants of the study that are no points of ours."""


def write_points() -> list[str]:
    """Write config/quality/p<nn>.yaml, points.json and the picture from the table of the study; return lines that say what they
    are.

    Raises:
        InputError: the table is not there or has no variant that was run in every room.
    """
    import pandas as pd
    import yaml

    if not TABLE.is_file():
        raise InputError(f"{TABLE}: not found; `python -m lab study {STUDY} --keep {TABLE}` writes it")
    frame = pd.read_csv(TABLE, dtype={"variant": str})
    study, folder = load_study(STUDY), REPOSITORY / "config/quality"
    every = pool(frame[frame["variant"].isin(study.variants)])
    pooled = [one for one in every if one.variant not in OTHER_METHODS]
    if not pooled:
        raise InputError(f"{TABLE}: no variant was run in every room")
    chosen = front(pooled)
    points: dict[str, Any] = {}
    texts: dict[str, str] = {}
    head = ["point", "photographs", "K", "other settings", "CPU s", *(f"{score}, dB" for score in SCORES), "run"]
    lines = [f"| {' | '.join(head)} |", "|---|---|---:|---|---:|" + "---:|" * len(SCORES) + "---|"]
    for number, one in enumerate(chosen, 1):
        name = f"p{number:02d}"
        settings = of_point(merged(study.common, study.variants[one.variant].overrides))
        text = f"# Point {number} of the measured front: run {one.variant} of the study {STUDY} (docs/guide/quality.md).\n"
        text += "".join(
            f"{section}: {yaml.safe_dump(keys, default_flow_style=True, width=1000)}" for section, keys in settings.items()
        )
        texts[f"{name}.yaml"] = text
        points[name] = {room: {key: float(f"{v:.5g}") for key, v in found.items()} for room, found in one.rooms.items()}
        means = [Point(name, one.rooms).expected(score) for score in SCORES]
        scores = [f"{mean.mean:.1f} ({mean.low:.1f} to {mean.high:.1f})" for mean in means]
        cells = [name, *_words(settings), f"{one.cpu_seconds:.0f}", *scores]
        lines.append(f"| {' | '.join(cells)} | {one.variant} |")
    for old in folder.glob("p[0-9][0-9].yaml"):
        old.unlink()
    for file, text in texts.items():
        write_atomically(folder / file, lambda path, text=text: path.write_text(text))
    gone = [f"{quality}: {point}" for quality, point in named().items() if point not in points]
    if gone:
        lines.append(f"config/quality: these name points that are gone, set them anew: {', '.join(gone)}")
    shipped = json.dumps({"study": STUDY, "points": points}, indent=1) + "\n"
    write_atomically(SHIPPED, lambda path: path.write_text(shipped))
    draw(pooled, chosen, list(points), [one for one in every if one.variant in OTHER_METHODS], PICTURE)
    return lines


def merged(common: Mapping[str, Mapping[str, Any]], own: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the settings of a variant with those that all variants share."""
    sections = list(dict.fromkeys([*common, *own]))
    return {section: {**common.get(section, {}), **own.get(section, {})} for section in sections}


def of_point(settings: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return what a point sets: not the defaults, and not what the photographs are."""
    out: dict[str, dict[str, Any]] = {}
    for section, keys in settings.items():
        fields = getattr(SceneSettings.model_fields[section].annotation, "model_fields", {})
        named = {*SIZES.get(section, ()), *(key for key in keys if key not in fields)}
        kept = {key: value for key, value in keys.items() if key in named or value != fields[key].get_default()}
        kept = {key: value for key, value in kept.items() if key not in OF_THE_PHOTOGRAPHS.get(section, ())}
        if kept:
            out[section] = kept
    return out


def _words(settings: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The size of a point, K, and its other settings, for a table."""
    capture = settings["capture"]
    size = f"{capture['views']} x {capture['width']}²"
    other = {section: keys for section, keys in settings.items() if section not in ("capture", "prior", "render", "metrics")}
    others = [f"`{section}.{key}: {value}`" for section, keys in other.items() for key, value in keys.items()]
    return [size, str(settings["prior"]["samples"]), ", ".join(others) or "defaults"]
