"""Settings of priors that need ground truth."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from workflow.settings.prior import PriorBase


class SimulatedPrior(PriorBase):
    """Ground truth with errors like those of RGB-X. Needs a source with ground truth."""

    kind: Literal["simulated"]
    strength: float = Field(1.0, ge=0, le=4)
    """Strength of the errors: 0 = ground truth; 1 = errors as large as the paper reports for RGB-X."""
    shared: float = Field(1.0, ge=0, le=10)
    """Factor on the errors of albedo that all views of an object share, which no fusion of predictions can remove."""
