"""The network of prior `learned` at work on a capture (docs/method/priors.md#learned)."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.parallel import map_in_order
from iif_core.priors.features import CHANNELS, features, gather_again, gather_views, mirrored, with_computed_light
from iif_core.priors.hypotheses import combined
from iif_core.priors.upsampling import enlarged
from workflow.models import prior_weights
from workflow.priors import Keep, LightOf, Predicted
from workflow.priors.views import CaptureViews
from workflow.scene.normal_form import CaptureReader, View

EVERY = 3
"""Of so many views, one is predicted first, to know the light better."""
WORKING_SIDE = 240
"""Longest side in pixels near which the network works: it was trained on pictures of 128 to 192 pixels."""


def load(device: str) -> tuple[dict[str, Any], Any, Any]:
    """Return recipe, network and torch device; raises InputError."""
    from safetensors.torch import load_file

    from workflow.models.checkpoint import Origin
    from workflow.models.loading import named_device
    from workflow.priors.network import PriorNetwork

    _, weights = prior_weights.checked_files()
    recipe = prior_weights.recipe()
    if tuple(recipe["channels"]) != CHANNELS:
        path = prior_weights.FOLDER / prior_weights.RECIPE
        raise InputError(f"{path}: the weights are for other inputs than `iif_core.priors.features` computes; train them again")
    network = PriorNetwork(len(CHANNELS), recipe["widths"], recipe["heads"])
    network.load_state_dict({name: array.float() for name, array in load_file(weights).items()})
    where = named_device(device, Origin(repository="this repository", licence="MIT"))
    return recipe, network.to(where).eval().requires_grad_(False), where


class Correction:
    """The network, and what it needs of all photographs of a capture."""

    concurrent = True

    def __init__(
        self,
        settings: SimpleNamespace,
        capture: CaptureReader,
        seed: int,
        keep: Keep,
        threads: int = 1,
        light: LightOf | None = None,
    ):
        own = settings.prior
        longest = max((max(view.width, view.height) for view in capture.used), default=WORKING_SIDE)
        self.factor = max(1, round(longest / WORKING_SIDE))
        self.samples = own.samples
        self.recipe, self.network, self.device = load(own.device)
        given = settings.segmentation.kind == "given"
        self.views = CaptureViews(capture, given, self.factor)
        self.views.calibrate()
        self.gathering = gather_views(self.views, self.views.tracer(), seed=seed, keep=keep, threads=threads)
        self.gathering = gather_again(self.gathering, self.views, self._albedo_of_objects(threads))
        if light is not None:
            computed = (self.views.shrunk(light(view)) for view in self.views.views)
            self.gathering = with_computed_light(self.gathering, self.views, computed)

    def __call__(self, view: View) -> Predicted:
        """Make K predictions of a view."""
        small = self.views.of(view)
        inputs = features(self.gathering, self.views, self.views.number[view.view_id])
        heads = self._heads(inputs)
        if self.samples > len(heads):  # the mirrored picture gives as many again
            heads = np.concatenate([heads, self._heads(mirrored(inputs))[:, :, ::-1]])
        made = combined(heads, self.samples, calibration=tuple(self.recipe["scale_calibration"]))
        if self.factor == 1:
            return Predicted(made.maps, made.scale)
        full = self.views.full(view)
        return Predicted(*enlarged(made.maps, made.scale, small, full, self.factor))

    def _albedo_of_objects(self, threads: int) -> np.ndarray:
        """(G, 3) mean log albedo of each object in a first prediction of every third view; NaN where these show nothing of it."""
        group = self.gathering.group
        total, count = np.zeros((len(group), 3)), np.zeros(len(group))
        first = range(0, len(self.views), EVERY)

        def albedo_of(number: int) -> np.ndarray:
            return combined(self._heads(features(self.gathering, self.views, first[number])), 1).maps[0, ..., :3]

        for i, albedo in zip(first, map_in_order(albedo_of, len(first), threads), strict=True):
            view = self.views[i]
            use = view.valid & ~view.saturated
            row = np.searchsorted(group, view.object_id[use])
            count += np.bincount(row, minlength=len(group))
            for c in range(3):
                total[:, c] += np.bincount(row, np.log(albedo[use][:, c]), len(group))
        with np.errstate(invalid="ignore"):
            return total / count[:, None]

    def _heads(self, inputs: np.ndarray) -> np.ndarray:
        """(M, H, W, 8) of the network."""
        import torch

        from workflow.models.loading import deterministic

        with deterministic(self.device):
            out = self.network(torch.from_numpy(np.ascontiguousarray(inputs))[None].to(self.device))[0]
        return out.permute(0, 2, 3, 1).cpu().numpy()
