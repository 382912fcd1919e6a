"""Albedo of prior `retinex` against what it must beat, on captures with truth. A measurement, not a test.

    .venv/bin/python lab/benchmarks/retinex.py results/kitchen/capture results/country-kitchen/capture ...

Scaled PSNR (one gain per image and channel) of albedo, mean over views: of the photograph's sensor values, of the photograph
made linear, of a grey world (every pixel the mean colour: after the gain, the best single colour), of the mean of the K
hypotheses' scores, of the best and the worst hypothesis; and `shading left`: correlation, inside objects, of log albedo with
the log of true diffuse light (photographed radiance / true albedo).
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
SETTINGS = SimpleNamespace(prior=SimpleNamespace(samples=8, mean_albedo=0.4), source=SimpleNamespace())


def table(folder: Path, every: int) -> dict[str, tuple[float, float]]:
    from iif_core.evaluation import metrics
    from iif_core.evaluation.consistency import ShadingLeft
    from tests.oracles import scores as single
    from workflow.artifacts.store import StageReader
    from workflow.priors.retinex import GAMMA, _scene, predict
    from workflow.scene.normal_form import CaptureReader

    capture = CaptureReader(StageReader(folder, "capture", folder.parent.name))
    group = _scene(capture, 0.4, 0).group
    scores: dict[str, list[float]] = {}
    left: dict[str, ShadingLeft] = {}
    for view in capture.views[::every]:
        truth, (photo, valid), (_, face) = capture.truth(view), capture.photo(view), capture.gbuffer(view)
        mask = metrics.material_masks(truth.valid, face >= 0, truth.emission, truth.roughness)["albedo"] & valid
        linear = photo if capture.is_hdr else np.clip(photo, 0, 1) ** GAMMA
        predictions = predict(view, SETTINGS, capture, 0)[..., :3]
        albedos = {"photograph": photo, "linear photograph": linear, "grey world": np.full_like(photo, 0.5)}
        albedos |= {f"retinex {k}": albedo for k, albedo in enumerate(predictions)}
        light = truth.radiance / np.maximum(truth.albedo, 0.02)
        for name, albedo in albedos.items():
            scaled = single.scaled(albedo, truth.albedo, mask)
            scores.setdefault(name, []).append(single.psnr(scaled, truth.albedo, mask))
            left.setdefault(name, ShadingLeft()).add(albedo[mask], light[mask], group[face[mask]])
    return {name: (float(np.mean(values)), left[name].finish().correlation) for name, values in scores.items()}


def main(folders: list[str]) -> None:
    print("| scene | what | scaled PSNR | shading left | CPU s |\n|---|---|---|---|---|")
    for folder in folders:
        started = time.process_time()
        rows = table(Path(folder), 2)
        spent = time.process_time() - started
        own = np.array([value for name, value in rows.items() if name.startswith("retinex")])
        rows = {name: value for name, value in rows.items() if not name.startswith("retinex")}
        rows["retinex, mean of 8"] = tuple(own.mean(0))
        rows["retinex, worst"], rows["retinex, best"] = tuple(own[own[:, 0].argmin()]), tuple(own[own[:, 0].argmax()])
        for name, (score, shading) in rows.items():
            print(f"| {Path(folder).parent.name} | {name} | {score:.2f} | {shading:.3f} | {spent:.0f} |", flush=True)


if __name__ == "__main__":
    from workflow.runtime import native

    native.prepare()
    native.limit_threads(1)
    main(sys.argv[1:])
