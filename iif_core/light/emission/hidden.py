"""Objects that no camera sees and that may be lamps (docs/method/light.md#lamps-that-no-camera-sees)."""

from __future__ import annotations

import numpy as np

from iif_core.light.emission.groups import EmitterGroups

MIN_HITS = 4
"""Rays from visible surface that must meet an object before it is asked whether it shines."""
MAX_HIDDEN = 64
"""Largest number of objects that are asked; those that most rays meet."""


def with_hidden_surface(
    groups: EmitterGroups,
    seen: np.ndarray,
    object_id: np.ndarray,
    areas: np.ndarray,
    hits: np.ndarray,
) -> EmitterGroups:
    """Append objects that no camera sees, one group each.

    A lamp is usually a separate object. The unseen parts of an object that cameras see are therefore left out: they would explain
    light that the model lacks for other reasons.

    Only what lights the surface that cameras see matters, so that objects which few rays from there meet are left out.

    Args:
        groups: of what cameras see, on F faces.
        seen: (F,) bool, pixels show the face, and enough to say whether it shines.
        object_id: (F,), -1 = none.
        areas: (F,) m^2.
        hits: (F,) cosine-distributed rays from visible surface that meet each face.

    Returns:
        The groups. Those that were appended shine to both sides and have `count` 0.
    """
    known = np.zeros(int(object_id.max(initial=-1)) + 2, bool)  # the last entry is read by faces without an object, -1
    known[object_id[seen | (groups.of_face >= 0)]] = True
    face = np.flatnonzero(~known[object_id] & (object_id >= 0) & (areas > 1e-12))
    if not len(face):
        return groups
    label = np.unique(object_id[face], return_inverse=True)[1]
    met = np.bincount(label, hits[face])
    order = np.argsort(-met, kind="stable")
    chosen = order[met[order] >= MIN_HITS][:MAX_HIDDEN]
    number = np.full(len(met), -1, np.int64)
    number[chosen] = groups.size + np.arange(len(chosen))
    of_face = groups.of_face.copy()
    of_face[face] = number[label]
    return EmitterGroups(
        of_face,
        groups.side,
        np.r_[groups.faces, np.bincount(label)[chosen]].astype(np.int32),
        np.r_[groups.area, np.bincount(label, areas[face])[chosen]],
        np.concatenate([groups.observed, np.zeros((len(chosen), 3))]),
        np.r_[groups.count, np.zeros(len(chosen), np.int64)],
        groups.dropped,
    )
