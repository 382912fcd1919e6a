"""Which photographs are held out: what is held out must not be in what is used."""

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

    @property
    def nearest(self) -> str:
        """How far held-out photographs are from the nearest used one, in words."""
        return f"{np.median(self.distance):.2g} m and {np.median(self.angle):.2g} degrees from the nearest used one (medians)"

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
            out.append(f"held-out photographs are {self.nearest}")
        return out


@dataclass(frozen=True)
class Asked:
    """Which photographs `capture.test_every` holds out.

    Attributes:
        split: `train` or `test` for each photograph.
        step: median motion between neighbours, as a share of the width of the picture.
        blocks: stretches that are held out whole; 0 = every n-th photograph.
    """

    split: list[str]
    step: float
    blocks: int


def asked(poses: Sequence[np.ndarray], focal: np.ndarray, depth: np.ndarray, every: int) -> Asked:
    """Hold out one of `every` photographs, and whole stretches of a video.

    From one photograph to the next, surface moves by about m = f (|c_a - c_b| / z + angle(R_a, R_b)), f in widths of the picture.
    The capture counts as a video if the median of m is below 1 / every: what one held-out photograph shows that its neighbours do
    not is then less than the share that is held out. Of a video, stretches of ceil(4 / (every m)) photographs are held out, in
    which half of them are 1 / every or more from both ends.

    Args:
        poses: (4, 4) `world_from_camera` of n photographs in their order.
        focal: (n,) focal lengths, in widths of the picture.
        depth: (n,) median depth of the surface that each shows, metres; NaN = it shows none.
        every: at least 2.
    """
    count = len(poses)
    split = ["test" if i % every == every - 1 else "train" for i in range(count)]
    held = split.count("test")
    if not held:
        return Asked(split, np.inf, 0)
    world = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    apart = np.linalg.norm(np.diff(world[:, :3, 3], axis=0), axis=1)
    angle = _angle(np.einsum("aij,aij->a", world[:-1, :3, :3], world[1:, :3, :3]))
    motion = np.asarray(focal)[:-1] * (apart / np.asarray(depth)[:-1] + angle)
    step = float(np.median(motion[np.isfinite(motion)])) if np.isfinite(motion).any() else np.inf
    if step >= 1 / every:
        return Asked(split, step, 0)
    length = held if step * every * held <= 4 else int(np.ceil(4 / (every * step)))
    sizes = [len(part) for part in np.array_split(np.arange(held), max(1, round(held / length)))]
    split = ["train"] * count
    for number, size in enumerate(sizes):
        start = int((number + 0.5) * count / len(sizes) - size / 2)
        split[start : start + size] = ["test"] * size
    return Asked(split, step, len(sizes))


def _angle(trace: np.ndarray) -> np.ndarray:
    """Return the angle of rotations by their traces, radians."""
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


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
    angle = _angle(np.einsum("aij,bij->ab", every[tests, :3, :3], every[trains, :3, :3]))
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
