"""The table of emitters of the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from iif_core.numerics import color
from workflow.report.wording import percent, significant


def lamp_power(table: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return (n,) what each emitter of emitters.parquet sends out, summed over channels, up to one factor; 0 of those that are no
    kept area lamps."""
    radiance = sum(table[f"radiance_{c}"].astype(np.float64) for c in "rgb")
    is_lamp = table["kept"].astype(bool) & (table["kind"] == "area")
    return np.where(is_lamp, table["area_m2"] * np.where(table["side"] == 0, 2.0, 1.0), 0) * radiance


def emitter_rows(table: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Return the rows of emitters.parquet of stage export as texts; the most powerful lamp first. Light from outside is one row,
    the mean of its parts."""
    radiance, error = (np.stack([table[f"{of}_{c}"] for c in "rgb"], 1).astype(np.float64) for of in ("radiance", "error"))
    kept, area, power = table["kept"].astype(bool), table["kind"] == "area", lamp_power(table)
    outside = np.flatnonzero(kept & ~area)
    if len(outside):
        radiance[outside], error[outside] = radiance[outside].mean(0), error[outside].mean(0)
    probability, rows = table.get("probability", np.full(len(power), -1.0)), []
    for i in np.setdiff1d(np.argsort(-power, kind="stable"), outside[1:], assume_unique=True):
        parts = outside if i in outside else np.array([i])
        peak = radiance[i].max()
        swatch = color.to_uint8(color.srgb_from_linear(radiance[i] / peak if peak > 0 else radiance[i]))
        rows.append(
            {
                "id": int(table["emitter_id"][i]),
                "name": str(table["name"][i]) + (f", {len(parts)} parts" if len(parts) > 1 else ""),
                "object": str(table["object"][i]),
                "kind": str(table["kind"][i]),
                "faces": int(table["faces"][i]),
                "area": float(table["area_m2"][i]),
                "radiance": ", ".join(significant(v) for v in radiance[i]),
                "error": ", ".join(significant(v, 2) for v in error[i]),
                "swatch": "#{:02x}{:02x}{:02x}".format(*swatch),
                "probability": percent(probability[i], 0) if probability[i] >= 0 else "–",
                "share": percent(power[i] / power.sum(), 1) if area[i] and power.sum() > 0 else "–",
                "power": f"{power[i]:.6g}",
                "brightness": f"{radiance[i].sum():.6g}",
                "observations": int(table["observations"][parts].sum()),
                "kept": bool(kept[i]),
                "reason": str(table["reason"][i]),
            }
        )
    return rows


def emitter_note(is_hdr: bool, light_scale: float) -> str:
    """Say what the radiances are relative to. `light_scale`: factor on the light of stage emission that the fit found."""
    text = "Radiance in the units of the photographs' exposure."
    if not is_hdr:
        text += " With LDR photographs the factor between light and albedo is `affines.scale`."
    if light_scale != 1:
        text += f" The fit multiplied all light by {light_scale:.3g}, so that it goes with the level of the albedos."
    return text
