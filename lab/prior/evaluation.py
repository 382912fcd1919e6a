"""Errors and calibration of weights, on generated rooms that were kept back and on captures of the product that have truth.

Predictions are made as the product makes them (`iif_core.priors.hypotheses.combined`) and scored with the masks and metrics of
its evaluation. Coverage is the share of errors inside of the 68 % interval of the stated Laplace scale.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from iif_core.evaluation.metrics import Target, material_masks
from iif_core.priors.features import CHANNELS, Gathering, features
from iif_core.priors.hypotheses import Hypotheses, combined
from iif_core.reflectance.material import PROPERTIES
from lab.prior import captures, network
from lab.prior.captures import Capture
from lab.prior.inputs import Views
from lab.prior.object_errors import ObjectSums
from workflow.priors.network import PriorNetwork
from workflow.scene.normal_form import CaptureReader, View

COVERED = 0.68
WIDTH = float(-np.log(1 - COVERED))
"""Half width of the 68 % interval of a Laplace distribution in scales."""
FIRST_EVERY = 3
"""The first prediction, of which only the mean albedo of objects is used, is made for every view of so many."""
METAL = 0.5  # metallic from which a pixel counts as metal
SHOWN = {
    "albedo up to scale, dB": "albedo/psnr/scaled",
    "albedo, dB": "albedo/psnr/raw",
    "roughness, L2": "roughness/l2/raw",
    "metallic, L2": "metallic/l2/raw",
}
_SAMPLED = 4000  # pixels of a view whose errors are kept for the calibration
_ERRORS = ("albedo", "roughness", "metallic")


@dataclass(frozen=True)
class Weights:
    """A network and its recipe, from a folder that `train` or `export` wrote."""

    model: torch.nn.Module
    recipe: dict[str, Any]
    device: str

    @classmethod
    def load(cls, folder: Path, device: str = "cpu") -> Weights:
        """Read weights.safetensors and recipe.json.

        Raises:
            FileNotFoundError: a file is missing.
            ValueError: weights for other inputs.
        """
        from safetensors.torch import load_file

        recipe = json.loads((folder / "recipe.json").read_text())
        if tuple(recipe["channels"]) != CHANNELS:
            raise ValueError(f"{folder}: weights for other inputs than the product computes now; train them again")
        model = PriorNetwork(len(CHANNELS), recipe["widths"], recipe["heads"])
        network.load_weights(model, load_file(folder / "weights.safetensors"))
        return cls(model.to(device).eval().requires_grad_(False), recipe, device)

    def heads(self, inputs: np.ndarray) -> np.ndarray:
        """Predict (M, H, W, 8) from the inputs (C, H, W) of a view."""
        with torch.no_grad():
            out = self.model(torch.from_numpy(np.ascontiguousarray(inputs))[None].to(self.device))[0]
        return out.permute(0, 2, 3, 1).cpu().numpy()


@dataclass(frozen=True)
class Case:
    """A view with its truth.

    Attributes:
        name: of the view.
        inputs: (C, H, W) of the network.
        photo: (H, W, 3) as it is shown.
        truth: `albedo` (H, W, 3), `roughness` and `metallic` (H, W).
        masks: for each of them the pixels that count, (H, W) bool.
        group: (H, W) object of each pixel.
        retinex: (K, H, W, 5) predictions of prior `retinex`, if they were asked for.
    """

    name: str
    inputs: np.ndarray
    photo: np.ndarray
    truth: dict[str, np.ndarray]
    masks: dict[str, np.ndarray]
    group: np.ndarray
    retinex: np.ndarray | None = None


def cases(
    capture: Capture | CaptureReader, weights: Weights | None, given: bool, most: int = 0, retinex: bool = False, seed: int = 0
) -> Iterator[Case]:
    """Go through the views of a capture with truth.

    Args:
        capture: generated, or of the product.
        weights: of the first prediction, with which the light is gathered again as the product does; None = gather once.
        given: whether the objects of the capture may be read; otherwise pieces of the mesh take their place.
        most: views at most, spread evenly; 0 = all. The light is gathered from all views in any case.
        retinex: whether to make the predictions of prior `retinex` as well.
        seed: of the rays.
    """
    views = Views(capture, given)

    def first(gathering: Gathering, i: int) -> np.ndarray:
        return combined(weights.heads(features(gathering, views, i))[..., :8], 1).maps[0, ..., :3]

    gathering = views.gather(first if weights else None, FIRST_EVERY, seed)
    baseline = _retinex(capture, given, seed) if retinex else None
    chosen = np.unique(np.linspace(0, len(views) - 1, most or len(views)).round().astype(int))
    for number in chosen:
        view = views.cameras[number]
        truth, masks = _truth(capture, view)
        if masks["albedo"].any():
            photo = capture.photo(view)[0]
            inputs, group = features(gathering, views, int(number)), views[number].object_id
            yield Case(
                view.name, inputs, _shown(photo, capture.is_hdr), truth, masks, group, baseline(view) if baseline else None
            )


def _truth(capture: Capture | CaptureReader, view: View) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    hit = capture.gbuffer(view)[1] >= 0
    if isinstance(capture, Capture):
        stacked = capture.truth.stacked(view.view_id).astype(np.float32)
        truth = {"albedo": np.moveaxis(stacked[:3], 0, -1), "roughness": stacked[3], "metallic": stacked[4]}
        masks = material_masks(capture.truth.valid[view.view_id], hit, np.zeros((*hit.shape, 3)), stacked[3])
    else:
        own = capture.truth(view)
        truth = {name: getattr(own, name) for name in _ERRORS}
        masks = material_masks(own.valid, hit, own.emission, own.roughness)
    return truth, {name: masks[name] for name in _ERRORS}


def _retinex(capture: Capture | CaptureReader, given: bool, seed: int) -> Callable[[View], np.ndarray]:
    from workflow.priors import predictor

    own = SimpleNamespace(kind="retinex", samples=8)
    settings = SimpleNamespace(prior=own, segmentation=SimpleNamespace(kind="given" if given else "geometry"))
    predict = predictor(settings, capture, seed, lambda array: array)  # type: ignore[arg-type]
    return lambda view: predict(view).maps


def _shown(photo: np.ndarray, is_hdr: bool) -> np.ndarray:
    return np.clip(photo / max(4 * float(np.median(photo)), 1e-6), 0, 1) ** (1 / 2.2) if is_hdr else photo


@dataclass
class Scores:
    """What was measured, view by view.

    Attributes:
        rows: for each kind of prediction, the scores of each view (keys of SHOWN's values).
        ratios: errors in stated scales, for each of albedo, roughness, metallic.
        metal: numbers of pixels that are metal, that are taken for it, and that are both.
        best: for each head the number of objects that it explains best.
        objects: what is needed for the errors of objects.
    """

    rows: dict[str, list[dict[str, float]]] = field(default_factory=dict)
    ratios: dict[str, list[np.ndarray]] = field(default_factory=lambda: {name: [] for name in _ERRORS})
    metal: np.ndarray = field(default_factory=lambda: np.zeros(3, np.int64))
    best: np.ndarray | None = None
    objects: ObjectSums = field(default_factory=ObjectSums)

    def add(self, case: Case, heads: np.ndarray, calibration: tuple[float, ...]) -> Hypotheses:
        """Score a view; return the network's one answer."""
        plain = heads[..., :8]
        one, all_ = combined(plain, 1, calibration=calibration), combined(plain, len(plain), calibration=calibration)
        self._score("network", case, all_.maps)
        self._score("network, one answer", case, one.maps)
        if case.retinex is not None:
            self._score("retinex", case, case.retinex)
        self._calibrate(case, one)
        counts = case.masks["metallic"]
        true, found = case.truth["metallic"][counts] >= METAL, one.maps[0, ..., 4][counts] >= METAL
        self.metal += (true.sum(), found.sum(), (true & found).sum())
        self._weigh(case, heads)
        truth = np.column_stack([case.truth[name][counts] for name in _ERRORS])
        self.objects.add(case.group[counts], all_.maps.mean(0)[counts], truth)  # what a base of all predictions comes near to
        return one

    def _score(self, kind: str, case: Case, maps: np.ndarray) -> None:
        """Add the mean score of K predictions (K, H, W, 5)."""
        split = {"albedo": maps[..., :3], "roughness": maps[..., 3], "metallic": maps[..., 4]}
        total: dict[str, list[float]] = {}
        for name, values in split.items():
            target = Target(name, case.truth[name], case.masks[name])
            for value in values:
                for score in target.scores(value, ("psnr", "l2")):
                    if score.value is not None:
                        total.setdefault(f"{name}/{score.metric}/{score.protocol}", []).append(score.value)
        self.rows.setdefault(kind, []).append({key: float(np.mean(own)) for key, own in total.items()})

    def _calibrate(self, case: Case, one: Hypotheses) -> None:
        rng = np.random.default_rng(0)
        for i, (name, part) in enumerate(zip(_ERRORS, (np.s_[..., :3], np.s_[..., 3:4], np.s_[..., 4:5]), strict=True)):
            counts = case.masks[name]
            truth = case.truth[name].reshape(*counts.shape, -1)
            ratio = (np.abs(one.maps[0][part] - truth) / one.scale[..., i : i + 1])[counts].ravel()
            self.ratios[name].append(rng.choice(ratio, min(_SAMPLED, len(ratio)), replace=False).astype(np.float32))

    def _weigh(self, case: Case, heads: np.ndarray) -> None:
        """Which head explains each object best in log albedo, roughness and metallic, and what weight it had been given."""
        counts = case.masks["albedo"]
        rows, group = np.unique(case.group[counts], return_inverse=True)
        truth = np.concatenate(
            [np.log(np.maximum(case.truth["albedo"], 0.01)), *(case.truth[n][..., None] for n in _ERRORS[1:])], -1
        )
        error = np.abs(heads[..., :5] - truth).mean(-1)[:, counts]  # (M, n)
        size = np.bincount(group, minlength=len(rows))
        best = np.stack([np.bincount(group, own, len(rows)) / size for own in error]).argmin(0)
        count = np.bincount(best, minlength=len(heads))
        self.best = count if self.best is None else self.best + count

    def report(self) -> dict[str, Any]:
        """Return means over views, coverage, the factors on the scales that would make it 68 %, metal found, and use of heads."""
        out: dict[str, Any] = {"views": len(self.rows.get("network", []))}
        for kind, rows in self.rows.items():
            out[kind] = {label: round(float(np.mean([r[key] for r in rows if key in r])), 4) for label, key in SHOWN.items()}
        ratios = {name: np.concatenate(own) for name, own in self.ratios.items() if own}
        out["coverage"] = {name: round(float((own <= WIDTH).mean()), 4) for name, own in ratios.items()}
        out["scale_factor"] = {name: round(float(np.quantile(own, COVERED) / WIDTH), 4) for name, own in ratios.items()}
        out["mean_ratio"] = {name: round(float(own.mean()), 4) for name, own in ratios.items()}
        true, found, both = (int(n) for n in self.metal)
        out["metal"] = {"pixels": true, "found": round(both / max(true, 1), 4), "precision": round(both / max(found, 1), 4)}
        errors = self.objects.errors()
        if errors is not None:
            out["object_errors"] = errors.facts()
        if self.best is not None:
            out["best_head"] = (self.best / max(self.best.sum(), 1)).round(4).tolist()
        return out


def evaluate(
    weights: Weights, sources: Iterator[Iterator[Case]], pictures: Path | None = None, calibrated: bool = True
) -> dict[str, Any]:
    """Measure weights on captures.

    Args:
        weights: the network.
        sources: for each capture, its cases.
        pictures: where a sheet of the first view of each capture goes.
        calibrated: apply the recipe's `scale_calibration`, if it has one.

    Returns:
        `Scores.report`.
    """
    factors = tuple(weights.recipe.get("scale_calibration", (1.0,) * len(PROPERTIES))) if calibrated else (1.0,) * len(PROPERTIES)
    scores, columns = Scores(), []
    for own in sources:
        scores.objects.begin()
        for number, case in enumerate(own):
            answer = scores.add(case, weights.heads(case.inputs), factors)
            if pictures and number == 0 and len(columns) < 12:
                columns.append(_column(case, answer))
    if pictures and columns:
        _sheet(columns, pictures)
    return scores.report()


def held_out_rooms(files: list[Path], weights: Weights, views: int, retinex: bool) -> Iterator[Iterator[Case]]:
    """Go through captures of generated rooms, with objects as each of them was drawn."""
    for path in files:
        capture = captures.load(path)
        yield cases(capture, weights, capture.given, views, retinex)


def product_captures(folders: list[Path], weights: Weights, given: bool, views: int, retinex: bool) -> Iterator[Iterator[Case]]:
    """Go through folders of the product's stage `capture` (results/<scene>/capture)."""
    from workflow.artifacts.store import StageReader

    for folder in folders:
        reader = StageReader(folder, "capture", folder.resolve().parent.name)
        yield cases(CaptureReader(reader), weights, given, views, retinex)


def table(report: dict[str, Any]) -> str:
    """Return a report as text."""
    kinds = [kind for kind in ("retinex", "network", "network, one answer") if kind in report]
    lines = [f"{'':22s}" + "".join(f"{kind:>22s}" for kind in kinds)]
    lines += [f"{label:22s}" + "".join(f"{report[kind][label]:22.4f}" for kind in kinds) for label in SHOWN]
    lines += [f"{name}: {json.dumps(report[name])}" for name in report if name not in kinds]
    return "\n".join(lines)


def _column(case: Case, answer: Hypotheses, edge: int = 128) -> np.ndarray:
    """One below another: photograph; albedo (scaled to the truth), roughness and metallic, each with its truth below."""
    counts, maps = case.masks["metallic"], answer.maps[0]
    mean = lambda a: np.maximum(a[counts].mean(0), 1e-4)  # noqa: E731
    scaled = maps[..., :3] * (mean(case.truth["albedo"]) / mean(maps[..., :3])) if counts.any() else maps[..., :3]
    encoded = [np.clip(a, 0, 1) ** (1 / 2.2) * counts[..., None] for a in (scaled, case.truth["albedo"])]
    grey = [np.repeat((a * counts)[..., None], 3, -1) for i in (1, 2) for a in (maps[..., 2 + i], case.truth[_ERRORS[i]])]
    return np.concatenate([image[:edge, :edge] for image in (case.photo, *encoded, *grey)], 0)


def _sheet(columns: list[np.ndarray], path: Path) -> None:
    from PIL import Image

    height = min(len(column) for column in columns)
    image = np.concatenate([column[:height] for column in columns], 1)
    Image.fromarray((255 * np.clip(image, 0, 1)).astype(np.uint8)).save(path)
