"""How the predictions of a prior err over the objects of a room, and what its base texture therefore says about each object
(docs/method/fitting.md#priors-that-state-their-errors)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core.errors import InputError

DEGREES_OF_FREEDOM = 4.0
"""Of Student's t of the error of roughness."""
SECOND_LOOK = 0.85
"""Error of the brightness of an object in a base that was predicted under the computed light, relative to the first base
(docs/method/priors.md#a-second-look)."""
_RAREST = 1e-3
"""Metallic closer to 0 or 1 than this says no more than this."""


@dataclass(frozen=True)
class PredictionErrors:
    """Errors of a prior, measured on rooms that it was not trained on.

    Attributes:
        level: standard deviation of the logarithm of the mean predicted over the mean true albedo of a room.
        brightness: scale of Student's t (four degrees of freedom) of the logarithm of an object's brightness over the true one,
            relative to the room, for an albedo of 0.3.
        roughness: (x, r, b, tau): an object that is predicted to have roughness x' has r + b (x' - x), with an error of root
            mean square tau, which is taken for the scale of Student's t: such an error may be a large one.
        metal: (a, b): the logarithm of the likelihood ratio of metal to dielectric is a + b logit(m), m the mean predicted
            metallic of an object.
    """

    level: float
    brightness: float
    roughness: tuple[float, float, float, float]
    metal: tuple[float, float]

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any], where: str) -> PredictionErrors:
        """Read what `facts` wrote.

        Raises:
            InputError: a value is missing, not finite or out of range; `where` names the file.
        """
        try:
            own = cls(
                float(facts["level"]),
                float(facts["brightness"]),
                tuple(map(float, facts["roughness"])),  # type: ignore[arg-type]
                tuple(map(float, facts["metal"])),  # type: ignore[arg-type]
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{where}: object_errors is incomplete ({error}); export the weights again") from error
        values = np.r_[own.level, own.brightness, own.roughness, own.metal]
        if len(own.roughness) != 4 or len(own.metal) != 2 or not np.isfinite(values).all():
            raise InputError(f"{where}: object_errors {dict(facts)}: needed finite numbers, 4 for roughness and 2 for metal")
        if min(own.level, own.brightness, own.roughness[3]) <= 0 or own.roughness[2] < 0:
            raise InputError(f"{where}: object_errors {dict(facts)}: errors must be above 0, and the slope not below it")
        return own

    def of_second_look(self) -> PredictionErrors:
        """Return the errors of a base that was predicted once more, under the light that had been found."""
        return replace(self, brightness=SECOND_LOOK * self.brightness)

    def facts(self) -> dict[str, Any]:
        """Return the values for `recipe.json`."""
        rounded = {name: round(getattr(self, name), 4) for name in ("level", "brightness")}
        return rounded | {name: [round(x, 4) for x in getattr(self, name)] for name in ("roughness", "metal")}

    def metal_log_odds(self, metallic: np.ndarray) -> np.ndarray:
        """Return the log likelihood ratio of metal to dielectric (O,) by the mean predicted metallic (O,) in [0, 1]."""
        m = np.clip(np.asarray(metallic, np.float64), _RAREST, 1.0 - _RAREST)
        return self.metal[0] + self.metal[1] * np.log(m / (1.0 - m))

    def roughness_prior(self, predicted: np.ndarray, roughness: np.ndarray) -> np.ndarray:
        """Return how probable each true roughness (R,) of objects is by the predicted one (O,), relative to the most probable."""
        middle, true, slope, scatter = self.roughness
        expected = true + slope * (np.asarray(predicted, np.float64)[:, None] - middle)
        density = (1.0 + ((roughness - expected) / scatter) ** 2 / DEGREES_OF_FREEDOM) ** (-0.5 * (DEGREES_OF_FREEDOM + 1.0))
        return density / density.max(1, keepdims=True)
