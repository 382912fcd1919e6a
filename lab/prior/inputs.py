"""Inputs of the network for a generated capture, computed by the functions of the product, and crops of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from iif_core.camera.pixels import ViewMaps
from iif_core.priors.features import CHANNELS, Gathering, features, gather_again, gather_views
from lab.prior.captures import Capture
from workflow.priors.views import CaptureViews
from workflow.scene.normal_form import CaptureReader

EDGE = 128
"""Pixels along a crop."""
_SEEN, _CLIPPED = 0.2, 0.7
TWICE = 0.7
"""Share of the captures whose light is gathered twice, as the product does for its second prediction."""
KNOWN_ERROR = (0.1, 0.2, 0.05)
"""Standard deviations of log albedo in a first prediction: of a capture, of an object, of a channel of an object."""
AlbedoOf = Callable[[Gathering, int], np.ndarray]
_STREAM, _LIGHT_STREAM = 0x63726F70, 0x6C69


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


class Views(list[ViewMaps]):
    """All views of a capture in memory, with the response that the product estimates.

    Args:
        capture: generated, or of the product.
        given: whether the objects of the capture may be read; otherwise pieces of the mesh take their place.
    """

    def __init__(self, capture: Capture | CaptureReader, given: bool):
        own = CaptureViews(capture, given)  # type: ignore[arg-type]  # Capture offers what CaptureReader does
        self.response = own.calibrate()
        super().__init__(own[i] for i in range(len(own)))
        self.cameras, self.trace = own.views, own.tracer()

    def gather(self, albedo_of: AlbedoOf | None, every: int = 1, seed: int = 0) -> Gathering:
        """Gather the light; with `albedo_of` twice, the second time with the mean albedo of each object.

        Args:
            albedo_of: gives the albedo (H, W, 3) of a view by its number, once the light has been gathered; NaN = not known.
            every: it is asked for every view of so many.
            seed: of the rays.
        """
        first = gather_views(self, self.trace, seed=seed)
        if albedo_of is None:
            return first
        total, count = np.zeros((len(first.group), 3)), np.zeros(len(first.group))
        for i in range(0, len(self), every):
            albedo = albedo_of(first, i)
            use = self[i].valid & ~self[i].saturated & np.isfinite(albedo).all(-1)
            row = np.searchsorted(first.group, self[i].object_id[use])
            count += np.bincount(row, minlength=len(count))
            total += np.stack([np.bincount(row, np.log(np.maximum(a, 0.01)), len(count)) for a in albedo[use].T], 1)
        with np.errstate(invalid="ignore"):
            return gather_again(first, self, total / count[:, None])


def _known_albedo(capture: Capture, rng: np.random.Generator) -> AlbedoOf:
    """Albedo as a first prediction would have it: the truth, with wrong levels of capture, objects and their channels."""
    level = rng.normal(0, KNOWN_ERROR[0])
    size = max(int(capture.instance.max()), 0) + 1
    own = np.exp(level + rng.normal(0, KNOWN_ERROR[1], (size, 1)) + rng.normal(0, KNOWN_ERROR[2], (size, 3)))

    def albedo(gathering: Gathering, i: int) -> np.ndarray:
        face = capture.gbuffer(capture.used[i])[1]
        counts = capture.truth.valid[i] & (face >= 0)
        factor = own[np.maximum(capture.instance[np.maximum(face, 0)], 0)]
        return np.where(counts[..., None], capture.truth.albedo[i] * factor, np.nan)

    return albedo


def gathered(capture: Capture, seed: int) -> tuple[Views, Gathering]:
    """Read the views of a generated capture and gather their light, once or twice as the seed has it."""
    rng = np.random.default_rng([seed, _LIGHT_STREAM])
    views = Views(capture, capture.given)
    return views, views.gather(_known_albedo(capture, rng) if rng.random() < TWICE else None, seed=seed)


def all_inputs(capture: Capture, seed: int = 0) -> np.ndarray:
    """Compute the inputs (V, C, H, W) float32 of all views, as `crops` does."""
    views, gathering = gathered(capture, seed)
    return np.stack([features(gathering, views, i) for i in range(len(views))])


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
    views, gathering = gathered(capture, seed)
    out: list[tuple] = []
    for number, view in enumerate(views):
        inputs, truth = features(gathering, views, number), capture.truth.stacked(number)
        counts = capture.truth.valid[number] & (view.depth > 0)
        size = view.depth.shape[0]
        for _ in range(2 if size >= 1.5 * edge else 1):
            top, left = rng.integers(0, size - edge + 1, 2)
            at = np.s_[top : top + edge, left : left + edge]
            if counts[at].mean() < _SEEN or view.saturated[at].mean() > _CLIPPED:
                continue
            group = np.unique(view.object_id[at], return_inverse=True)[1].reshape(edge, edge)
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
