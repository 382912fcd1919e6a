"""Decisions about objects."""

from __future__ import annotations

from typing import Any

from workflow.decisions.record import Decision, decision

STABLE_OBJECTS = 0.7
"""Adjusted Rand index below which the objects depend on the choice of photographs."""


def segmentation(kind: str, objects: int, stability: float | None, perturbed: str, facts: dict[str, Any]) -> Decision:
    """Describe where the objects come from, and how much they depend on the choice of photographs and thresholds.

    Args:
        kind: of the segmentation; objects: number of objects that some photograph shows.
        stability: adjusted Rand index with the perturbed runs; None = nothing to perturb.
        perturbed: what these runs change, as text; facts: numbers of the clustering, if there was one.

    Returns:
        The decision.
    """
    component = f"objects ({kind})"
    if stability is None:
        return decision(component, True, "ids taken as they are", 1.0, STABLE_OBJECTS, f"{objects} objects are seen")
    reason = f"{objects} objects are seen"
    if "masks" in facts:
        reason += f"; {facts['masks_undersegmented']} of {facts['masks']} masks hold several things and were dropped"
    if stability < STABLE_OBJECTS:
        reason += "; they depend on the choice of photographs: judge the overlay in the report"
    return decision(component, True, f"adjusted Rand index with {perturbed}", stability, STABLE_OBJECTS, reason)
