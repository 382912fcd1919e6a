"""How fast this machine is relative to the one that the costs were fitted on, from what its finished jobs took."""

from __future__ import annotations

import glob
import math
import os
from functools import lru_cache
from pathlib import Path

from workflow.artifacts.files import facts_in

LATEST = 120
"""Jobs that are looked at, the latest first."""
SHORTEST = 2.0
"""CPU seconds below which a job says little about the machine."""
PRIOR_JOBS = 4
"""Jobs on a machine of factor 1 that are added to those that were measured."""


@lru_cache(None)
def machine_factor(root: Path = Path("results")) -> float:
    """Return how many times as long this machine takes as the machine of the fits; 1 where no job has finished yet.

    It is the geometric mean, over jobs, of CPU seconds taken over CPU seconds expected, with errors of single jobs cut at a
    factor of 3.
    """
    files = sorted(glob.glob(f"{glob.escape(str(root))}/*/benchmarks/*.parts.json"), key=os.path.getmtime, reverse=True)
    total, count = 0.0, 0
    for path in files[:LATEST]:
        document = facts_in(path)
        try:
            taken, expected = float(document["job"]["cpu_seconds"]), float(document["expected"]["cpu_seconds"])
        except (ValueError, KeyError, TypeError):
            continue
        if taken >= SHORTEST and expected > 0:
            total += min(max(math.log(taken / expected), -math.log(3)), math.log(3))
            count += 1
    return math.exp(total / (count + PRIOR_JOBS))
