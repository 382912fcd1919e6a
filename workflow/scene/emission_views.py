"""What stage emission reads of a capture: views, decoded once as far as memory allows, and their exposures."""

from __future__ import annotations

import numpy as np

from iif_core.camera.gains import CameraGains
from iif_core.light.base_scene import BaseScene
from iif_core.light.emission.photographs import SEEDS, ViewRecord
from workflow.decisions import camera as decisions
from workflow.runtime.job import Job
from workflow.scene.base_scene import base_maps
from workflow.scene.decoded import DecodedViews, Kept
from workflow.scene.normal_form import CaptureReader, View

VIEW_MEMORY_MB = 1024.0
"""Megabytes of decoded views that are kept in memory; every pass over the photographs decodes the others again."""


class ViewRecords:
    """Records of views, read from disk once as far as they fit into VIEW_MEMORY_MB.

    Where the photographs have more pixels than `most` in all, a record is of a random choice of those of its view, the same
    share of every view; nothing but `seen` and `median_depth` is then of the whole view.
    """

    def __init__(self, job: Job, capture: CaptureReader, scene: BaseScene, most: int):
        self.job, self.scene = job, scene
        # Records are kept, not the files that they are made of.
        self.decoded, self._kept = DecodedViews(capture, job.read("segmentation"), 0), Kept(VIEW_MEMORY_MB)
        self.share = min(1.0, most / max(sum(view.width * view.height for view in capture.used), 1))

    def __getitem__(self, view: View) -> ViewRecord:
        return self._kept.once(view.view_id, lambda: self._record(view))

    def _record(self, view: View) -> ViewRecord:
        among = None
        if self.share < 1:
            rng = np.random.default_rng([self.job.seed, SEEDS, 5, view.view_id])
            among = rng.random((view.height, view.width)) < self.share
        base = None if view.split == "test" else base_maps(self.job, view)
        return ViewRecord.of(self.decoded.maps(view), self.scene.normals, base, among)


def view_exposures(capture: CaptureReader, notes: list[str]) -> CameraGains:
    """Return the exposures of the views as the source knows them."""
    exposures = capture.exposures()
    bad = [view.name for view in capture.views if not 0 < view.exposure < np.inf]
    if bad:  # docs/method/numerics.md#exposure-at-zero
        notes.append(f"exposure not positive, taken as 1: {', '.join(bad)}")
        exposures = np.where((exposures > 0) & (exposures < np.inf), exposures, 1.0)
    return CameraGains.plain(exposures)


def gain_plan(capture: CaptureReader, gains: CameraGains) -> list[decisions.Decision]:
    """Return the decisions about exposure, white balance and vignetting."""
    if not capture.facts.get("exposure_estimated"):
        return [decisions.exposure("given", np.zeros(0), 0)]
    found = [decisions.exposure("estimate", np.log(gains.exposure), int(gains.estimated.sum()))]
    for term, evidence in gains.evidence.items():
        found.append(decisions.camera_term(term, evidence))
    return found
