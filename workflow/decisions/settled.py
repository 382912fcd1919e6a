"""The plan of a scene after all of its stages: what was planned, and what they found."""

from __future__ import annotations

from collections.abc import Mapping

from workflow.artifacts.store import StageReader
from workflow.decisions.plan import GAINS, with_override
from workflow.decisions.record import FORCED, PROVISIONAL, SETTLED, Decision

KEYS = (
    "component",
    "included",
    "status",
    "measure",
    "value",
    "threshold",
    "gain_nats",
    "error_nats",
    "rows",
    "reason",
    "components",
)
"""What of a decision enters the plan."""


def settled_plan(readers: Mapping[str, StageReader]) -> list[Decision]:
    """Return the plan items in the JSON documents of the stages (key `plan`), with the name of the rule, in the order in which
    their components are first named. What a later stage found replaces what was planned; of gains that no stage had a reason to
    try there are none."""
    items: dict[str, Decision] = {}
    for stage, reader in readers.items():
        for name in reader.names():
            if "/" in name or not name.endswith(".json"):
                continue
            document = reader.json(name)
            found = document.get("plan", []) if isinstance(document, dict) else []
            for item in found if isinstance(found, list) else []:
                kept = {key: item[key] for key in KEYS if key in item}
                earlier = items.get(item["component"], {})
                forced = {"status": FORCED} if earlier.get("status") == FORCED else {}
                found_here = {**kept, "included": bool(item.get("included")), **forced, "rule": stage}
                items[item["component"]] = {"status": SETTLED, **found_here}
    untried = {"included": False, "status": SETTLED, "reason": "no stage had a reason to try it"}
    settled = ({**i, **untried} if i["status"] == PROVISIONAL and i["component"] in GAINS else i for i in items.values())
    return [with_override(item) for item in settled]
