"""What a scene requires (docs/method/evaluation.md#what-a-scene-requires): each function decides one component of the model.

All return the same record for `plan.yaml`, `{component, included, measure, value, threshold, reason}`, in plain Python values.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.camera.gains import SIGNIFICANT, Evidence
from iif_core.light.emission.search import STEP
from iif_core.light.emission.sun import SHARP, Disc, is_needed
from iif_core.light.emission.translucent import TRANSMITTANCE

Decision = dict[str, Any]

ESCAPE_PRIMARY = 1e-3
"""Share of camera rays that leave the mesh, above which an environment is considered."""
ESCAPE_SECONDARY = 2e-3
"""The same for rays from the surface."""
ESCAPE_BRIGHTNESS = 0.02
"""Brightness of escaping camera rays, relative to the photographs, up to which the outside counts as black."""
ESCAPE_OPEN = 0.3
"""Share of escaping rays from which the mesh counts as a part of a room. Its holes then show the rest of the room, which is near
and looks different from everywhere, so the environment has twelve directions instead of a map of what the cameras see
(docs/method/light.md#open-meshes)."""
EXPOSURE_LOG_RATIO = 0.05
"""Median |log gain| between overlapping views, above which gains are estimated."""
RESPONSE_ERRORS = 2.0
"""Standard errors by which a larger family of responses must be better."""
METALLIC_PRIOR = 0.25
"""Median predicted metallic above which an object counts as predicted metal."""
SPECULAR_ROUGHNESS = 0.85
"""Roughness below which an object counts as glossy."""
STABLE_OBJECTS = 0.7
"""Adjusted Rand index below which the objects depend on the choice of photographs."""
CACHE_COVERAGE = 0.3
"""Share of secondary hits that must have been photographed for the radiance cache."""


def _decision(component: str, included: bool, measure: str, value: float, threshold: float, reason: str) -> Decision:
    finite = float(value) if np.isfinite(value) else 0.0
    return {
        "component": component,
        "included": bool(included),
        "measure": measure,
        "value": round(finite, 6),
        "threshold": float(threshold),
        "reason": reason,
    }


def environment(setting: str, primary_escape: float, secondary_escape: float, relative_brightness: float | None) -> Decision:
    """Decide about light from outside, needed if rays leave the mesh and do not meet black.

    See docs/method/light.md#when-an-environment-is-included.

    Args:
        setting: `on`, `off` or `auto`.
        primary_escape: share of camera rays without a hit.
        secondary_escape: share of cosine-distributed rays from the surface that leave.
        relative_brightness: mean radiance of escaping camera rays over that of the photographs; None = none escaped.

    Returns:
        The decision.
    """
    measure = "share of cosine-distributed rays from the surface that leave the mesh"
    if setting != "auto":
        return _decision("environment", setting == "on", measure, secondary_escape, ESCAPE_SECONDARY, f"set to {setting}")
    leaves = primary_escape > ESCAPE_PRIMARY or secondary_escape > ESCAPE_SECONDARY
    dark = relative_brightness is not None and relative_brightness <= ESCAPE_BRIGHTNESS
    if not leaves:
        reason = f"the mesh is closed: {primary_escape:.2%} of camera rays and {secondary_escape:.2%} of others escape"
    elif dark:
        reason = f"rays escape into {relative_brightness:.1%} of the mean brightness: no light comes in from outside"
    else:
        reason = f"{primary_escape:.2%} of camera rays and {secondary_escape:.2%} of others escape"
    return _decision("environment", leaves and not dark, measure, secondary_escape, ESCAPE_SECONDARY, reason)


_SUN = "share by which the misfit falls with a sun"


def sun(disc: Disc | None, without: float, with_it: float, narrow: float = 0.0) -> Decision:
    """Decide about a sun that no camera sees (docs/method/light.md#the-sun).

    Args:
        disc: that explains the photographs best; None = no single direction helps.
        without, with_it: misfit of the light (Eq. L.40) without a sun and with the disc; of held-out views, if the disc is sharp.
        narrow: share of what the best disc takes off the misfit that a narrow one does.
    """
    value = 1.0 - with_it / without if 0 < without < np.inf else 0.0
    included = disc is not None and is_needed(without, with_it) and narrow >= SHARP
    reason = f"misfit {without:.4f}, and {with_it:.4f} with the best sun"
    if disc is not None:
        towards, size = ", ".join(f"{x:.2f}" for x in disc.direction), np.degrees(disc.radius)
        reason += f", towards ({towards}), {f'a disc of radius {size:.1f} degrees' if size else 'one texel'}"
        sharp = f"a narrow one does {narrow:.0%} of what the best one does"
        if narrow < SHARP:
            reason += f"; {sharp}, so that it is a bright part of the sky"
        else:
            reason += f", on views that its radiance was not found on; {sharp}"
    return _decision("sun", included, _SUN, value, STEP, reason)


def no_place_for_a_sun() -> Decision:
    """Cameras see light from outside in all directions, unsaturated."""
    return _decision("sun", False, _SUN, 0.0, STEP, "cameras see the whole outside unsaturated")


def registration(accepted: bool, gain: float, error: float, moved: float, left_out: int, views: int) -> Decision:
    """Decide about corrected poses and intrinsics (`iif_core.camera.registration`).

    Args:
        accepted: whether the correction was accepted.
        gain, error: fall of the loss on held-out texture, and its standard error; where it is not significant, edges of the mesh
            decide.
        moved: median over the views of the shift, in pixels of the given photographs.
        left_out: number of photographs that are left out; views: number of photographs.

    Returns:
        The decision.
    """
    measure = "fall of the loss on texture that the fit did not see, in standard errors"
    value = gain / error if error > 0 else 0.0
    done = (
        f"photographs moved by {moved:.1f} of their own pixels (median)"
        if accepted
        else f"moving them by {moved:.1f} pixels would not pay"
    )
    by = "the texture" if gain > SIGNIFICANT * error else "the fit of edges of the mesh"
    reason = f"{done}{f', as {by} supports' if accepted else ''}; {left_out} of {views} left out as blurred or badly posed"
    return _decision("registration", accepted, measure, value, SIGNIFICANT, reason)


def segmentation(kind: str, objects: int, stability: float | None, perturbed: str, facts: dict[str, Any]) -> Decision:
    """Describe where the objects come from, and how much they depend on the choice of photographs and thresholds.

    Args:
        kind: of the segmentation; objects: number of objects that some photograph shows.
        stability: adjusted Rand index with the perturbed runs; None = nothing to perturb.
        perturbed: what these runs change, in words; facts: numbers of the clustering, if there was one.

    Returns:
        The decision.
    """
    component = f"objects ({kind})"
    if stability is None:
        return _decision(component, True, "ids taken as they are", 1.0, STABLE_OBJECTS, f"{objects} objects are seen")
    reason = f"{objects} objects are seen"
    if "masks" in facts:
        reason += f"; {facts['masks_undersegmented']} of {facts['masks']} masks hold several things and were dropped"
    if stability < STABLE_OBJECTS:
        reason += "; they depend on the choice of photographs: judge the overlay in the report"
    return _decision(component, True, f"adjusted Rand index with {perturbed}", stability, STABLE_OBJECTS, reason)


def emitters(groups: int, dropped: int, candidates: int) -> Decision:
    """Decide about emitters: groups of faces that were found and kept by the solver."""
    if groups:
        reason = f"{groups} groups emit light ({dropped} candidates dropped)"
    elif candidates:
        reason = f"none of the {candidates} candidate groups emits light; light comes from cache and environment"
    else:
        reason = "no face was seen saturated often enough; light comes from cache and environment"
    return _decision("emitters", groups > 0, "emitter groups", groups, 1, reason)


def transmission(names: str, shines: float, passes: float, possible: bool) -> Decision:
    """Decide whether objects that show what is behind them shine, or let light from outside through.

    That they show it speaks for the latter, unless it explains the other objects clearly worse
    (docs/method/light.md#surface-that-lets-light-through).

    Args:
        names: of the objects.
        shines, passes: misfit of the light (Eq. L.40) under either assumption, on the rows of other objects.
        possible: light comes from outside where the objects let it through, and the mesh stays closed otherwise.
    """
    measure = "share by which the misfit falls if light passes"
    value = 1.0 - passes / shines if 0 < shines < np.inf and np.isfinite(passes) else 0.0
    included = possible and passes < (1 + STEP) * shines
    what = f"{TRANSMITTANCE:.0%} of the light passes through {names}" if included else f"no light passes through {names}"
    reason = f"{what}: misfit {passes:.4f}, and {shines:.4f} if it shines"
    return _decision("transmission", included, measure, value, -STEP, reason)


def radiance_cache(setting: str, coverage: float, censored: float) -> Decision:
    """Decide between photographed radiance and further bounces for indirect light (Eq. S.14); `setting` is `cache`, `path` or
    `auto`.

    `coverage` is the share of cosine-distributed rays from the surface that meet a known voxel, among those that meet no emitter;
    `censored` the share of the voxels that were seen by saturated pixels only.
    """
    measure = "share of secondary hits whose radiance was photographed"
    if setting != "auto":
        return _decision("radiance_cache", setting == "cache", measure, coverage, CACHE_COVERAGE, f"set to {setting}")
    reason = f"{coverage:.0%} of secondary hits were photographed ({censored:.1%} of the voxels only saturated)"
    return _decision("radiance_cache", coverage > CACHE_COVERAGE, measure, coverage, CACHE_COVERAGE, reason)


def camera_response(dynamic_range: str, calibration: dict[str, Any]) -> Decision:
    """Describe the camera response that the calibration chose (its facts are in `emission.json`); linear radiance has none."""
    table = calibration["candidates"]
    measure = "log likelihood by which the simplest curve is behind the best, in standard errors"
    value = table[0]["behind"] / max(table[0]["error"], 1e-9) if table else 0.0
    return _decision("camera_response", dynamic_range != "hdr", measure, value, RESPONSE_ERRORS, calibration["reason"])


def exposure(setting: str, log_gains: np.ndarray, estimated: int) -> Decision:
    """Decide about exposure gains of the views: whether overlapping views disagree by more than 5 %."""
    spread = float(np.median(np.abs(log_gains))) if len(log_gains) else 0.0
    measure = "median |log gain| between overlapping views"
    if setting != "estimate":
        return _decision("exposure", False, measure, spread, EXPOSURE_LOG_RATIO, "exposures taken as given")
    if spread <= EXPOSURE_LOG_RATIO:
        return _decision("exposure", False, measure, spread, EXPOSURE_LOG_RATIO, "overlapping views agree")
    return _decision("exposure", True, measure, spread, EXPOSURE_LOG_RATIO, f"gains estimated for {estimated} views")


def camera_term(term: str, evidence: Evidence) -> Decision:
    """Decide about `white_balance` of the views or `vignetting` of the lens by the loss on held-out surface."""
    measure = "fall of the held-out loss by this term, in standard errors"
    value = evidence.gain / evidence.error if evidence.error > 0 else 0.0
    what = "median |log gain| of a channel" if term == "white_balance" else "largest |log falloff|"
    reason = (
        f"{what} {evidence.size:.3f}; spread on surface that the fit did not see {evidence.before:.4f} without,"
        f" {evidence.after:.4f} with it"
    )
    return _decision(term, evidence.included, measure, value, SIGNIFICANT, reason)


def metallic(free: np.ndarray, prior_median: np.ndarray) -> Decision:
    """Decide about metallic: objects (`free`, not dielectrics) that the photographs show to be metals, at least in parts."""
    count = int(np.count_nonzero(free))
    predicted = int(np.count_nonzero(np.asarray(free) & (np.asarray(prior_median) > METALLIC_PRIOR)))
    value = float(np.max(prior_median)) if len(prior_median) else 0.0
    paying = count - predicted
    reason = f"fitted for {count} of {len(free)} objects ({predicted} because predicted, {paying} because it pays)"
    return _decision("metallic", count > 0, "largest median predicted metalness", value, METALLIC_PRIOR, reason)


def gloss_is_idle(glossy: float, matte: float) -> bool:
    """Return whether the views of a cell differ as much with the fitted gloss as without (Eq. M.50); 0 = no cell can tell."""
    return 0 < glossy and matte <= glossy


def specular(low_roughness: np.ndarray, free_metallic: np.ndarray, scatter: tuple[float, float] | None = None) -> Decision:
    """Decide about the specular lobe: some object is smoother than 0.85 in 5 % of its pixels (`low_roughness`), or metallic.

    `scatter`: how much the views of a cell differ with the fitted gloss and without (Eq. M.50); None = not compared.
    """
    if scatter is not None and gloss_is_idle(*scatter):
        measure = "how much more the views of a cell differ without gloss than with it (root mean square)"
        reason = f"they differ by {scatter[0]:.4f} with the gloss that was fitted, by {scatter[1]:.4f} with none: fitted without"
        return _decision("specular", False, measure, scatter[1] - scatter[0], 0.0, reason)
    value = float(np.min(low_roughness)) if len(low_roughness) else 1.0
    needed = value < SPECULAR_ROUGHNESS or bool(np.any(free_metallic))
    reason = f"{int(np.count_nonzero(np.asarray(low_roughness) < SPECULAR_ROUGHNESS))} objects are glossy"
    return _decision("specular", needed, "lowest 5 % quantile of roughness of an object", value, SPECULAR_ROUGHNESS, reason)


def affine_size(models: list[str]) -> Decision:
    """Describe the sizes of the albedo maps, which follow the texture of each object (Eq. M.19)."""
    kinds = [m.split(",")[0].split(" (")[0] for m in models]
    counts = {kind: kinds.count(kind) for kind in ("full", "gain+bias", "gain", "population", "identity")}
    value = counts["full"] / len(kinds) if kinds else 0.0
    reason = ", ".join(f"{number} {kind}" for kind, number in counts.items() if number) or "no objects"
    return _decision("affine_size", counts["full"] > 0, "share of objects with the full 3x4 map", value, 0.0, reason)


def scale(kind: str, factor: float, relative_error: float) -> Decision:
    """Describe what fixes the scale between light and albedo (docs/method/fitting.md#level-of-all-albedos)."""
    reasons = {
        "found": "the light as it was found, by how much of it is indirect, weighed against the mean albedo of the base texture",
        "prior": "a convention: the mean albedo of the base texture; only ratios of albedos and of lights were measured",
        "mean_albedo": "the given mean albedo",
        "white_patch": "the given albedo of a patch",
        "lamp": "the given radiance of a lamp",
    }
    reason = f"{reasons[kind]}; the light was multiplied by {factor:.4g} (standard error {100 * relative_error:.2g} %)"
    return _decision("scale", abs(factor - 1.0) > 1e-3, "factor on the light that the fit was given", factor, 1.0, reason)
