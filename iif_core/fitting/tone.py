"""The curve that residuals are measured in, as tables that the compiled loops read: the response (LDR) or Eq. M.3 (HDR).

Values are read with a cubic Hermite polynomial in u = x^(1/4), derivatives by the parameters linearly; above 1 it is a straight
line (Eq. C.16).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting.kernels import ResponseTables

NODES = 500
"""Intervals of the tables."""


@dataclass(frozen=True)
class Tone:
    """A camera response, or the logarithmic curve gain log(1 + x / knee) if `knee` > 0."""

    response: Response
    knee: float = 0.0
    gain: float = 1.0

    @property
    def size(self) -> int:
        """Number of parameters of the response, P."""
        return 0 if self.knee else self.response.params.size

    @property
    def per_channel(self) -> bool:
        """Whether each channel has its own parameters."""
        return self.size > 0 and self.response.params.ndim == 2

    @property
    def params_of_channel(self) -> int:
        """Number of parameters that one channel depends on."""
        return self.response.params.shape[-1] if self.size else 0

    def value(self, y: np.ndarray) -> np.ndarray:
        """Return a photograph as the residuals see it: HDR radiance through the curve, LDR values unchanged."""
        return self.gain * np.log1p(np.maximum(y, 0.0) / self.knee) if self.knee else np.asarray(y)

    def curvature_ratio(self, y: np.ndarray) -> np.ndarray:
        """Return f'' / f'^2 where the curve has the value y (n, 3), by which noise of x shifts the mean of f (Eq. M.13)."""
        if self.knee:
            return np.full(y.shape, -1.0 / self.gain)
        x = np.repeat((np.linspace(0.05, 1.0, 400)[:, None]) ** 4, 3, 1)
        f, slope, _ = self.response.evaluate(x)
        second = np.gradient(slope, x[:, 0], axis=0)
        return np.stack([np.interp(y[:, c], f[:, c], (second / slope**2)[:, c]) for c in range(3)], 1)

    def at(self, params: np.ndarray) -> Tone:
        """Return the curve with other parameters, projected into the range of the family."""
        if not self.size:
            return self
        return replace(self, response=self.response.with_params(np.asarray(params).reshape(self.response.params.shape)))

    @cached_property
    def tables(self) -> ResponseTables:
        """The curve as the compiled loops read it."""
        u = np.arange(NODES + 1) / NODES
        x = np.repeat((u**4)[:, None], 3, 1)
        f, slope, dparams = self.response.evaluate(x)
        curve = np.stack([f, slope * (4.0 * u**3)[:, None]], -1).transpose(1, 0, 2)
        _, _, beyond = self.response.evaluate(np.full((1, 3), 2.0))
        per = self.params_of_channel
        ends = np.concatenate([slope[-1][:, None], beyond[0, :, :per] - dparams[-1, :, :per]], -1)
        by_params = np.ascontiguousarray(dparams[:, :, :per].transpose(1, 0, 2))
        return ResponseTables(float(self.knee), float(self.gain), np.ascontiguousarray(curve), ends, by_params, self.per_channel)


def make_tone(response: Response, value: np.ndarray) -> Tone:
    """Make the curve for a response; `identity` means linear radiance, with the logarithmic curve for the values (n, 3)."""
    if response.family != "identity":
        return Tone(response)
    positive = value[value > 0]
    if not len(positive):
        return Tone(response, 1.0, 1.0)
    knee = 0.25 * float(np.median(positive))
    return Tone(response, knee, 1.0 / float(np.log1p(np.quantile(positive, 0.99) / knee)))
