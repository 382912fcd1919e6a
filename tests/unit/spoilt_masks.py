"""Object ids of a view -> masks as a 2D tool makes them: some cut in two, some grown together with a neighbour."""

import numpy as np


def spoil_masks(ids, rng, split=0.25, merge=0.3):
    """(H, W) int32 masks, 0 = none, of true ids (H, W), -1 = none.

    Every mask is swallowed by a random neighbour in the picture with probability `merge` (so that up to twice that share of
    the things is in a mask that holds several); of the others a share `split` / (1 - `merge`) is cut by a random line through
    its middle.
    """
    known, labels = np.unique(ids, return_inverse=True)
    labels = labels.reshape(ids.shape) + (0 if known[0] < 0 else 1)
    count = int(labels.max())
    ends = [(labels[:, 1:], labels[:, :-1]), (labels[1:], labels[:-1])]
    pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in ends])
    pairs = np.unique(np.sort(pairs[(pairs[:, 0] != pairs[:, 1]) & (pairs > 0).all(1)], 1), axis=0)
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    fate, owner = rng.random(count + 1), np.arange(count + 1)
    for i in np.flatnonzero(fate[1:] < merge) + 1:
        neighbours = pairs[pairs[:, 0] == i, 1]
        if len(neighbours):
            owner[i] = rng.choice(neighbours)
    out, fresh = owner[labels], count + 1
    for i in np.flatnonzero((fate[1:] >= merge) & (fate[1:] < merge + split)) + 1:
        row, column = np.nonzero(out == i)
        if len(row) > 1:
            angle = rng.uniform(0, np.pi)
            side = np.cos(angle) * (column - np.median(column)) + np.sin(angle) * (row - np.median(row)) > 0
            out[row[side], column[side]] = fresh
            fresh += 1
    return out.astype(np.int32)


def purity(found, true, weight=None):
    """(share of elements whose true label is the most frequent one of their found label, the same with the roles turned)."""
    from scipy.sparse import coo_matrix

    found, true = (np.unique(labels, return_inverse=True)[1] for labels in (found, true))
    weight = np.ones(len(found)) if weight is None else weight
    table = coo_matrix((weight.astype(float), (found, true))).tocsr()
    return tuple(float(table.max(axis).sum() / table.sum()) for axis in (1, 0))
