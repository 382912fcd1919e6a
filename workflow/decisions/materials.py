"""Decisions about materials and their scale."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from workflow.decisions.record import FORCED, Decision, decision

METALLIC_PRIOR = 0.25
"""Median predicted metallic above which an object counts as predicted metal."""


def metallic(free: np.ndarray, prior_median: np.ndarray, setting: str = "auto") -> Decision:
    """Decide about metallic: objects (`free`, not dielectrics) that the photographs show to be metals, at least in parts;
    `setting` is `auto` or `off`."""
    count = int(np.count_nonzero(free))
    predicted = int(np.count_nonzero(np.asarray(free) & (np.asarray(prior_median) > METALLIC_PRIOR)))
    value = float(np.max(prior_median)) if len(prior_median) else 0.0
    paying = count - predicted
    reason = f"fitted for {count} of {len(free)} objects ({predicted} because predicted, {paying} because it pays)"
    if setting != "auto":
        return decision(
            "metallic", False, "largest median predicted metalness", value, METALLIC_PRIOR, f"set to {setting}", FORCED
        )
    return decision("metallic", count > 0, "largest median predicted metalness", value, METALLIC_PRIOR, reason)


def given_words(objects: int, given: np.ndarray | None) -> list[str]:
    """Name what was given by hand of each object, e.g. `roughness, metallic`, from values (O, 2), NaN = fitted."""
    known = np.zeros((objects, 2), bool) if given is None else ~np.isnan(given)
    return [", ".join(name for name, told in zip(("roughness", "metallic"), row, strict=True) if told) for row in known]


_BY_HAND = "given by hand, not fitted: "


def by_shown_names(item: Decision, shown: Mapping[str, str]) -> Decision:
    """Return a decision of `given_by_hand` with the names that people see (the segmentation's -> theirs); others as they are."""
    if item["component"] != "given_materials" or not str(item.get("reason", "")).startswith(_BY_HAND):
        return item
    told = [one.rpartition(" (") for one in item["reason"].removeprefix(_BY_HAND).split("; ")]
    return {**item, "reason": _BY_HAND + "; ".join(f"{shown.get(name, name)} ({what}" for name, _, what in told)}


def given_by_hand(names: list[str], given: np.ndarray) -> Decision:
    """Describe which materials were given by hand (`materials`) and thus not fitted."""
    words = given_words(len(names), given)
    told = [f"{name} ({what})" for name, what in zip(names, words, strict=True) if what]
    reason = f"{_BY_HAND}{'; '.join(told)}"
    return decision("given_materials", True, "objects with values given by hand", len(told), 0.0, reason, FORCED)


def affine_size(models: list[str]) -> Decision:
    """Describe the sizes of the albedo maps, which follow the texture of each object (Eq. M.19)."""
    kinds = [m.split(",")[0].split(" (")[0] for m in models]
    counts = {kind: kinds.count(kind) for kind in ("full", "gain+bias", "gain", "population", "identity")}
    value = counts["full"] / len(kinds) if kinds else 0.0
    reason = ", ".join(f"{number} {kind}" for kind, number in counts.items() if number) or "no objects"
    return decision("affine_size", counts["full"] > 0, "share of objects with the full 3x4 map", value, 0.0, reason)


def scale(kind: str, factor: float, relative_error: float) -> Decision:
    """Describe what fixes the scale between light and albedo (docs/method/fitting.md#level-of-all-albedos)."""
    reasons = {
        "found": "the light as it was found, by how much of it is indirect, weighed against the mean albedo of the base texture",
        "prior": "a convention: the mean albedo of the base texture; only ratios of albedos and of lights were measured",
        "mean_albedo": "the given mean albedo",
        "white_patch": "the given albedo of a patch",
        "lamp": "the given radiance of a lamp",
    }
    reason = f"{reasons[kind]}; the albedos were divided by {factor:.4g} (standard error {100 * relative_error:.2g} %)"
    return decision("scale", abs(factor - 1.0) > 1e-3, "factor by which the albedos were divided", factor, 1.0, reason)
