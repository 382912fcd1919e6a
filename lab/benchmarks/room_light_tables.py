"""The rows that room_light.py keeps, as tables of lab/notebook/exports.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

ROWS = Path("lab/notebook/data/room_light.json")


def _ms(value: float | None) -> str:
    return "" if value is None else f"{value:.0f}"


def tables(rows: list[dict[str, Any]]) -> dict[str, str]:
    """The tables of the page."""
    from workflow.report.blocks import markdown

    pages = [
        [row["scene"], f"{row['mb']:.1f}", f"{row['opened_s']:.1f}", _ms(row.get("slide_ms")), _ms(row["full_ms"])]
        for row in rows
    ]
    lamps, texels = [], []
    for row in rows:
        for lamp in row["lamps"]:
            ratios = (f"{lamp[name]:.3f}" for name in ("pixels", "maps", "maps_of_all"))
            lamps.append([row["scene"], lamp["lamp"], *ratios, f"{100 * lamp['clipped']:.1f} %", f"{100 * lamp['median']:.1f} %"])
            errors = (f"{lamp['texels'][name]:.3f}" for name in ("ratio", "rms", "rare"))
            texels.append([row["scene"], lamp["lamp"], *errors])
    heads = {
        "room": ["scene", "room.html, MB", "opens, s", "slider, ms", "all pixels, ms"],
        "room_lamps": ["scene", "lamp", "pixels", "maps", "maps, clipped too", "clipped", "median difference"],
        "room_texels": ["scene", "lamp", "ratio of the means", "relative RMS error", "99.9th percentile"],
    }
    return {
        "room": "\n".join(markdown(heads["room"], pages, 1)),
        "room_lamps": "\n".join(markdown(heads["room_lamps"], lamps, 2)),
        "room_texels": "\n".join(markdown(heads["room_texels"], texels, 2)),
    }
