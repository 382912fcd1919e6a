"""The table of materials of the report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from iif_core.numerics import color
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
        low, middle = row[f"base_colour_{brightest}_low"], float(row[f"base_colour_{brightest}"])
        # The interval of the level is a factor, and the same for all channels; its lower end is never cut off.
        row["level"] = f"(× {float(low) / middle:.2f} to {middle / float(low):.2f})" if low and float(low) > 0 else ""
        for name in ("roughness", "metallic"):
            low, high = row[f"{name}_low"], row[f"{name}_high"]
            row[f"{name}_text"] = f"{float(row[name]):.2f}"
            row[f"{name}_interval"] = f"({float(low):.2f} to {float(high):.2f})" if low and high else ""
        row["model"] = fit_words(row["model"])
        rows.append(row)
    return sorted(rows, key=lambda row: -float(row["pixels"] or 0))
