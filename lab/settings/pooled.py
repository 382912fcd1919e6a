"""Settings of the prior that pools others, whose classes are read before it is defined."""

from __future__ import annotations

from lab.settings.prior import Seeded
from workflow.settings import prior


class PooledPrior(prior.PooledPrior, Seeded):
    """Prior `pooled`, seeded."""
