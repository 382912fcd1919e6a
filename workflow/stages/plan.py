"""plan: what the scene requires, from photographs, cameras and mesh alone (docs/method/plan.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.requirements.probes import gloss_evidence, light_evidence
from workflow.decisions import plan as decisions
from workflow.decisions.record import plan_text
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader
from workflow.scene.probes import probe_rows


def run(job: Job) -> None:
    """Write plan.json and plan.yaml: every component, in or out, settled, provisional or forced, and the evidence."""
    device.mitsuba()
    from iif_core.light.transport.geometry import build_geometry

    settings, forced = job.settings, job.settings.override.components.specular
    capture = CaptureReader(job.read("capture"))
    vertices, faces = capture.mesh()
    with job.timed("probes"):
        geometry = build_geometry(vertices, faces, np.zeros(len(faces), np.int32))
        rows = probe_rows(job, capture, geometry, settings.emission.saturation)
        light = light_evidence(rows.light, job.seed)
        gloss, _ = gloss_evidence(rows.gloss, job.seed)
    environment = decisions.environment(
        settings.emission.environment, rows.escape_primary, rows.escape_secondary, light["environment"]
    )
    specular = decisions.specular(forced, gloss, _reads_lobes(settings))
    plan = [
        environment,
        decisions.emitters(capture.is_hdr, light["emitters"]),
        specular,
        decisions.radiance_cache(rows.photographed),
        *decisions.later(capture.is_hdr, bool(capture.facts.get("exposure_estimated"))),
    ]
    plan = [decisions.with_override(item) for item in plan]
    for item in plan:
        job.log.info("%s: %s (%s): %s", item["component"], "in" if item["included"] else "out", item["status"], item["reason"])
    facts = {
        "points": len(rows.light.radiance),
        "pairs": len(rows.gloss.radiance),
        "escape_share": {"primary": rows.escape_primary, "secondary": rows.escape_secondary},
        "photographed_share": rows.photographed,
        "outside_brightness": rows.outside,
    }
    job.writer.json("plan.json", {"plan": plan, "probes": facts})
    job.writer.bytes("plan.yaml", plan_text(job.scene, job.quality, plan).encode())


def _reads_lobes(settings: Any) -> str | None:
    """Return why the settings need specular lobes whatever the photographs show; None = they do not."""
    published = settings.shading.method == "published" or settings.emission.solver.startswith("published")
    return "the published method traces all lobes" if published else None
