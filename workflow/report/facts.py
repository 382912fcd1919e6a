"""The table of facts of the report: what went in, and how the fit ended."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from workflow.report.reported import Reported
from workflow.report.wording import number
from workflow.settings.prior import members


def facts_of(scene: Reported, quality: str) -> list[tuple[str, str]]:
    """Return (name, text) of every fact."""
    capture, surface = scene.capture, scene.recovered.surface
    exposures = capture.exposures()
    stops = np.log2(exposures.max() / exposures.min()) if exposures.min() > 0 else 0.0
    held_out = sum(view.split == "test" for view in capture.views)
    extent = np.ptp(surface.vertices, axis=0)
    kinds = [f"{one['kind']}, {one['samples']} predictions a photograph" for one in (members(scene.prior) if scene.prior else [])]
    first, sizes = capture.views[0], {(view.width, view.height) for view in capture.views}
    size = f"{first.width} x {first.height}" if len(sizes) == 1 else f"{len(sizes)} sizes, first {first.width} x {first.height}"
    cells = f"{number(len(surface.cell_ijk))} of {1000 * surface.cell_edge:.1f} mm"
    return [
        ("quality", quality),
        ("source", str(capture.facts.get("source", ""))),
        ("photographs", f"{len(capture.views)} of {size} pixels, {capture.facts['dynamic_range'].upper()}"),
        *([("held out", f"{held_out} photograph{'s were' if held_out > 1 else ' was'} not used")] if held_out else []),
        ("exposures", f"{stops:.1f} stops apart" if stops > 0.01 else "all equal"),
        ("mesh", f"{number(len(surface.faces))} faces, {' x '.join(f'{side:.2f}' for side in extent)} m"),
        ("objects", objects_words(scene.document("segmentation"), len(scene.recovered.object_names))),
        ("material fit", end_words(scene.document("affines"))),
        ("surface cells", f"{cells}, {100 * scene.document('base')['seen_once_share']:.0f} % in one photograph only"),
        ("prior", ", ".join(kinds) or "unknown"),
    ]


def end_words(facts: Mapping[str, Any]) -> str:
    """Describe how the fit ended, from affines.json."""
    history = facts["history"]
    if facts["converged"]:
        return f"converged in {len(history) - 1} steps"
    last = (history[-2] - history[-1]) / max(abs(history[-1]), 1e-12) if len(history) > 1 else 0.0
    return f"stopped after {len(history) - 1} steps, the last of which lowered the objective by {100 * last:.2g} %"


def objects_words(facts: Mapping[str, Any], count: int) -> str:
    """Describe number, source and stability of the objects, from segmentation.json (docs/guide/segmentation.md)."""
    if not facts:
        return str(count)
    text = f"{count} ({facts['kind']}), {facts['objects_seen']} of them seen"
    if facts["stability"] is None:
        return text
    return f"{text}; stability {facts['stability']:.2f} (adjusted Rand index with {facts['perturbed']}; 1 = unmoved)"
