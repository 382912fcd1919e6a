"""How the pictures of a relighting are shown: one exposure for all frames, then a response."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from iif_core.camera.response import Response, response
from iif_core.light.relighting import exposure_for
from iif_core.numerics.color import to_uint8

Array = np.ndarray


@dataclass(frozen=True)
class Display:
    """Turns radiance into pictures: factor (3,), then the curve. `source`: text that says where the exposure is from."""

    factor: Array
    curve: Response
    source: str

    def __call__(self, radiance: Array) -> Array:
        """Return radiance (H, W, 3) as an (H, W, 3) uint8 picture."""
        return to_uint8(self.curve(np.clip(self.factor * radiance, 0, 1)))

    def facts(self) -> dict[str, Any]:
        """Return exposure, white balance and source, for relight.json."""
        level = np.exp(np.mean(np.log(self.factor)))
        return {"exposure": float(level), "white_balance": (self.factor / level).tolist(), "exposure_of": self.source}


def display_of(
    entry: dict[str, Any], curve: Response, taken: Array | None, view: str, before: Array, first: Callable[[], Array]
) -> Display:
    """Return how the pictures of a relighting are shown.

    The exposure of a photograph includes its white balance where the pictures go through the response of the camera.

    Args:
        entry: the dumped relighting.
        curve: the response of the camera.
        taken: (3,) factors with which the nearest photograph was taken; None for linear ones, which have no exposure.
        view: name of that photograph.
        before: (H, W, 3), the first frame of the room as it was found, which takes the place of linear photographs.
        first: returns the first frame of the relighting.
    """
    wanted, own = entry["exposure"], entry["response"] == "srgb"
    curve = response("srgb") if own else curve
    level = None if taken is None else float(np.exp(np.mean(np.log(taken))))
    balance = np.ones(3) if own or taken is None else taken / level
    if wanted == "auto":
        return Display(exposure_for(first()) * balance, curve, "by the first frame")
    if wanted != "photograph":
        return Display(float(wanted) * balance, curve, f"{wanted:g}")
    if taken is None:
        return Display(np.full(3, exposure_for(before)), curve, "by the room as found")
    return Display(level * balance, curve, f"of photograph {view}")
