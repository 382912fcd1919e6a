"""objects.csv: one line for each object, for people and spreadsheets: mean materials, 95 % intervals, what was seen of it."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import fields

import numpy as np

from iif_core.fitting.intervals import AlbedoIntervals, MeasuredErrors, MetallicIntervals, RoughnessIntervals
from iif_core.fitting.problem import Kinds
from iif_core.numerics import color
from workflow.artifacts.store import StageReader
from workflow.decisions.held import FILE, measured
from workflow.scene.recovered import Recovered

Array = np.ndarray


def object_rows(
    names: Sequence[str],
    cell_object: Array,
    cell_values: Array,
    object_values: Array,
    fit: Mapping[str, Array],
    room_error: float,
    seen: Mapping[str, Array],
) -> dict[str, list]:
    """Return the columns of objects.csv, one entry per object; None where a number is not known.

    Intervals are those of `iif_core.fitting.intervals`; 0 to 1 where nothing is known. What was given by hand is taken as exact.

    Args:
        names: one per object id.
        cell_object: (c,) object of each surface cell; cell_values: (c, 5) fitted albedo R G B (linear), roughness, metallic.
        object_values: (objects, 5) the same for objects without cells.
        fit: columns of affines/objects.parquet; room_error: error of the logarithm of the level of the room.
        seen: columns of segmentation/objects.parquet.
    """
    n = len(names)
    count = np.bincount(cell_object, minlength=n)[:n]
    mean = np.stack([np.bincount(cell_object, cell_values[:, i].astype(np.float64), n)[:n] for i in range(5)], 1)
    mean = np.where(count[:, None] > 0, mean / np.maximum(count, 1)[:, None], object_values[:n])
    mean = np.clip(mean, 0, 1)
    errors, kinds = MeasuredErrors.from_facts(measured()["errors"], str(FILE)), kinds_of(fit, n)
    level, pixels = _by_id(fit, "std_level", n), _by_id(fit, "pixels", n)
    low, high = AlbedoIntervals.of(mean[:, :3], level, pixels, room_error, kinds, errors).ends(errors.albedo)
    of_others = {
        "roughness": RoughnessIntervals.of(mean[:, 3], kinds, errors).ends(errors.roughness),
        "metallic": MetallicIntervals.of(mean[:, 4], kinds).ends(errors.metallic),
    }
    given = dict(zip(np.asarray(fit["object_id"]).tolist(), fit["given"], strict=True)) if "given" in fit else {}
    columns: dict[str, list] = {
        "object_id": list(range(n)),
        "name": list(names),
        "base_colour_hex": [hex_colour(rgb) for rgb in mean[:, :3]],
        **{f"base_colour_{c}": _numbers(mean[:, i]) for i, c in enumerate("rgb")},
        **{f"base_colour_{c}_low": _numbers(low[:, i]) for i, c in enumerate("rgb")},
        **{f"base_colour_{c}_high": _numbers(high[:, i]) for i, c in enumerate("rgb")},
    }
    for channel, (name, (low, high)) in enumerate(of_others.items(), 3):
        exact = np.array([name in str(given.get(i, "")) for i in range(n)], bool)
        columns[name] = _numbers(mean[:, channel])
        columns[f"{name}_low"] = _numbers(np.where(exact, mean[:, channel], low))
        columns[f"{name}_high"] = _numbers(np.where(exact, mean[:, channel], high))
    columns["pixels"] = _counts(_by_id(seen if "pixels" in seen else fit, "pixels", n))
    columns["photographs"] = _counts(_by_id(seen, "views", n))
    columns["area_m2"] = _numbers(_by_id(seen, "area_m2", n))
    model = dict(zip(np.asarray(fit["object_id"]).tolist(), fit["model"], strict=True)) if "model" in fit else {}
    columns["model"] = [str(model.get(i, "")) for i in range(n)]
    return columns


def recovered_objects(recovered: Recovered, fitted: StageReader, seen: Mapping[str, Array]) -> dict[str, list]:
    """Return the columns of objects.csv of a recovered scene, from stage affines (`fitted`) and objects.parquet of stage
    segmentation (`seen`)."""
    surface, fit = recovered.surface, fitted.table("objects.parquet")
    scale = fitted.json("affines.json").get("scale") or {}
    room_error = float(scale.get("relative_error", np.nan))
    return object_rows(
        recovered.object_names, surface.cell_object, surface.cell_values, surface.object_values, fit, room_error, seen
    )


def kinds_of(fit: Mapping[str, Array], n: int) -> Kinds:
    """Return what the fit left open of n objects, from the columns of affines/objects.parquet; 0 where it does not say."""
    return Kinds(**{f.name: np.nan_to_num(_by_id(fit, f"kind_{f.name}", n, 0 if f.name == "seen" else 3)) for f in fields(Kinds)})


def hex_colour(linear: Array) -> str:
    """Return linear RGB (3,) as `#rrggbb`, sRGB-encoded."""
    return "#{:02x}{:02x}{:02x}".format(*color.to_uint8(color.srgb_from_linear(np.clip(linear, 0, 1))))


def csv_bytes(columns: Mapping[str, Sequence]) -> bytes:
    """Return columns as CSV (RFC 4180, UTF-8, a head line); None becomes an empty cell.

    Text that a spreadsheet would take for a formula gets an apostrophe in front.
    """
    buffer = io.StringIO(newline="")
    writer = csv.writer(buffer)
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow(["" if v is None else _harmless(v) if isinstance(v, str) else v for v in row])
    return buffer.getvalue().encode()


def read_csv(data: bytes) -> list[dict[str, str]]:
    """Return the lines of `csv_bytes` as dictionaries of text."""
    return list(csv.DictReader(io.StringIO(data.decode(), newline="")))


def _harmless(text: str) -> str:
    return f"'{text}" if text[:1] in ("=", "+", "-", "@", "\t", "\r") else text


def _by_id(table: Mapping[str, Array], column: str, n: int, width: int = 0) -> Array:
    """Return a column (n,) or (n, width) float64 in the order of the object ids; NaN where the table says nothing."""
    out = np.full((n, width) if width else n, np.nan)
    if column in table:
        ids = np.asarray(table["object_id"])
        known = (ids >= 0) & (ids < n)
        out[ids[known]] = np.asarray(table[column], np.float64)[known]
    return out


def _numbers(values: Array) -> list[float | None]:
    return [float(f"{v:.5g}") if np.isfinite(v) else None for v in values]


def _counts(values: Array) -> list[int | None]:
    return [int(v) if np.isfinite(v) else None for v in values]
