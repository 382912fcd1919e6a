"""plan: what the scene requires, from photographs, cameras and mesh alone (docs/method/plan.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.requirements.probes import gloss_evidence, light_evidence
from workflow.decisions import plan as decisions
from workflow.decisions.record import Decision, plan_text
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader
from workflow.scene.probes import probe_rows


def run(job: Job) -> None:
    """Write plan.json and plan.yaml: every component, in or out, settled, provisional or forced, and the evidence."""
    capture = CaptureReader(job.read("capture"))
    write(job, capture, *_probed(job, capture))


def write(job: Job, capture: CaptureReader, plan: list[Decision], facts: dict[str, Any]) -> None:
    """Write the plan, with what later stages decide added to what is known now; `facts`: what the probes looked at."""
    plan = plan + decisions.later(
        capture.is_hdr, bool(capture.facts.get("exposure_estimated")), {item["component"] for item in plan}
    )
    plan = [decisions.with_override(item) for item in plan]
    for item in plan:
        job.log.info("%s: %s (%s): %s", item["component"], "in" if item["included"] else "out", item["status"], item["reason"])
    job.writer.json("plan.json", {"plan": plan, "probes": facts})
    job.writer.bytes("plan.yaml", plan_text(job.scene, job.quality, plan).encode())


def _probed(job: Job, capture: CaptureReader) -> tuple[list[Decision], dict[str, Any]]:
    """Return the decisions that photographs and mesh allow, and what the probes looked at."""
    settings = job.settings
    device.mitsuba()
    from iif_core.light.transport.geometry import build_geometry

    vertices, faces = capture.mesh()
    with job.timed("probes"):
        geometry = build_geometry(vertices, faces, np.zeros(len(faces), np.int32))
        rows = probe_rows(job, capture, geometry)
        light, gloss = light_evidence(rows.light, job.seed), gloss_evidence(rows.gloss, job.seed)
    escape = rows.escape_primary, rows.escape_secondary
    plan = [
        decisions.environment(settings.emission.environment, *escape, rows.outside, light["environment"]),
        decisions.emitters(capture.is_hdr, light["emitters"]),
        decisions.specular(settings.components.specular, gloss),
        decisions.radiance_cache(rows.photographed),
    ]
    facts = {
        "points": len(rows.light.radiance),
        "pairs": len(rows.gloss.radiance),
        "escape_share": {"primary": rows.escape_primary, "secondary": rows.escape_secondary},
        "photographed_share": rows.photographed,
        "outside_brightness": rows.outside,
    }
    return plan, facts
