"""Material truth of a pixel: the mean over what the pixel shows, since its photograph is one too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from workflow.scene.normal_form import Truth, View

Array = np.ndarray

POINTS = 4
"""Points along each side of a pixel."""


class Seen(NamedTuple):
    """What the pixel centres of a view show.

    Attributes:
        depth: (H, W) z-depth, 0 = nothing.
        face: (H, W) face ids, -1 = nothing.
        truth: of the points at the centres.
    """

    depth: Array
    face: Array
    truth: Truth


def over_pixels(view: View, look: Callable[[View], Seen], owner: Array) -> Seen:
    """Return what a view shows, with the mean of materials over each pixel in place of those at its centre.

    A photograph averages a texture that is finer than a pixel. Its centre has the texture's colour at one point, which no method
    can know. The mean is of the points, among `POINTS` x `POINTS`, that have a truth and show the object of the centre; all else
    (depth, face, emission, which pixels have a truth) stays that of the centre.

    Args:
        view: the camera.
        look: returns what the pixel centres of a camera show.
        owner: (F,) object of each face.
    """
    centre = look(view)
    own = np.where(centre.face >= 0, owner[centre.face], -1)
    names = "albedo", "roughness", "metallic"
    total = {name: np.zeros(getattr(centre.truth, name).shape) for name in names}
    count = np.zeros(own.shape, np.int64)
    steps = (np.arange(POINTS) + 0.5) / POINTS - 0.5
    for right, down in np.array(np.meshgrid(steps, steps)).reshape(2, -1).T:
        seen = look(replace(view, cx=view.cx - right, cy=view.cy - down))
        same = centre.truth.valid & seen.truth.valid & (seen.face >= 0) & (owner[seen.face] == own)
        count += same
        for name in names:
            total[name][same] += getattr(seen.truth, name)[same]
    found, means = count > 0, {}
    for name in names:
        at_centre = getattr(centre.truth, name)
        means[name] = np.array(at_centre)
        many = count[found].reshape(-1, *(1,) * (at_centre.ndim - 2))
        means[name][found] = (total[name][found] / many).astype(at_centre.dtype)
    return centre._replace(truth=replace(centre.truth, **means))
