"""The record of a decision, as `plan.yaml` shows it."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from iif_core.requirements.evidence import Evidence

Decision = dict[str, Any]

SETTLED, PROVISIONAL, FORCED = "settled", "provisional", "forced"
"""Status of a decision: nothing changes it any more; a later stage settles it; the settings decide."""


def decision(
    component: str,
    included: bool,
    measure: str,
    value: float,
    threshold: float,
    reason: str,
    status: str = SETTLED,
) -> Decision:
    """Return `{component, included, status, measure, value, threshold, reason}` in plain Python values; a value that is not
    finite is 0."""
    finite = float(value) if np.isfinite(value) else 0.0
    return {
        "component": component,
        "included": bool(included),
        "status": status,
        "measure": measure,
        "value": round(finite, 6),
        "threshold": float(threshold),
        "reason": reason,
    }


def plan_text(scene: str, quality: str, plan: list[Decision]) -> str:
    """Return plan.yaml: what the scene requires, what is left out, and the measured reason for each."""
    document = {"scene": scene, "quality": quality, "components": plan}
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100)


def plan_sentences(plan: list[Decision]) -> list[str]:
    """Return the plan in a few sentences for a terminal: one for each decision that is made, one for all that are not yet."""
    made = [item for item in plan if item["status"] != PROVISIONAL]
    out = []
    for item in made:
        what = "modelled" if item["included"] else "left out"
        asked = ", as the settings ask" if item["status"] == FORCED else ""
        out.append(f"{_in_words(item)}: {what}{asked}: {item['reason']}")
    later = ", ".join(_in_words(item) for item in plan if item["status"] == PROVISIONAL)
    return [*out, f"decided while the scene is solved: {later}"] if later else out


def _in_words(item: Decision) -> str:
    return str(item["component"]).replace("_", " ")


EVIDENCE = "gain of held-out log likelihood, in standard errors"


def not_probed(component: str, included: bool, reason: str, status: str) -> Decision:
    """Return a decision that no probe was made for."""
    return decision(component, included, "not probed", 0.0, 0.0, reason, status)


def by_evidence(component: str, included: bool, evidence: Evidence, reason: str, status: str) -> Decision:
    """Return a decision in the currency of the plan: the gain over its standard error, and both in nats."""
    value = evidence.gain / evidence.error if evidence.error > 0 else 0.0
    record = decision(component, included, EVIDENCE, value, 1.0, reason, status)
    return {**record, "gain_nats": round(evidence.gain, 3), "error_nats": round(evidence.error, 3), "rows": evidence.rows}
