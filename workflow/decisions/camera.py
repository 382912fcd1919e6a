"""Decisions about poses, response and gains of the camera."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.camera.gains import SIGNIFICANT, Evidence
from workflow.decisions.record import FORCED, Decision, decision, not_probed

EXPOSURE_LOG_RATIO = 0.05
"""Median |log gain| between overlapping views, above which gains are estimated."""
MOTION = "median motion between neighbouring photographs, share of the picture's width"
RESPONSE_ERRORS = 2.0
"""Standard errors by which a larger family of responses must be better."""


def registration(accepted: bool, each: bool, evidence: float, needed: float, moved: float, left_out: int, views: int) -> Decision:
    """Decide about corrected poses and intrinsics (`iif_core.camera.registration`).

    Args:
        accepted: whether a correction was accepted.
        each: whether photographs were moved each for itself, and not all alike.
        evidence: standard errors by which texture and edges of the mesh fit better together, on surface that the fit did not see:
            with photographs moved each for itself instead of all alike, or all alike instead of none.
        needed: what it has to exceed.
        moved: median over the views of the shift, in pixels of the given photographs.
        left_out: number of photographs that are left out; views: number of photographs.

    Returns:
        The decision.
    """
    measure = "how much better texture and mesh edges fit on surface that the fit did not see, in standard errors"
    if accepted:
        done = f"photographs moved by {moved:.1f} of their own pixels (median), {'each for itself' if each else 'all alike'}"
    else:
        done = f"moving them by {moved:.1f} pixels would not pay"
    reason = f"{done}; {left_out} of {views} left out as blurred or badly posed"
    return decision("registration", accepted, measure, evidence, needed, reason)


def held_out(step: float, every: int, blocks: int, nearest: str) -> Decision:
    """Decide whether whole stretches of a video are held out.

    Args:
        step: median motion between neighbouring photographs, as a share of the width of the picture.
        every: one of so many photographs is held out; blocks: stretches, 0 = single photographs.
        nearest: how far held-out photographs are from the nearest used one.
    """
    how = f"a video: {blocks} stretch(es) are held out whole" if blocks else f"no video: one photograph of {every} is held out"
    reason = f"{how}; held-out photographs are {nearest}"
    return decision("held_out_stretches", blocks > 0, MOTION, step, 1 / every, reason)


def held_out_by_lists(nearest: str) -> Decision:
    """Describe photographs that lists of the source hold out."""
    return not_probed("held_out_stretches", False, f"lists of the source hold out; those photographs are {nearest}", FORCED)


def camera_response(dynamic_range: str, calibration: dict[str, Any]) -> Decision:
    """Describe the camera response that the calibration chose (its facts are in `emission.json`); linear radiance has none."""
    table = calibration["candidates"]
    measure = "log likelihood by which the simplest curve is behind the best, in standard errors"
    value = table[0]["behind"] / max(table[0]["error"], 1e-9) if table else 0.0
    return decision("camera_response", dynamic_range != "hdr", measure, value, RESPONSE_ERRORS, calibration["reason"])


def exposure(setting: str, log_gains: np.ndarray, estimated: int) -> Decision:
    """Decide about exposure gains of the views: whether overlapping views disagree by more than 5 %."""
    spread = float(np.median(np.abs(log_gains))) if len(log_gains) else 0.0
    measure = "median |log gain| between overlapping views"
    if setting != "estimate":
        return decision("exposure", False, measure, spread, EXPOSURE_LOG_RATIO, "exposures taken as given")
    if spread <= EXPOSURE_LOG_RATIO:
        return decision("exposure", False, measure, spread, EXPOSURE_LOG_RATIO, "overlapping views agree")
    return decision("exposure", True, measure, spread, EXPOSURE_LOG_RATIO, f"gains estimated for {estimated} views")


def camera_term(term: str, evidence: Evidence) -> Decision:
    """Decide about `white_balance` of the views or `vignetting` of the lens by the loss on held-out surface."""
    measure = "fall of the held-out loss by this term, in standard errors"
    value = evidence.gain / evidence.error if evidence.error > 0 else 0.0
    what = "median |log gain| of a channel" if term == "white_balance" else "largest |log falloff|"
    reason = (
        f"{what} {evidence.size:.3f}; spread on surface that the fit did not see {evidence.before:.4f} without,"
        f" {evidence.after:.4f} with it"
    )
    return decision(term, evidence.included, measure, value, SIGNIFICANT, reason)
