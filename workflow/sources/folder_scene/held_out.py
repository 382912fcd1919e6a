"""Held-out photographs that the used ones already show: what is held out must not be in what is used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

TWIN_PIXELS = 1.0
"""Two cameras take the same picture if surface at the median depth moves by less than so many pixels between them."""

DEPTH_WIDTH = 64
"""Pixels across at which the median depth of a photograph is looked up."""


@dataclass(frozen=True)
class HeldOut:
    """Which photographs are held out, and how far they are from those that are used.

    Attributes:
        split: `train` or `test` for each photograph.
        twins: photograph that is held out as well -> the held-out one that it repeats, both as indices.
        distance: metres from each held-out photograph to the nearest used one, (h,); angle: degrees between the two, (h,).
    """

    split: list[str]
    twins: dict[int, int]
    distance: np.ndarray
    angle: np.ndarray

    def facts(self, names: Sequence[str]) -> dict[str, object]:
        """Return the entry of capture.json: twins by name, and the medians; empty without a held-out photograph."""
        if not len(self.distance):
            return {}
        twins = {names[twin]: names[of] for twin, of in self.twins.items()}
        return {"twins": twins, "nearest_m": float(np.median(self.distance)), "nearest_degrees": float(np.median(self.angle))}

    def notes(self, names: Sequence[str]) -> list[str]:
        """Say what a reader of the held-out score has to know."""
        out = []
        if self.twins:
            first, of = next(iter(self.twins.items()))
            more = f", and {len(self.twins) - 1} more" if len(self.twins) > 1 else ""
            out.append(f"held out as well, because they repeat held-out photographs: {names[first]} ({names[of]}){more}")
        if len(self.distance):
            out.append(
                f"held-out photographs are {np.median(self.distance):.2g} m and {np.median(self.angle):.2g} degrees from the"
                " nearest used one (medians)"
            )
        return out


def hold_out(
    split: Sequence[str], digests: Sequence[str], poses: Sequence[np.ndarray], focal: np.ndarray, depth: np.ndarray
) -> HeldOut:
    """Hold out every photograph that repeats a held-out one: the same file, or a picture from the same place.

    In the middle of the picture, surface at depth z moves by at most about f (|c_u - c_h| / z + angle(R_h, R_u)) pixels from
    camera h to camera u. Twins of twins stay in use, so that a video does not vanish as a whole.

    Args:
        split: `train` or `test` for each of n photographs.
        digests: of their files.
        poses: (4, 4) `world_from_camera`.
        focal: (n,) focal lengths, pixels at the size at which they are used.
        depth: (n,) median depth of the surface that each shows, metres; NaN = it shows none.

    Returns:
        The split with twins held out, and distances.
    """
    every = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    tests = np.flatnonzero([one == "test" for one in split])
    trains = np.flatnonzero([one != "test" for one in split])
    if not len(tests) or not len(trains):
        return HeldOut(list(split), {}, np.zeros(0), np.zeros(0))
    centre = every[:, :3, 3]
    apart = np.linalg.norm(centre[tests][:, None] - centre[trains], axis=-1)
    cosine = np.einsum("aij,bij->ab", every[tests, :3, :3], every[trains, :3, :3])
    angle = np.arccos(np.clip((cosine - 1) / 2, -1, 1))
    with np.errstate(invalid="ignore"):
        moved = np.asarray(focal)[tests, None] * (apart / np.asarray(depth)[tests, None] + angle)
    same_file = np.asarray(digests)[tests, None] == np.asarray(digests)[None, trains]
    repeats = same_file | (np.nan_to_num(moved, nan=np.inf) < TWIN_PIXELS)
    twins = {int(trains[u]): int(tests[np.argmax(repeats[:, u])]) for u in np.flatnonzero(repeats.any(0))}
    kept = ~repeats.any(0)
    out = ["test" if i in twins else one for i, one in enumerate(split)]
    if not kept.any():
        return HeldOut(out, twins, np.full(len(tests), np.nan), np.full(len(tests), np.nan))
    nearest = np.argmin(apart[:, kept], axis=1)
    row = np.arange(len(tests))
    return HeldOut(out, twins, apart[:, kept][row, nearest], np.degrees(angle[:, kept][row, nearest]))
