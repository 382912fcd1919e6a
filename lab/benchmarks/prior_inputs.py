"""Which inputs does the learned prior use? Predictions with some inputs withheld, scored against the truth.

    python -m lab.benchmarks.prior_inputs results/kitchen/capture results/country-kitchen/capture [--every 3]

A group of inputs is withheld by the mean of each of its channels over the pixels of the room. The network was trained with all of
them, so a loss says how much it relies on a group, and not what a network would reach that was trained without it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from iif_core.evaluation.metrics import Target, material_masks
from iif_core.priors.features import CHANNELS, features
from iif_core.priors.hypotheses import combined
from workflow.artifacts.store import StageReader
from workflow.priors.correction import Correction
from workflow.runtime import native
from workflow.scene.normal_form import CaptureReader

SETTINGS = SimpleNamespace(prior=SimpleNamespace(samples=8, device="cpu"), segmentation=SimpleNamespace(kind="geometry"))
WITHHELD = {
    "nothing": (),
    "light": ("y_", "dy_", "g_r", "g_g", "g_b"),
    "other photographs": ("low_", "mid_", "high", "top", "count"),
    "mirror and gloss": ("m_", "slope", "corr", "rest", "g_slope", "g_corr"),
    "mesh": ("n_", "nov", "depth", "border", "g_"),
    "all but the photograph": (
        "y_",
        "dy_",
        "low_",
        "mid_",
        "high",
        "top",
        "count",
        "m_",
        "slope",
        "corr",
        "rest",
        "n_",
        "nov",
        "depth",
        "border",
        "g_",
    ),
}
"""Beginnings of the names of channels."""


def scores(capture: CaptureReader, view: object, maps: np.ndarray) -> dict[str, float]:
    """Return PSNR of albedo (scaled, raw) and squared errors of roughness and metallic of a view; empty without a truth."""
    truth = capture.truth(view)
    masks = material_masks(truth.valid, capture.gbuffer(view)[1] >= 0, truth.emission, truth.roughness)
    if not masks["albedo"].any():
        return {}
    made = {"albedo": maps[..., :3], "roughness": maps[..., 3], "metallic": maps[..., 4]}
    return {
        f"{name}/{one.metric}/{one.protocol}": one.value
        for name, values in made.items()
        for one in Target(name, getattr(truth, name), masks[name]).scores(values, ("psnr", "l2"))
        if one.value is not None
    }


def measure(folder: Path, every: int) -> dict[str, list[float]]:
    """Return group of inputs -> mean scores over every `every`-th view of a capture."""
    scene = folder.resolve().parent.name
    capture = CaptureReader(StageReader(folder, "capture", scene))
    network = Correction(SETTINGS, capture, 0, lambda array: array, 2)
    inputs = {i: features(network.gathering, network.views, i) for i in range(0, len(network.views), every)}
    mean = np.mean([x.mean((1, 2)) for x in inputs.values()], 0)
    out = {}
    for name, starts in WITHHELD.items():
        gone = np.array([channel.startswith(starts) if starts else False for channel in CHANNELS])
        rows = []
        for i, x in inputs.items():
            changed = np.where(gone[:, None, None], mean[:, None, None], x).astype(np.float32)
            made = combined(network._heads(changed), 8, calibration=tuple(network.recipe["scale_calibration"]))
            rows.append(scores(capture, network.views.views[i], made.maps.mean(0)))
        keys = ("albedo/psnr/scaled", "albedo/psnr/raw", "roughness/l2/raw", "metallic/l2/raw")
        out[name] = [float(np.mean([row[key] for row in rows if key in row])) for key in keys]
    return out


def main() -> int:
    """Print a table of each capture and their mean."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=3)
    options = parser.parse_args()
    native.prepare()  # before anything loads Mitsuba
    every = {}
    for folder in options.captures:
        every[folder] = measure(folder, options.every)
        for name, row in every[folder].items():
            print(f"{folder.resolve().parent.name}: {name}: " + " ".join(f"{value:.3f}" for value in row), flush=True)
    for name in WITHHELD:
        print(f"mean: {name}: " + " ".join(f"{value:.3f}" for value in np.mean([one[name] for one in every.values()], 0)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
