"""Errors of what the stages found against the truth of a capture, in few numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iif_core.surface.triangles import face_geometry
from lab.stability.chain import Capture, Result


class Accuracy(NamedTuple):
    """Errors of a result.

    Attributes:
        albedo: PSNR in dB after one gain for each photograph; albedo_as_is: without it.
        roughness, metallic: root mean square error.
        light: logarithm of found over true power of all emitters, the largest modulus of the three channels.
        lost: values of the result that are not finite.
    """

    albedo: float
    albedo_as_is: float
    roughness: float
    metallic: float
    light: float
    lost: int


def accuracy(result: Result, capture: Capture) -> Accuracy:
    """Compare a result with the truth at all pixels of photographs that show a material."""
    squares, counts, rough, metal, lost = np.zeros(2), 0, [], [], 0
    for name, truth in capture.truth.items():
        if name not in result.maps:
            continue
        pick = capture.known[name] & result.seen[name]
        found, wanted = result.maps[name][pick].astype(np.float64), truth[pick].astype(np.float64)
        lost += int((~np.isfinite(found)).sum())
        found = np.nan_to_num(found)
        below = float((found[:, :3] ** 2).sum())
        gain = float((found[:, :3] * wanted[:, :3]).sum()) / below if below > 0 else 1.0
        squares += [((factor * found[:, :3] - wanted[:, :3]) ** 2).sum() for factor in (gain, 1.0)]
        counts += 3 * len(found)
        rough.append((found[:, 3] - wanted[:, 3]) ** 2)
        metal.append((found[:, 4] - wanted[:, 4]) ** 2)
    decibel = -10 * np.log10(np.maximum(squares / max(counts, 1), 1e-10))
    roughness, metallic = (float(np.sqrt(np.concatenate(parts).mean())) if counts else np.nan for parts in (rough, metal))
    return Accuracy(float(decibel[0]), float(decibel[1]), roughness, metallic, _light(result, capture), lost)


def _light(result: Result, capture: Capture) -> float:
    true = (face_geometry(capture.vertices, capture.faces)[1][:, None] * capture.emission.astype(np.float64)).sum(0)
    found = result.power + np.pi * result.environment
    known: NDArray = true > 0
    if not known.any():
        return float("nan")
    return float(np.abs(np.log(np.maximum(found, 1e-30)[known] / true[known])).max())
