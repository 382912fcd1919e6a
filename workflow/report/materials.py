"""The table of materials of the report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from iif_core.numerics import color
from workflow.decisions import held
from workflow.report.wording import fit_words


def material_rows(objects: Iterable[Mapping[str, str]]) -> list[dict[str, str]]:
    """Return the rows of objects.csv of stage export with the texts of the table; the surface that most pixels show first."""
    rows = []
    for found in objects:
        row = dict(found)
        colour = [float(row[f"base_colour_{c}"]) for c in "rgb"]
        row["linear"] = ", ".join(f"{v:.3f}" for v in colour)
        row["luminance"] = f"{color.luminance(np.array(colour)):.5f}"
        brightest = max("rgb", key=lambda c: float(row[f"base_colour_{c}"]))
        low, high = (float(row[f"base_colour_{brightest}{end}"]) for end in ("_low", "_high"))
        row["level"] = f"({low:.2f} to {high:.2f})"
        for name in ("roughness", "metallic"):
            low, high = (float(row[f"{name}{end}"]) for end in ("_low", "_high"))
            row[f"{name}_text"] = f"{float(row[name]):.2f}"
            row[f"{name}_interval"] = f"({low:.2f} to {high:.2f})"
        row["model"] = fit_words(row["model"])
        rows.append(row)
    return sorted(rows, key=lambda row: -float(row["pixels"] or 0))


def intervals_note() -> str:
    """Say what the intervals of the table are, and how often such intervals held."""
    shares, metals = [f"{name} of {held.words(name)}" for name in ("albedo", "roughness", "metallic")], held.measured()["metals"]
    return (
        "In brackets the 95 % interval, for albedo of its brightest channel; 0 to 1 means that photographs do not tell it."
        f" In {held.rooms()} rendered rooms with the errors of real captures such intervals held the {', '.join(shares[:2])}"
        f" and {shares[2]}"
        " of the objects that have one. Few objects are metal, and metal is easily missed: of"
        f" {metals['true']} metals the interval held {metals['held']}."
    )
