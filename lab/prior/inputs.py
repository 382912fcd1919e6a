"""Inputs of the network for a generated capture, computed by the functions of the product, and crops of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.priors.features import CHANNELS, ViewArrays, features, gather
from lab.prior.captures import Capture
from workflow.priors.views import CaptureViews

EDGE = 128
"""Pixels along a crop."""
_SEEN, _CLIPPED = 0.2, 0.7
_STREAM = 0x63726F70


@dataclass(frozen=True)
class Crops:
    """Crops of one room, n of them.

    Attributes:
        inputs: (n, C, 128, 128) float16 in the order of CHANNELS.
        truth: (n, 5, 128, 128) float16: linear albedo, perceptual roughness, metallic.
        counts: (n, 128, 128) bool: pixels with truth and inputs.
        group: (n, 128, 128) uint8 object or piece, numbered in each crop; 255 = all that are beyond.
        view: (n,) int16, in which view it lies.
    """

    inputs: np.ndarray
    truth: np.ndarray
    counts: np.ndarray
    group: np.ndarray
    view: np.ndarray

    def __len__(self) -> int:
        return len(self.inputs)


def views_of(capture: Capture) -> list[ViewArrays]:
    """Return what the product reads of a capture, with given objects or pieces of the mesh; all views stay in memory."""
    views = CaptureViews(capture, capture.given)  # type: ignore[arg-type]  # Capture offers what CaptureReader does
    return [views[i] for i in range(len(views))]


def all_inputs(capture: Capture, seed: int = 0) -> np.ndarray:
    """Compute the inputs (V, C, H, W) float32 of all views."""
    views = views_of(capture)
    gathered = gather(views, capture.tracer, seed=seed)
    return np.stack([features(gathered, views, i) for i in range(len(views))])


def crops(capture: Capture, seed: int, edge: int = EDGE) -> Crops:
    """Compute the inputs of a capture and cut crops at random places: one per view, two where views are 192 pixels wide.

    Args:
        capture: with views of at least `edge` pixels.
        seed: of the rays and of the places.
        edge: pixels along a crop.

    Returns:
        Crops that show enough surface and are not mostly saturated; there may be none.
    """
    rng = np.random.default_rng([seed, _STREAM])
    views = views_of(capture)
    gathered = gather(views, capture.tracer, seed=seed)
    out: list[tuple] = []
    for number, view in enumerate(views):
        inputs, truth = features(gathered, views, number), capture.truth.stacked(number)
        counts = capture.truth.valid[number] & (view.depth > 0)
        size = view.depth.shape[0]
        for _ in range(2 if size >= 1.5 * edge else 1):
            top, left = rng.integers(0, size - edge + 1, 2)
            at = np.s_[top : top + edge, left : left + edge]
            if counts[at].mean() < _SEEN or view.saturated[at].mean() > _CLIPPED:
                continue
            group = np.unique(view.group[at], return_inverse=True)[1].reshape(edge, edge)
            whole = (slice(None), *at)
            out.append(
                (inputs[whole].astype(np.float16), truth[whole], counts[at], np.minimum(group, 255).astype(np.uint8), number)
            )
    if not out:
        none = np.zeros((0, edge, edge))
        return Crops(
            np.zeros((0, len(CHANNELS), edge, edge), np.float16), np.zeros((0, 5, edge, edge), np.float16), none > 0, *[none] * 2
        )
    x, t, m, g, v = zip(*out, strict=True)
    return Crops(np.stack(x), np.stack(t), np.stack(m), np.stack(g), np.array(v, np.int16))
