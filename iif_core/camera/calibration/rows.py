"""Rows of shared surface for fitting a response curve: by channel, thinned, with the gains of their views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from iif_core.camera.gains import CameraGains
from iif_core.camera.overlap import PatchRows

MIN_VALUE = 4.0 / 255.0
"""Smallest sensor value that is used (docs/method/numerics.md#logarithm-of-zero)."""
MAX_ROWS = 8_000
"""Number of rows per channel that are fitted."""
MIN_STOPS = 1.0  # exposure range that a patch needs
KNOTS = np.linspace(0.1, 1.0, 257) ** 2  # sensor values where log x and the gain are tabulated


def log_factor(rows: PatchRows, gains: CameraGains) -> np.ndarray:
    """Compute the log of the factor of radiance in each row, (n, 3); NaN where the exposure is not known."""
    radius2 = np.zeros(len(rows.view)) if rows.radius2 is None else rows.radius2
    factor = gains.factor(rows.view, radius2)
    return np.log(np.where(np.isfinite(factor) & (factor > 0), factor, np.nan))


@dataclass
class Channel:
    """Rows of one channel, or of several channels in sequence: n unsaturated rows and b bounds on C patches.

    Attributes:
        cell: (n,) patch; value: (n,) sensor value; log_e: (n,) log factor of radiance; block, cluster: (n,) int.
        full, full_e, full_cluster: (b,) patch, log factor and cluster of the bounds.
        row, full_row: entries of the flattened (rows, 3) table.
        stops: largest difference of exposure within a patch, in stops.
        saturation: sensor value from which on rows are bounds.
        knot, part: position of the values between the entries of KNOTS.
        share: (n,) factor (m - 1) / m of the likelihood.
    """

    cell: np.ndarray
    value: np.ndarray
    log_e: np.ndarray
    block: np.ndarray
    cluster: np.ndarray
    full: np.ndarray
    full_e: np.ndarray
    full_cluster: np.ndarray
    row: np.ndarray
    full_row: np.ndarray
    stops: float
    saturation: float
    knot: np.ndarray = field(init=False)
    part: np.ndarray = field(init=False)
    share: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.knot = np.clip(np.searchsorted(KNOTS, self.value, side="right") - 1, 0, len(KNOTS) - 2)
        self.part = (self.value - KNOTS[self.knot]) / (KNOTS[self.knot + 1] - KNOTS[self.knot])
        # The level of a patch with m rows uses up one of them (Eq. C.19).
        members = np.bincount(self.cell, minlength=self.cells)
        self.share = (1.0 - 1.0 / np.maximum(members, 1))[self.cell]

    def exposed(self, log_factor: np.ndarray) -> Channel:
        """The same rows under other gains, `log_factor` (all rows, 3)."""
        return replace(self, log_e=log_factor.ravel()[self.row], full_e=log_factor.ravel()[self.full_row])

    @property
    def cells(self) -> int:
        return int(max(self.cell.max(initial=-1), self.full.max(initial=-1))) + 1

    def at(self, table: np.ndarray) -> np.ndarray:
        """Interpolate a table on the knots at the rows, (n, ...)."""
        part = self.part.reshape(-1, *[1] * (table.ndim - 1))
        return table[self.knot] * (1.0 - part) + table[self.knot + 1] * part

    def scatter(self, row: np.ndarray) -> np.ndarray:
        """Sum row values (n,) at the knots: the transpose of `at`."""
        size = len(KNOTS)
        return np.bincount(self.knot, row * (1.0 - self.part), size) + np.bincount(self.knot + 1, row * self.part, size)


def channel_rows(rows: PatchRows, c: int, gains: CameraGains, saturation: float, budget: int = MAX_ROWS) -> Channel:
    """Select the rows of one channel, on patches whose exposures differ enough and that some view shows unsaturated.

    Args:
        rows: shared surface.
        c: channel.
        gains: gains of the views.
        saturation: sensor value from which on rows are bounds.
        budget: approximate number of rows.

    Returns:
        Rows of the channel.
    """
    value, clipped = rows.value[:, c], rows.clipped[:, c]
    log_e = log_factor(rows, gains)[:, c]
    use = np.flatnonzero(np.isfinite(value) & (value > MIN_VALUE) & np.isfinite(log_e))
    # Range of exposures on each patch, in stops. A narrow one says nothing about the curve; a patch that is saturated in all
    # views has no level.
    owner = np.unique(rows.patch[use], return_inverse=True)[1]
    size = int(owner.max(initial=-1)) + 1
    low, high = np.full(size, np.inf), np.full(size, -np.inf)
    np.minimum.at(low, owner, log_e[use])
    np.maximum.at(high, owner, log_e[use])
    span = (high - low) / np.log(2.0)
    kept = np.flatnonzero((span >= MIN_STOPS - 1e-9) & (np.bincount(owner, ~clipped[use], size) > 0))
    stops = float(span.max(initial=0.0))
    index = use[_thinned(owner, value[use], clipped[use], kept, budget)[owner]]
    cell = np.unique(rows.patch[index], return_inverse=True)[1]
    # Rows of one object in one view err together, because gloss brightens the object in that view as a whole.
    cluster = rows.block[index].astype(np.int64) * (len(gains.gain) + 1) + rows.view[index]
    block = np.unique(rows.block[index], return_inverse=True)[1]
    full = clipped[index]
    clear = ~full
    return Channel(
        cell=cell[clear],
        value=value[index[clear]],
        log_e=log_e[index[clear]],
        block=block[clear],
        cluster=cluster[clear],
        full=cell[full],
        full_e=log_e[index[full]],
        full_cluster=cluster[full],
        row=3 * index[clear] + c,
        full_row=3 * index[full] + c,
        stops=stops,
        saturation=saturation,
    )


def _thinned(owner: np.ndarray, value: np.ndarray, clipped: np.ndarray, kept: np.ndarray, budget: int) -> np.ndarray:
    """Choose whole patches of `kept` for about `budget` rows, (patches,) bool, evenly over ten ranges of brightness.

    The few patches near saturation determine the scale of x, so they must not be outnumbered.
    """
    size = int(owner.max(initial=-1)) + 1
    # Brightest unsaturated value of each patch, by which it falls into one of ten ranges.
    top = np.zeros(size)
    np.maximum.at(top, owner, np.where(clipped, 0.0, value))
    order = kept[np.argsort(np.minimum((10.0 * top[kept]).astype(int), 9), kind="stable")]
    members = np.bincount(owner, minlength=size)
    tenth = np.minimum((10.0 * top[order]).astype(int), 9)
    rows = np.bincount(tenth, members[order], 10)
    # Ranges with few rows are taken whole, and the others share what is left evenly: `limit` rows each. `room` is that limit if
    # the k smallest ranges are taken whole.
    level = np.sort(rows)
    room = (budget - np.r_[0.0, np.cumsum(level)[:-1]]) / np.arange(10, 0, -1)
    limit = room[np.argmax(room <= level)] if rows.sum() > budget else np.inf
    share = np.minimum(1.0, limit / np.maximum(rows, 1.0))[tenth]
    # Within a range every patch has the same share. One is taken whenever the running sum of shares reaches another integer.
    wanted = np.zeros(size, bool)
    wanted[order[np.floor(np.cumsum(share) + 1e-9) > np.floor(np.cumsum(share) - share + 1e-9)]] = True
    return wanted


def concatenate_channels(channels: Sequence[Channel]) -> Channel:
    """Concatenate channels: patches stay separate, clusters are common."""
    offsets = np.cumsum([0] + [channel.cells for channel in channels])
    own, common = ("cell", "full"), ("value", "log_e", "block", "cluster", "full_e", "full_cluster", "row", "full_row")
    parts = {name: np.concatenate([getattr(channel, name) for channel in channels]) for name in common}
    for name in own:
        parts[name] = np.concatenate([getattr(channel, name) + o for channel, o in zip(channels, offsets, strict=False)])
    return Channel(**parts, stops=max(channel.stops for channel in channels), saturation=channels[0].saturation)
