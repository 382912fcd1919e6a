"""What the residual is measured in, as tables that the compiled loops read.

LDR: the sensor value f(e L). HDR: a logarithmic curve of the radiance, log(1 + x / knee), where an error counts relative to
the brightness down to the knee, a quarter of the median.

The response is known only through `Response.evaluate`. On [0, 1] it is tabulated at the nodes u_i = i / 2000 of u = x^(1/4),
where powers are smooth, and read with a cubic Hermite polynomial in u (value and slope exact at the nodes, 1e-10 between
them); derivatives with respect to parameters are read linearly. Above 1 it is a straight line (METHOD H32).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from iif_core.camera.response import Response

NODES = 500


@dataclass(frozen=True)
class Tone:
    """A response, or the logarithmic curve when `knee` > 0.

    Attributes:
        response: also the family without parameters that HDR has; knee, gain: of gain log(1 + x / knee).
    """

    response: Response
    knee: float = 0.0
    gain: float = 1.0

    @property
    def size(self) -> int:
        """Number of free parameters, P."""
        return 0 if self.knee else self.response.params.size

    @property
    def per_channel(self) -> bool:
        return self.size > 0 and self.response.params.ndim == 2

    @property
    def per(self) -> int:
        """Parameters that one channel depends on."""
        return self.response.params.shape[-1] if self.size else 0

    def value(self, y: np.ndarray) -> np.ndarray:
        """What a photograph is compared in: HDR radiance through the curve, LDR as it is."""
        return self.gain * np.log1p(np.maximum(y, 0.0) / self.knee) if self.knee else np.asarray(y)

    def bend(self, y: np.ndarray) -> np.ndarray:
        """f'' / f'^2 where the curve has the value y (n, 3): how noise of x bends the mean of f."""
        if self.knee:
            return np.full(y.shape, -1.0 / self.gain)
        x = np.repeat((np.linspace(0.05, 1.0, 400)[:, None]) ** 4, 3, 1)
        f, slope, _ = self.response.evaluate(x)
        second = np.gradient(slope, x[:, 0], axis=0)
        return np.stack([np.interp(y[:, c], f[:, c], (second / slope**2)[:, c]) for c in range(3)], 1)

    def at(self, params: np.ndarray) -> Tone:
        """The same family with other parameters, moved into its range."""
        if not self.size:
            return self
        return replace(self, response=self.response.with_params(np.asarray(params).reshape(self.response.params.shape)))

    @cached_property
    def tables(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """curve (3, NODES + 1, 2): f and df/du; ends (3, 1 + per): df/dx at 1 and its derivatives; params (3, NODES + 1, per)."""
        u = np.arange(NODES + 1) / NODES
        x = np.repeat((u**4)[:, None], 3, 1)
        f, slope, dparams = self.response.evaluate(x)
        curve = np.stack([f, slope * (4.0 * u**3)[:, None]], -1).transpose(1, 0, 2)
        _, _, beyond = self.response.evaluate(np.full((1, 3), 2.0))
        per = self.per
        ends = np.concatenate([slope[-1][:, None], beyond[0, :, :per] - dparams[-1, :, :per]], -1)
        return np.ascontiguousarray(curve), ends, np.ascontiguousarray(dparams[:, :, :per].transpose(1, 0, 2))


def make_tone(response: Response, value: np.ndarray) -> Tone:
    """`identity` means linear radiance: the logarithmic curve through the photographs `value` (n, 3)."""
    if response.family != "identity":
        return Tone(response)
    positive = value[value > 0]
    if not len(positive):
        return Tone(response, 1.0, 1.0)
    knee = 0.25 * float(np.median(positive))
    return Tone(response, knee, 1.0 / float(np.log1p(np.quantile(positive, 0.99) / knee)))
