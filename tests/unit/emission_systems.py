"""Linear systems of emission made by hand."""

import numpy as np

from iif_core.light.emission.rows import EmissionRows, TracedTransport


def rows_of(*lobes, observed, cached=(0.0, 0.0), weight=None, bound=None):
    """Rows of one or two lobes, each (n, G, 3) or a pair of such arrays, one for each trace; `cached`: of each lobe, (n, 3) or a
    pair."""
    observed = np.asarray(observed, float)
    matrix = np.stack([_traces(lobe) for lobe in lobes], 1).astype(np.float32)
    light = [_traces(h, observed.shape) for h, _ in zip(cached, lobes, strict=False)]
    weight = np.ones(observed.shape) if weight is None else weight
    bound = np.zeros(observed.shape, bool) if bound is None else bound
    return EmissionRows(matrix, observed, np.stack(light, 1), weight, bound)


def transport_of(matrix, cached=0.0):
    """Transport of one lobe; both arguments of both traces alike, or pairs."""
    matrix = _traces(matrix)
    return TracedTransport(matrix[:, None], _traces(cached, (matrix.shape[1], 3))[:, None])


def _traces(values, shape=None):
    """Both traces of a pair, or twice the same, broadcast to `shape`."""
    pair = values if isinstance(values, tuple) else (values, values)
    return np.stack([value if shape is None else np.broadcast_to(value, shape) for value in pair])
