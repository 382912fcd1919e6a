"""Registration of photographs with a mesh: small corrections of poses and common intrinsics, and the sharpness of each view.

Cameras are aligned (`alignment`) with each other and with the mesh: first what all of them share, then each camera beside the
others, tightly first, at last each freely. What held-out surface does not confirm is undone (Eq. C.32).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, stdtrit

from iif_core.camera.alignment import (
    BLURS,
    Cameras,
    Maps,
    Photo,
    Rows,
    apart,
    camera_points,
    descend,
    edge_points,
    feature_image,
    feature_values,
    free,
    held_out_blocks,
    overlap,
    project,
    residuals,
    surface_points,
    together,
)
from iif_core.camera.exposure import estimate_gains
from iif_core.errors import InputError

SURE, SURE_ALIKE = 4.0, 5.0
"""Standard errors of both measures together by which held-out surface must be better: with corrections of single views, and with
what all share. The errors of the mesh, which all views share, are not in them. Of right poses, the first reach 4.3, which moves
two rooms of sixteen by a tenth of a pixel and is allowed to, and the second 4.8, which would move them by half a pixel."""
BETTER = 2.0
"""Standard errors by which views that move less tightly must be better than the tighter ones that were accepted."""
WORSE = 3.0
"""Standard errors of its own by which neither measure may be worse."""
WIDTHS = 0.03, 0.1, 0.3
"""Standard deviations, in units of `SIGMA_ROTATION` and `SIGMA_TRANSLATION`, of the steps by which views may move beside each
other, one after the other. Views are known to about a pixel, so a prior much wider than their errors adds noise to good poses,
and a narrow one cannot mend bad ones."""
SHARED_EVERY = 4
"""What all cameras share, nine numbers, is found from one in so many points."""
MIN_VIEWS = 6
MIN_ROWS = 40
"""Number of points that a view must share with others before its quality is judged."""


@dataclass(frozen=True)
class Registration:
    """Result of `register`.

    Attributes:
        pose: (V, 4, 4); principal: (2,) shift of the principal point in units of the focal length; focal: factor.
        moved: (V,) median motion of the pixels of a view, in pixels of the given photographs.
        held_out: (before, after) robust spread of feature values on held-out surface.
        gain, error: mean decrease of the held-out loss per row and its standard error over views.
        edges: (before, after) mean photograph edge at held-out edges of the mesh.
        edge_gain, edge_error: its increase and the standard error over views.
        rows: (point, view) pairs compared.
        evidence: what held-out surface says, in standard errors (`combined`), for the correction of single views against what all
            share, or for what all share against the given cameras if single views stay.
        needed: what it has to exceed.
        accepted: whether a correction satisfies Eq. C.32; if none does, the other numbers are of the one with most evidence.
        each: whether the poses of single views are corrected beside those of the others, and not only all alike.
        sharpness: (V,) gradient of the texture relative to the other views; 1 = typical, 0 = not compared, as all that are held.
        agreement: (V,) correlation of features with the mean of the other views, after registration; 0 = not compared.
        shift: (V,) remaining translation against the texture of the other views, in pixels (Eq. C.33).

    All but `pose` and `moved` is of the photographs that are not held.
    """

    pose: np.ndarray
    principal: np.ndarray
    focal: float
    moved: np.ndarray
    held_out: tuple[float, float]
    gain: float
    error: float
    edges: tuple[float, float]
    edge_gain: float
    edge_error: float
    rows: int
    evidence: float
    needed: float
    accepted: bool
    each: bool
    sharpness: np.ndarray
    agreement: np.ndarray
    shift: np.ndarray


def register(photos: Sequence[Photo], points: int = 12_000, intrinsics: bool = True, poses: bool = True) -> Registration:
    """Correct poses and common intrinsics so that the photographs fit the mesh and each other.

    Args:
        photos: at least one.
        points: number of surface points that are compared, over all views.
        intrinsics: correct focal length and principal point, by the same relative amount in all views.
        poses: correct each pose.

    Returns:
        Corrected cameras, whether they are accepted, and the quality of each view.

    Raises:
        InputError: no photograph.
    """
    if not photos:
        raise InputError("registration: no photograph given; at least one is needed")

    # -------- features, shared surface points, edges of the mesh --------
    # Blocks of surface are held out from both kinds of rows: they decide after each step.
    start = Cameras.of(photos)
    features = [feature_image(p.image, p.usable) for p in photos]
    rows = overlap(photos, features, points)
    edges = [edge_points(p) for p in photos]
    held = [held_out_blocks(world) for world in edges]
    fit = rows.take(~rows.held_out)
    seen = [world[~h] for world, h in zip(edges, held, strict=True)]

    # -------- judges: held-out surface, in what photographs show that are not held --------
    moving = np.array([not p.held for p in photos])
    rows = rows.take(moving[rows.view])
    judged = rows.take(rows.held_out), [world[h & own] for world, h, own in zip(edges, held, moving, strict=True)]
    maps = [Maps.of(f, BLURS[-1]) for f in features]

    # -------- Gauss-Newton: all cameras alike, then each beside the others, less and less tightly, then each freely --------
    few = fit.take(fit.point % SHARED_EVERY == 0), [world[::SHARED_EVERY] for world in seen]
    stages = [(BLURS, few, together(len(photos), poses, intrinsics), SURE_ALIKE, SURE_ALIKE)]
    if poses:
        stages += [(BLURS[1:], (fit, seen), apart(moving, width), SURE, BETTER) for width in WIDTHS]
        # Free views come from so far away that a wide blur is needed; they bring back the mean motion, which takes more evidence.
        stages += [(BLURS, (fit, seen), free(len(photos), intrinsics), SURE, SURE)]
    alike = final = shown = start  # what all share, with single views moved, and what the numbers are of
    evidence, needed = 0.0, SURE_ALIKE
    for number, (blurs, data, unknowns, sure, better) in enumerate(stages):
        state = descend(photos, features, blurs, final, *data, unknowns)
        against = _compare(photos, maps, (alike, state), *judged)
        # Single views must surely beat what all share, and what was accepted of them.
        pays = against.pays(sure) and (final is alike or _compare(photos, maps, (final, state), *judged).pays(better))
        if pays:
            final, alike = state, alike if number else state
        if pays or (final is start and (shown is start or against.evidence / sure > evidence / needed)):
            shown, evidence, needed = state, against.evidence, sure
    found = _compare(photos, maps, (start, shown), *judged)
    return Registration(
        shown.pose,
        shown.principal,
        shown.focal,
        np.array([_motion(photos, start, shown, v) for v in range(len(photos))]),
        found.spread,
        found.texture.mean,
        found.texture.error,
        found.edges,
        found.edge.mean,
        found.edge.error,
        len(rows.view),
        evidence,
        needed,
        final is not start,
        final is not alike,
        *_quality(photos, maps, final, rows),
    )


@dataclass(frozen=True)
class Gain:
    """The mean gain of many rows, and how well it is known if the rows of a view are correlated.

    Attributes:
        mean: over the rows; error: its standard error, infinite if fewer than MIN_VIEWS views have rows.
        away: (V,) what each view adds to the error: the root of the sum of its squares is the error.
        views: number of views that have rows.
    """

    mean: float
    error: float
    away: np.ndarray
    views: int

    @classmethod
    def of(cls, gain: np.ndarray, view: np.ndarray, views: int) -> Gain:
        """Return the mean of the gains (n,) of rows, which belong to views (n,) of so many."""
        total, count = np.bincount(view, gain, views), np.bincount(view, minlength=views)
        seen = int((count > 0).sum())
        if seen < MIN_VIEWS:
            return cls(float(gain.mean()) if len(gain) else 0.0, np.inf, np.zeros(views), seen)
        # Deviations of the sums over views, with the correction for a small number of views.
        mean = total.sum() / count.sum()
        away = (total - mean * count) * np.sqrt(seen / (seen - 1)) / count.sum()
        return cls(float(mean), float(np.linalg.norm(away)), away, seen)


def combined(gains: Sequence[Gain]) -> float:
    """Combine gains into one number of standard errors: the sum of each in its own, over the standard error of that sum, which
    contains how the gains go together over views. A gain of infinite error counts for nothing.

    Where Student's t exceeds SURE as often as a normal variable exceeds 3, with ten views or fewer, it is less by that ratio.
    """
    known = [gain for gain in gains if gain.error < np.inf]
    if not known:
        return 0.0
    sizes = [max(gain.error, 1e-12) for gain in known]
    error = np.linalg.norm(sum(gain.away / size for gain, size in zip(known, sizes, strict=True)))
    z = sum(gain.mean / size for gain, size in zip(known, sizes, strict=True)) / max(error, 1e-6)
    return float(z * min(1.0, SURE / stdtrit(min(gain.views for gain in known) - 1, ndtr(3.0))))


@dataclass(frozen=True)
class _Comparison:
    """Two states of the cameras on held-out surface: (before, after) spread of features and photograph edge at mesh edges, and
    what the second gains in each."""

    spread: tuple[float, float]
    texture: Gain
    edges: tuple[float, float]
    edge: Gain

    @property
    def evidence(self) -> float:
        return combined([self.texture, self.edge])

    def pays(self, sure: float) -> bool:
        """The second is better by both measures together, by more than `sure`, and much worse by neither (Eq. C.32)."""
        return self.evidence > sure and all(gain.mean >= -WORSE * gain.error for gain in (self.texture, self.edge))


def _compare(
    photos: Sequence[Photo],
    maps: Sequence[Maps],
    states: tuple[Cameras, Cameras],
    rows: Rows,
    edges: Sequence[np.ndarray],
) -> _Comparison:
    return _Comparison(*_compare_features(photos, maps, states, rows), *_compare_edges(photos, maps, states, edges))


def _compare_features(
    photos: Sequence[Photo], maps: Sequence[Maps], states: Sequence[Cameras], rows: Rows
) -> tuple[tuple[float, float], Gain]:
    """Robust spread of the features under two states; decrease of Cauchy's loss."""
    residual = [residuals(photos, maps, state, rows) for state in states]
    if not len(rows.view):
        return (0.0, 0.0), Gain.of(np.zeros(0), rows.view, len(photos))
    spread = [float(1.4826 * np.median(np.abs(r))) for r in residual]
    # One width for both states, or the better one would be judged by a narrower loss.
    width = max(2.385 * spread[0], 1e-6)
    loss = np.log1p((residual[0] / width) ** 2) - np.log1p((residual[1] / width) ** 2)
    return (spread[0], spread[1]), Gain.of(loss, rows.view, len(photos))


