"""Bias of cached light against the number of its paths: diffuse light of the cells, and the power of the emitters.

Stages are run with few and with many paths on one capture, each with several seeds. The difference of the means is the bias,
and its standard error comes from the seeds. Diffuse light is a mean of paths and must have none; adding paths only where the
halves of a cell differ could bring one, and is a separate case. The power comes from least squares whose matrix is noisy.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lab.stability import chain
from lab.stability.chain import Capture

SEEDS = 8
LIMIT = 3.5
"""Largest bias of diffuse light in standard errors."""
MANY: dict[str, Any] = {"samples": 512, "max_samples": 512, "noise": 1e6}
FEW: dict[str, dict[str, Any]] = {
    "4 paths": {"samples": 4, "max_samples": 4, "noise": 1e6},
    "16 paths": {"samples": 16, "max_samples": 16, "noise": 1e6},
    "64 paths": {"samples": 64, "max_samples": 64, "noise": 1e6},
    "4 to 256 paths, where they are noisy": {"samples": 4, "max_samples": 256, "noise": 0.05},
}
ROWS = (4, 16, 64)
"""Paths for each row of the light's least squares, and `MOST` of the reference."""
MOST = 256


class Bias(NamedTuple):
    """Mean of a cache with few paths against that with many.

    Attributes:
        room, cache, paths: what was measured.
        bias: relative difference of the means; error: its standard error.
        spread: root mean square difference of one run from the mean of the reference, relative to it.
        judged: whether it must be unbiased.
    """

    room: str
    cache: str
    paths: str
    bias: float
    error: float
    spread: float
    judged: bool

    @property
    def sigmas(self) -> float:
        """Bias in standard errors."""
        return abs(self.bias) / self.error if self.error > 0 else 0.0


def compare(room: str, cache: str, paths: str, few: NDArray, many: NDArray, judged: bool) -> Bias:
    """Compare runs (R, n) with reference runs (S, n) of the same quantities."""
    means = few.mean(1), many.mean(1)
    reference, centre = float(means[1].mean()), many.mean(0)
    error = np.hypot(*(values.std(ddof=1) / np.sqrt(len(values)) for values in means)) / reference
    spread = float(np.sqrt(((few - centre) ** 2).mean())) / reference
    return Bias(room, cache, paths, float(means[0].mean() / reference - 1), float(error), spread, judged)


def measure(room: str, seeds: int = SEEDS) -> Iterator[Bias]:
    """Measure both caches on one of `chain.ROOMS`."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        capture = chain.make_capture(folder / "capture", chain.ROOMS[room])
        chain.run(capture, folder / "run")

        def diffuse(settings: dict[str, Any], first: int) -> NDArray:
            changed = capture.with_settings(shading=settings)
            return np.stack([_shading(changed, folder / "run", first + seed) for seed in range(seeds)])

        many = diffuse(MANY, 1000)
        for number, (paths, settings) in enumerate(FEW.items()):
            yield compare(room, "diffuse light", paths, diffuse(settings, 100 * number), many, True)
        powers = {
            samples: np.stack([_power(capture, folder / "run", samples, 100 * samples + seed) for seed in range(seeds)])
            for samples in (*ROWS, MOST)
        }
        for samples in ROWS:
            yield compare(room, "power of the emitters", f"{samples} paths", powers[samples], powers[MOST], False)


def _shading(capture: Capture, folder: Path, seed: int) -> NDArray:
    """Diffuse light of all pixels that show an object, one number each."""
    chain.run_stages(folder, {**capture.document, "seed": seed}, ("shading",))
    found = chain.read(capture, folder)
    return np.concatenate([found.diffuse[view.name][found.seen[view.name]].mean(-1) for view in capture.views])


def _power(capture: Capture, folder: Path, samples: int, seed: int) -> NDArray:
    changed = replace(capture.with_settings(emission={"samples": samples}), threads=1)
    chain.run_stages(folder, {**changed.document, "seed": seed}, ("emission",))
    return chain.read(capture, folder).power
