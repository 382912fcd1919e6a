"""What a scene requires, as far as photographs, cameras and mesh tell it before any other stage (docs/method/plan.md)."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from iif_core.requirements.evidence import Evidence
from workflow.decisions.record import FORCED, PROVISIONAL, SETTLED, Decision, by_evidence, decision, not_probed

ESCAPE_PRIMARY = 1e-3
"""Share of camera rays that leave the mesh, up to which it is closed."""
ESCAPE_SECONDARY = 2e-3
"""The same for rays from the surface."""
CRACKS = 2.0
"""Standard errors by which photographs must gain from light that comes through a closed mesh: its cracks fit any colour that
lamps lack."""
ESCAPE_BRIGHTNESS = 0.02
"""Brightness of escaping camera rays, relative to the photographs, up to which the outside counts as black."""
ESCAPE_LIGHT = 0.01
"""The same, times the share of rays from surface that leave, if the outside is no brighter than the photographs: what light from
outside has to bring. A brighter one may be saturated, and its brightness a bound."""
ESCAPE_OPEN = 0.3
"""Share of escaping rays from which the mesh counts as a part of a room. Its holes then show the rest of the room, which is near
and looks different from everywhere, so the environment has twelve directions instead of a map of what the cameras see
(docs/method/light.md#open-meshes)."""
CACHE_COVERAGE = 0.3
"""Share of secondary hits that must have been photographed for the radiance cache."""
LATER = {
    "camera_response": ("affines", "the photographs are 8-bit; the family follows from surface that several exposures show"),
    "exposure": ("emission", "decided by surface that several photographs show"),
    "white_balance": ("emission", "decided by surface that several photographs show"),
    "vignetting": ("emission", "decided by surface that several photographs show"),
    "metallic": ("affines", "decided for each object by the evidence of the fit"),
    "denoiser": ("render", "views are re-rendered by few paths, which are noisy"),
    "affine_size": ("affines", "follows the texture of each object"),
}
"""Component -> stage that settles it, and how."""
GAINS = ("exposure", "white_balance", "vignetting")


def _weighed(component: str, setting: str, evidence: Evidence, words: tuple[str, str, str], later: str) -> Decision:
    """Return in, out or provisional by the evidence; `words` are the reasons for in, out and neither."""
    if setting != "auto":
        return by_evidence(component, setting == "on", evidence, f"forced {setting}", FORCED)
    if evidence.pays:
        return by_evidence(component, True, evidence, words[0], SETTLED)
    if evidence.speaks_against:
        return by_evidence(component, False, evidence, words[1], SETTLED)
    return by_evidence(component, True, evidence, f"{words[2]}; stage {later} decides", PROVISIONAL)


def environment(
    setting: str, escape_primary: float, escape_secondary: float, brightness: float | None, evidence: Evidence | None = None
) -> Decision:
    """Decide about light from outside, needed if rays leave the mesh and do not meet black, or next to no light through cracks.

    See docs/method/light.md#when-an-environment-is-included.

    Args:
        setting: `on`, `off` or `auto`.
        escape_primary, escape_secondary: share of camera rays and of cosine-distributed rays from surface that leave the mesh.
        brightness: mean radiance of camera rays that leave it, relative to the photographs; None = none leaves.
        evidence: that photographs give for the radiance of rays that leave, as stage plan probes it. None = it did not tell, or
            the mesh is another one now: then the shares decide, by their thresholds.
    """
    leaves = f"{escape_primary:.2%} of camera rays and {escape_secondary:.2%} of others leave the mesh"
    if escape_secondary > ESCAPE_OPEN:
        leaves += ", which is open: scan the walls, floor and ceiling that it lacks, if you can"
    dark = brightness is not None and (
        brightness <= ESCAPE_BRIGHTNESS or (brightness <= 1.0 and escape_secondary * brightness < ESCAPE_LIGHT)
    )
    # Seen, not inferred: a small lamp that the probe's rays miss may look like light from outside.
    is_closed = not (escape_primary > ESCAPE_PRIMARY or escape_secondary > ESCAPE_SECONDARY)
    into = f"{leaves}, into {brightness:.1%} of the mean brightness" if dark else ""
    if evidence is None:
        if setting != "auto":
            included, reason, status = setting == "on", f"forced {setting}", FORCED
        elif is_closed:
            included, reason, status = False, f"the mesh is closed: {leaves}", SETTLED
        else:
            included, reason, status = not dark, into or leaves, SETTLED
        measure = "share of cosine-distributed rays from the surface that leave the mesh"
        return decision("environment", included, measure, escape_secondary, ESCAPE_SECONDARY, reason, status)
    if setting == "auto" and not (escape_primary or escape_secondary):
        return not_probed("environment", False, f"the mesh is closed: {leaves}", SETTLED)
    if setting == "auto" and is_closed and evidence.gain < CRACKS * evidence.error:
        return by_evidence("environment", False, evidence, f"the mesh is closed: {leaves}", SETTLED)
    if setting == "auto" and dark:
        return by_evidence("environment", False, evidence, into, SETTLED)
    words = (f"{leaves}, and bring light", f"{leaves}, and bring no light", f"{leaves}; the photographs do not tell yet")
    return _weighed("environment", setting, evidence, words, "emission")


def emitters(is_hdr: bool, evidence: Evidence) -> Decision:
    """Describe whether saturated surface brings light; which groups of faces do is found by stage emission."""
    if is_hdr:
        return not_probed("emitters", True, "lamps are not saturated; stage emission finds them", PROVISIONAL)
    reason = "saturated surface explains how bright the rest is" if evidence.pays else "saturated surface explains little"
    return by_evidence("emitters", True, evidence, f"{reason}; stage emission finds the lamps", PROVISIONAL)


def specular(setting: str, evidence: Evidence) -> Decision:
    """Decide about specular lobes.

    Args:
        setting: `on`, `off` or `auto`.
        evidence: for lobes in how surface changes its radiance from photograph to photograph.
    """
    words = (
        "surface changes with the viewer as what it mirrors does",
        "surface looks the same from everywhere, and lobes make it worse",
        "the photographs alone do not tell",
    )
    return _weighed("specular", setting, evidence, words, "shading")


def radiance_cache(photographed: float) -> Decision:
    """Foresee whether indirect light is read from photographs, by how much of the surface that it comes from they show."""
    reason = f"{photographed:.0%} of the surface that rays from surface meet was photographed (stage shading)"
    measure = "share of secondary hits whose radiance was photographed"
    included = photographed > CACHE_COVERAGE
    return decision("radiance_cache", included, measure, photographed, CACHE_COVERAGE, reason, PROVISIONAL)


def later(is_hdr: bool, exposure_estimated: bool, known: Collection[str] = ()) -> list[Decision]:
    """Return the components that need predictions or light, and who settles them. Linear photographs have no response, and
    nothing is estimated of exposures that are given. Components that are `known` already are left out."""
    out = []
    for component, (stage, reason) in LATER.items():
        if component in known:
            continue
        if component == "camera_response" and is_hdr:
            out.append(not_probed(component, False, "the photographs are linear radiance", SETTLED))
        elif component in GAINS and not exposure_estimated:
            out.append(not_probed(component, False, "exposures are taken as given", SETTLED))
        else:
            out.append(not_probed(component, True, f"{reason} (stage {stage})", PROVISIONAL))
    return out


def matte_by_predictions(provisional: Decision, lowest_roughness: float, metal: bool, threshold: float) -> Decision:
    """Settle a provisional decision about specular lobes by the fused predictions.

    Args:
        provisional: of stage plan.
        lowest_roughness: of all objects the lowest 5 % quantile of roughness; metal: whether an object is predicted to be metal.
        threshold: roughness below which surface is glossy.
    """
    if provisional["status"] != PROVISIONAL:
        return provisional
    found = f"the predictions go down to a roughness of {lowest_roughness:.2f}{' and have metal' if metal else ''}"
    reason = f"{found}; the photographs alone do not tell"
    measure = "lowest 5 % quantile of the predicted roughness of an object"
    settled = decision("specular", lowest_roughness < threshold or metal, measure, lowest_roughness, threshold, reason)
    return {**provisional, **settled}


OVERRIDDEN = ("environment", "specular", "metallic", "radiance_cache", "denoiser")
"""Components that the settings can force (`components: {...}`)."""


def with_override(item: Decision) -> Decision:
    """Return a decision with the words that turn it over in the scene file, where there are any."""
    if item["component"] not in OVERRIDDEN or (item["component"] == "metallic" and not item["included"]):
        return item
    return {**item, "override": f"components: {{{item['component']}: {'off' if item['included'] else 'on'}}}"}


def included(plan: list[dict[str, Any]], component: str) -> Decision:
    """Return the decision about a component.

    Raises:
        KeyError: the plan has none.
    """
    for item in plan:
        if item["component"] == component:
            return item
    raise KeyError(component)
