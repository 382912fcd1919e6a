"""objects.csv: one line for each object, for people and spreadsheets: mean materials, 95 % intervals, what was seen of it."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence

import numpy as np

from iif_core.numerics import color
from iif_core.reflectance.material import CHANNELS
from workflow.scene.recovered import Recovered

Array = np.ndarray

NORMAL_95 = 1.959964
"""Half a 95 % interval of the normal distribution, in standard deviations."""


def object_rows(
    names: Sequence[str],
    cell_object: Array,
    cell_values: Array,
    object_values: Array,
    base_values: Array,
    fit: Mapping[str, Array],
    seen: Mapping[str, Array],
) -> dict[str, list]:
    """Return the columns of objects.csv, one entry per object; None where a number is not known.

    Intervals hold the errors of the fitted numbers. For albedo it is the error of its level, a factor exp(+-1.96 sigma). For
    roughness and metallic they are the errors of factor and offset of `T x + t`, taken as independent, sigma^2 = (x sigma_T)^2 +
    sigma_t^2. Numbers that were not fitted have no error, and no interval is claimed for them.

    Args:
        names: one per object id.
        cell_object: (c,) object of each surface cell; cell_values: (c, 5) fitted albedo R G B (linear), roughness, metallic.
        object_values: (objects, 5) the same for objects without cells; base_values: (objects, 5) before the fit.
        fit: columns of affines/objects.parquet; seen: columns of segmentation/objects.parquet.
    """
    n = len(names)
    count = np.bincount(cell_object, minlength=n)[:n]
    mean = np.stack([np.bincount(cell_object, cell_values[:, i].astype(np.float64), n)[:n] for i in range(5)], 1)
    mean = np.where(count[:, None] > 0, mean / np.maximum(count, 1)[:, None], object_values[:n])
    mean = np.clip(mean, 0, 1)
    level = _fitted(_by_id(fit, "std_level", n))
    low, high = mean[:, :3] * np.exp(-NORMAL_95 * level)[:, None], mean[:, :3] * np.exp(NORMAL_95 * level)[:, None]
    columns: dict[str, list] = {
        "object_id": list(range(n)),
        "name": list(names),
        "base_colour_hex": [hex_colour(rgb) for rgb in mean[:, :3]],
        **{f"base_colour_{c}": _numbers(mean[:, i]) for i, c in enumerate("rgb")},
        **{f"base_colour_{c}_low": _numbers(low[:, i]) for i, c in enumerate("rgb")},
        **{f"base_colour_{c}_high": _numbers(np.minimum(high[:, i], 1)) for i, c in enumerate("rgb")},
    }
    for channel, name in ((3, "roughness"), (4, "metallic")):
        std = _by_id(fit, f"std_{name}", n, 2)
        sigma = _fitted(np.hypot(base_values[:n, channel] * std[:, 0], std[:, 1]))
        columns[name] = _numbers(mean[:, channel])
        columns[f"{name}_low"] = _numbers(np.maximum(mean[:, channel] - NORMAL_95 * sigma, 0))
        columns[f"{name}_high"] = _numbers(np.minimum(mean[:, channel] + NORMAL_95 * sigma, 1))
    columns["pixels"] = _counts(_by_id(seen if "pixels" in seen else fit, "pixels", n))
    columns["photographs"] = _counts(_by_id(seen, "views", n))
    columns["area_m2"] = _numbers(_by_id(seen, "area_m2", n))
    model = dict(zip(np.asarray(fit["object_id"]).tolist(), fit["model"], strict=True)) if "model" in fit else {}
    columns["model"] = [str(model.get(i, "")) for i in range(n)]
    return columns


def recovered_objects(
    recovered: Recovered, base: Mapping[str, Array], fit: Mapping[str, Array], seen: Mapping[str, Array]
) -> dict[str, list]:
    """Return the columns of objects.csv of a recovered scene, from objects.parquet of the base texture (`base`), of stage affines
    (`fit`) and of stage segmentation (`seen`)."""
    surface = recovered.surface
    before = surface.object_values.astype(np.float64).copy()
    before[base["object_id"]] = np.stack([base[name] for name in CHANNELS], 1)
    return object_rows(recovered.object_names, surface.cell_object, surface.cell_values, surface.object_values, before, fit, seen)


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


def _fitted(error: Array) -> Array:
    """Return errors with NaN in the place of 0, which says that a number was not fitted."""
    return np.where(error > 0, error, np.nan)


def _numbers(values: Array) -> list[float | None]:
    return [float(f"{v:.5g}") if np.isfinite(v) else None for v in values]


def _counts(values: Array) -> list[int | None]:
    return [int(v) if np.isfinite(v) else None for v in values]
