"""Scores of the material maps of views against ground truth, for stage metrics and for studies."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from iif_core.evaluation import metrics
from iif_core.evaluation.catalogue import PROTOCOLS
from iif_core.evaluation.lpips import Weights
from iif_core.evaluation.metrics import Score
from iif_core.fusion.uncertainty import CALIBRATION, MIN_OBJECT_CELLS, NOMINAL_COVERAGES, coverage, gauge_free_error
from iif_core.reflectance.material import CHANNELS
from workflow.artifacts.store import StageReader, ids_from_disk
from workflow.models.lpips import lpips_weights
from workflow.scene.normal_form import CaptureReader, Truth, View

UNITS = {"value": "l2: squared; psnr: dB; coverage: share of cells"}


@dataclass
class ScoreRows:
    """Columns of a table of scores in order of arrival, and the scores that could not be computed."""

    columns: dict[str, list[Any]] = field(default_factory=lambda: defaultdict(list))
    missing: list[dict[str, str]] = field(default_factory=list)

    def add(self, variant: str, view: str, quantity: str, scores: list[Score]) -> None:
        """Add the scores of one quantity.

        Args:
            variant, view, quantity: values of the columns.
            scores: scores without a value go to `missing`.
        """
        for score in scores:
            facts = {"variant": variant, "view": view, "quantity": quantity, "metric": score.metric}
            facts["protocol"] = score.protocol
            if score.value is None:
                self.missing.append({**facts, "reason": score.reason})
                continue
            for name, value in facts.items():
                self.columns[name].append(value)
            self.columns["value"].append(score.value)

    def table(self, scene: str, variants: set[str] | None = None) -> dict[str, Any]:
        """Return the columns scene, view, quantity, metric, protocol, variant (unless some are chosen), value."""
        chosen = [i for i, v in enumerate(self.columns["variant"]) if variants is None or v in variants]
        names = ["view", "quantity", "metric", "protocol"] + ([] if variants else ["variant"])
        out: dict[str, Any] = {"scene": np.array([scene] * len(chosen), object)}
        out |= {name: np.array([self.columns[name][i] for i in chosen], object) for name in names}
        out["value"] = np.array([self.columns["value"][i] for i in chosen], np.float64)
        return out

    def means(self) -> dict[str, Any]:
        """Return variant -> quantity -> protocol -> metric -> {mean over views, number of views}."""
        sums: dict[tuple[str, ...], list[float]] = defaultdict(list)
        for i, value in enumerate(self.columns["value"]):
            sums[tuple(self.columns[c][i] for c in ("variant", "quantity", "protocol", "metric"))].append(value)
        means: dict[str, Any] = {}
        for (variant, quantity, protocol, metric), values in sorted(sums.items()):
            entry = {"mean": round(float(np.mean(values)), 6), "views": len(values)}
            means.setdefault(variant, {}).setdefault(quantity, {}).setdefault(protocol, {})[metric] = entry
        return means


@dataclass(frozen=True)
class MaterialTruth:
    """True material maps of a view, prepared for scoring."""

    truth: Truth
    targets: dict[str, metrics.Target]  # by quantity
    masks: dict[str, np.ndarray]  # quantity, or emission -> (H, W) bool
    object_id: np.ndarray  # (H, W) int32

    def scores(
        self,
        maps: dict[str, np.ndarray],
        quantity: str,
        only: Iterable[str] | None = None,
        perceptual: Container[str] = PROTOCOLS,
    ) -> list[Score]:
        """Score one quantity under every protocol.

        Args:
            maps: quantity -> predicted map.
            quantity: `albedo`, `roughness` or `metallic`.
            only: metrics; all of the quantity if None.
            perceptual: protocols under which FLIP and LPIPS are computed.

        Returns:
            Scores in the order of the protocols.
        """
        return self.targets[quantity].scores(maps[quantity], only, perceptual)


def scored_views(capture: CaptureReader, count: int | Literal["all"]) -> list[View]:
    """Choose `count` of the used and `count` of the held-out views, each spread evenly, in the order of the capture."""
    if count == "all":
        return list(capture.views)
    chosen: set[int] = set()
    for held_out in (False, True):
        group = [i for i, view in enumerate(capture.views) if (view.split == "test") == held_out]
        places = np.linspace(0, len(group) - 1, min(count, len(group))).round().astype(int)
        chosen.update(group[place] for place in places)
    return [capture.views[i] for i in sorted(chosen)]


def material_truth(
    capture: CaptureReader,
    segmentation: StageReader,
    view: View,
    networks: Mapping[str, Mapping[str, Weights]] | None = None,
) -> MaterialTruth:
    """Read targets, masks and objects of a view of a capture that has truth.

    Args:
        capture, segmentation: results of these stages.
        view: the view.
        networks: quantity -> networks of LPIPS that it is scored with.

    Returns:
        Truth of the view.
    """
    truth = capture.truth(view)
    _, face_id = capture.gbuffer(view)
    masks = metrics.material_masks(truth.valid, face_id >= 0, truth.emission, truth.roughness)
    object_id = ids_from_disk(segmentation.exr(f"maps/{view.name}.exr")["object.id"])
    maps = {"albedo": truth.albedo, "roughness": truth.roughness, "metallic": truth.metallic}
    targets = {
        quantity: metrics.Target(quantity, image, masks[quantity], object_id, networks=(networks or {}).get(quantity))
        for quantity, image in maps.items()
    }
    return MaterialTruth(truth, targets, masks, object_id)


def perceptual_networks(with_vgg: bool = False) -> dict[str, dict[str, np.ndarray]]:
    """Read the weights of LPIPS, and limit torch to one thread, because stages score several views in threads of their own."""
    import torch

    torch.set_num_threads(1)  # the last bits of a convolution depend on the number of threads
    weights = lpips_weights(with_vgg)
    return {name: {part: np.asarray(array, np.float32) for part, array in parts.items()} for name, parts in weights.items()}


_CHANNELS_OF = {"albedo": CHANNELS[:3], "roughness": CHANNELS[3:4], "metallic": CHANNELS[4:]}


def cell_truth(capture: CaptureReader, segmentation: StageReader, base: StageReader) -> dict[str, np.ndarray]:
    """Compute the mean truth of every cell: quantity -> (cells, channels) float64, NaN where no pixel of the cell counts."""
    n = len(base.table("cells.parquet")["cell_id"])
    sums = {quantity: np.zeros((n, 1 + len(names))) for quantity, names in _CHANNELS_OF.items()}
    for view in capture.views:
        file = f"maps/{view.name}.exr"
        if not base.has(file):
            continue
        cell = ids_from_disk(base.exr(file)["cell.id"])
        truth = material_truth(capture, segmentation, view)
        for quantity, summed in sums.items():
            mask = truth.masks[quantity] & (cell >= 0)
            target = truth.targets[quantity].truth[mask].reshape(np.count_nonzero(mask), -1)
            summed[:, 0] += np.bincount(cell[mask], minlength=n)
            for c in range(target.shape[1]):
                summed[:, 1 + c] += np.bincount(cell[mask], target[:, c], n)
    return {q: np.where(s[:, :1] > 0, s[:, 1:] / np.maximum(s[:, :1], 1), np.nan) for q, s in sums.items()}


def interval_scores(
    cells: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray], predictions: int
) -> Iterator[tuple[str, list[Score]]]:
    """Compute the share of the cells whose error lies within the interval that the base claims (Eq. E.11 to E.13).

    `cells` is the table base/cells.parquet, `truth` is from `cell_truth`, `predictions` is K. The columns `uncertainty_*` are
    standard deviations of the error under one affine per object over all views (protocol `oracle_affine`); protocol `raw` does
    without the affine. Objects of few cells are left out, because their affine follows the errors. `psnr_3d` is over cells, with
    one affine per object for all views.
    """
    for quantity, names in _CHANNELS_OF.items():
        labels = [f"coverage_{round(100 * level)}" for level in NOMINAL_COVERAGES]
        known = np.isfinite(truth[quantity]).all(1) & (cells["coverage"] > 0)
        of_object = np.bincount(cells["object_id"][known], minlength=int(cells["object_id"].max(initial=0)) + 1)
        known &= of_object[cells["object_id"]] >= MIN_OBJECT_CELLS
        if not known.any():
            yield quantity, [Score(name, "raw", None, "no cell counts") for name in labels]
            continue
        target = truth[quantity][known]
        value, claimed = (
            np.stack([cells[f"{prefix}{name}"][known] for name in names], 1).astype(np.float64) for prefix in ("", "uncertainty_")
        )
        errors = {"raw": value - target, "oracle_affine": gauge_free_error(value, target, cells["object_id"][known])}
        fitted = gauge_free_error(target, value, cells["object_id"][known])
        whole = Score("psnr_3d", "oracle_affine", float(-10 * np.log10(max(np.mean(fitted**2), 1e-10))))
        beta = float(CALIBRATION[quantity].beta(predictions))
        within = {protocol: coverage(error, claimed, beta) for protocol, error in errors.items()}
        shares = [Score(m, protocol, share) for protocol, found in within.items() for m, share in zip(labels, found, strict=True)]
        yield quantity, [whole, *shares]
