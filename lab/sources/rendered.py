"""Views that a source renders itself, one after another."""

from __future__ import annotations

from typing import Any

import numpy as np

from workflow.artifacts.store import rgb
from workflow.scene.normal_form import CaptureWriter, Truth

DENOISED = "photographs denoised (Intel Open Image Denoise): biased, and so is the radiance truth"
"""What a capture says of photographs that were denoised."""


class RenderedWriter(CaptureWriter):
    """Writes the normal form; a job that is killed and started again takes over the views that it had rendered."""

    def rendered(self, name: str, depth: np.ndarray, face_id: np.ndarray, truth: Truth, facts: dict[str, Any]) -> None:
        """Write G-buffer and truth of a view, which a job that is killed and started again takes over with the `facts`."""
        self.gbuffer(name, depth, face_id)
        self.truth(name, truth)
        self.writer.part_done(name, [f"gbuffer/{name}.exr", f"truth/{name}.exr"], facts)

    def kept(self, name: str) -> tuple[np.ndarray, np.ndarray, dict[str, Any]] | None:
        """Take over a view that was `rendered` before the job was killed.

        Returns:
            True radiance (H, W, 3), whether a pixel shows the surface of an emitter (H, W), and the facts; None if the view is to
            be rendered.
        """
        facts = self.writer.part_kept(name)
        if facts is None:
            return None
        truth = self.writer.channels(f"truth/{name}.exr")
        return rgb(truth, "radiance"), rgb(truth, "emission").any(-1), facts