def _compare_edges(
    photos: Sequence[Photo], maps: Sequence[Maps], states: Sequence[Cameras], edges: Sequence[np.ndarray]
) -> tuple[tuple[float, float], Gain]:
    """Mean photograph edge at mesh edges under two states; its increase."""
    view = np.repeat(np.arange(len(photos)), [len(world) for world in edges])
    if not len(view):
        return (0.0, 0.0), Gain.of(np.zeros(0), view, len(photos))
    value = [
        np.concatenate(
            [
                m.at(("edge",), project(photo, state, camera_points(state, v, world)))[0]
                for v, (photo, m, world) in enumerate(zip(photos, maps, edges, strict=True))
            ]
        )
        for state in states
    ]
    return (float(value[0].mean()), float(value[1].mean())), Gain.of(value[1] - value[0], view, len(photos))


def _quality(
    photos: Sequence[Photo], maps: Sequence[Maps], state: Cameras, rows: Rows
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sharpness, agreement and remaining shift of each view, relative to the other views of the same surface."""
    views = len(photos)
    agreement, shift = np.zeros(views), np.zeros(views)
    value, du, dv = feature_values(photos, maps, state, rows, ("value", "du", "dv"))
    # Mean of the other views: a view must not agree with itself.
    total, count = np.bincount(rows.point, value), np.bincount(rows.point)
    others = (total[rows.point] - value) / np.maximum(count[rows.point] - 1, 1)
    metres = np.zeros(len(value))
    for v, photo in enumerate(photos):
        own = np.flatnonzero(rows.view == v)
        if len(own) < MIN_ROWS:
            continue
        # Footprint of a pixel, in metres across the line of sight.
        metres[own] = np.maximum(camera_points(state, v, rows.world[own])[:, 2], 1e-6) / photo.focal[0]
        a, b = value[own] - value[own].mean(), others[own] - others[own].mean()
        agreement[v] = float((a * b).sum() / max(np.sqrt((a**2).sum() * (b**2).sum()), 1e-12))
        slope, gap = np.stack([du[own], dv[own]], -1), value[own] - others[own]
        robust = 1.0 / (1.0 + (gap / max(3.5 * np.median(np.abs(gap)), 1e-6)) ** 2)
        # Two unknowns, the shift in u and v (Eq. C.33). The ridge serves views without any gradient.
        normal = slope.T @ (robust[:, None] * slope) + 1e-9 * np.eye(2)
        shift[v] = float(np.hypot(*np.linalg.solve(normal, slope.T @ (robust * gap))))
    seen = metres > 0
    # Gradients are per metre of surface, because a distant view shows the same texture steeper per pixel.
    steep = np.hypot(du[seen], dv[seen]) / metres[seen]
    gains = estimate_gains(rows.point[seen], rows.view[seen], steep, views)
    typical = np.median(gains.gain[gains.estimated]) if gains.estimated.any() else 1.0
    return np.where(gains.estimated, gains.gain / typical, 0.0), agreement, shift


def _motion(photos: Sequence[Photo], before: Cameras, after: Cameras, v: int) -> float:
    index = np.flatnonzero(photos[v].depth > 0)[::97]
    if not len(index):
        return 0.0
    world = surface_points(photos[v], index)
    a, b = (project(photos[v], s, camera_points(s, v, world)) for s in (before, after))
    return float(np.median(np.hypot(*(b - a).T)))
