"""Masks by SAM 2 (Ravi et al. 2024) for segmentation `masks`, through transformers; users provide the weights.

transformers' own image processor and mask pipeline need torchvision, which the environment does not have; scaling and selection
(docs/method/objects.md#proposals) are therefore done here and in `iif_core.objects.mask_proposals`.
"""

from __future__ import annotations

import importlib.metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.objects.mask_clustering import flatten_masks
from iif_core.objects.mask_proposals import point_grid, suppress_overlaps, threshold_stability
from iif_core.objects.options import ProposalOptions
from workflow.models.checkpoint import (
    Checkpoint,
    Origin,
    find_checkpoint,
    read_json,
    require_accepted,
    require_device,
    require_packages,
    tensor_header,
    weights_in,
)
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.photograph import picture_for_model
from workflow.settings.options import options_of

ORIGIN = Origin(
    repository="facebook/sam2.1-hiera-large",
    licence="the Apache License 2.0",
    section="segmentation.sam2",
    index="config.json",
    layout="transformers' layout",
    page="docs/guide/segmentation.md",
)
PACKAGES = ("transformers", "safetensors", "torch")
KINDS = ("sam2", "sam2_video")
"""`model_type` of the published checkpoints; the one for video contains the one for pictures."""
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Colours of ImageNet's pictures, with which SAM 2 normalises its input."""
POINTS_AT_ONCE, MASKS_AT_ONCE = 64, 16

Row = tuple[int, int, int, str]
"""view_id, masks that pass the thresholds, masks of the view, reason for missing masks."""


def check(own: dict[str, Any]) -> Checkpoint:
    """Find and check the checkpoint that the settings section names.

    Raises:
        InputError: a package, the folder or one of its files is missing; another model or revision; licence not accepted.
    """
    require_packages("`segmentation: {kind: masks, sam2: {...}}`", PACKAGES)
    require_device(own["device"], ORIGIN)
    folder, revision = find_checkpoint(own["checkpoint"], own["revision"], ORIGIN)
    config = read_json(folder / "config.json", ORIGIN)
    if config.get("model_type") not in KINDS:
        raise InputError(
            f"{folder / 'config.json'}: `model_type` is {config.get('model_type')}, needed {' or '.join(KINDS)}: this is another"
            f" model. {ORIGIN.repository} and its smaller versions are meant"
        )
    weights = weights_in(folder, "model")
    tensor_header(weights)
    require_accepted(own["accept_license"], folder, ORIGIN)
    return Checkpoint(folder, revision, config, {"": weights}, (folder / "config.json", weights))


def raw_inputs(own: dict[str, Any]) -> list[Path]:
    """Check the checkpoint and list its files; raises InputError."""
    return list(check(own).files)


class Generator:
    """The loaded model, float32."""

    def __init__(self, own: SimpleNamespace):
        """Load the model of the settings section `own`, whose checkpoint is checked again."""
        from workflow.models.loading import load_network, named_device, quiet

        self.options, self.checkpoint = options_of(ProposalOptions, own), check(vars(own))
        self.device = named_device(own.device, ORIGIN)
        with quiet("transformers"):
            import torch
            from transformers import Sam2Model

            self.model = load_network(self.checkpoint, "", Sam2Model, dtype=torch.float32).to(self.device)
        self.side = self.model.config.prompt_encoder_config.image_size

    def labels(self, picture: np.ndarray) -> tuple[np.ndarray, int, str]:
        """Return the label map (H, W) int32, 0 = no mask, of a display-encoded picture (H, W, 3) in [0, 1].

        With it come the number of masks that pass the thresholds, and the reason for missing masks.
        """
        masks, score, lost = self.proposals(picture)
        kept = suppress_overlaps(masks, score, self.options.overlap)
        if not len(kept):
            wrong = f"{lost} answers are not finite" if lost else "no mask passed confidence and stability"
            return np.zeros(picture.shape[:2], np.int32), 0, wrong
        wrong = f"{lost} answers are not finite" if lost else ""
        return flatten_masks(list(masks[kept])), len(masks), wrong

    def proposals(self, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Return masks (n, H, W) bool that pass the thresholds, their confidence (n,), and the number of non-finite outputs."""
        import torch

        from workflow.models.loading import deterministic

        masks, scores, lost = [np.zeros((0, *picture.shape[:2]), bool)], [np.zeros(0, np.float32)], 0
        points = torch.from_numpy(point_grid(self.options.points_per_side) * self.side).to(self.device)
        try:
            with deterministic(self.device):
                embedding = self.model.get_image_embeddings(self._seen(picture))
                for some in points.split(POINTS_AT_ONCE):
                    answer = self.model(
                        image_embeddings=embedding,
                        input_points=some[None, :, None],
                        input_labels=torch.ones((1, len(some), 1), dtype=torch.int, device=self.device),
                    )
                    logits, score = answer.pred_masks[0].flatten(0, 1), answer.iou_scores[0].flatten()
                    finite = score.isfinite() & logits.isfinite().all(-1).all(-1)
                    lost += int((~finite).sum())
                    sure = finite & (score > self.options.confidence)
                    if not sure.any():
                        continue
                    for part, its in zip(logits[sure].split(MASKS_AT_ONCE), score[sure].split(MASKS_AT_ONCE), strict=True):
                        found, stable = self._masks(part, picture.shape[:2])
                        masks.append(found[stable])
                        scores.append(its.cpu().numpy()[stable])
        except torch.OutOfMemoryError:
            raise InputError(
                f"the GPU's memory does not hold SAM 2 with {POINTS_AT_ONCE} points at once: set"
                " `segmentation: {sam2: {device: cpu}}`, or use a smaller version of the model"
            ) from None
        return np.concatenate(masks), np.concatenate(scores), lost

    def _seen(self, picture: np.ndarray) -> Any:
        """Return (1, 3, side, side): resized to the model's square, low-pass filtered where it shrinks, normalised."""
        import torch

        planes = torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1), np.float32))[None]
        square = torch.nn.functional.interpolate(planes, (self.side,) * 2, mode="bilinear", antialias=True)
        mean, deviation = (torch.tensor(values)[:, None, None] for values in (MEAN, DEVIATION))
        return ((square - mean) / deviation).to(self.device)

    def _masks(self, logits: Any, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return masks (n, H, W) of logits (n, h, w), and which of them are stable and not empty."""
        import torch

        large = torch.nn.functional.interpolate(logits[None], shape, mode="bilinear")[0].cpu().numpy()
        masks = large > 0
        return masks, (threshold_stability(large) >= self.options.stability) & masks.any((1, 2))


def label_maps(job: Job, capture: CaptureReader) -> dict[str, np.ndarray]:
    """Make the label map (H, W) of every photograph that is not held out; writes masks/<view>.exr, masks.parquet, model.json.

    A job that was interrupted continues after the last finished view if settings, photographs, weights and code are unchanged.

    Raises:
        InputError: the checkpoint is unusable, or no view has any mask.
    """
    own, views = job.settings.segmentation.sam2, capture.used
    generator: Generator | None = None
    rows, labels = [], {}
    for done, view in enumerate(views):
        job.progress(done, len(views), "views cut into masks")
        kept = job.writer.part_kept(view.name)
        if kept is None:
            generator = generator or Generator(own)
            rows.append(_made(job, capture, view, generator))
        else:
            rows.append(tuple(kept["row"]))
        stored = job.writer.channels(f"masks/{view.name}.exr")["mask.id"]
        labels[view.name] = stored.astype(np.int32 if stored.max(initial=0) >= 2**16 else np.uint16)
    ids, proposals, masks, wrong = (list(column) for column in zip(*rows, strict=True))
    if not any(masks):
        raise InputError(
            f"SAM 2 found no mask in any of {len(views)} views ({wrong[0]}). Check the checkpoint, or take another `segmentation`"
        )
    if any(wrong):
        job.log.warning("%d of %d views have no masks, or lack some (see masks.parquet)", sum(map(bool, wrong)), len(views))
    job.writer.table(
        "masks.parquet",
        {
            "view_id": np.array(ids, np.int32),
            "proposals": np.array(proposals, np.int32),
            "masks": np.array(masks, np.int32),
            "reason": np.array(wrong, object),
        },
    )
    job.writer.json("model.json", _described(own))
    return labels


def _made(job: Job, capture: CaptureReader, view: View, generator: Generator) -> Row:
    labels, proposals, wrong = generator.labels(picture_for_model(view, capture, linear=False))
    name = f"masks/{view.name}.exr"
    job.writer.exr(name, {"mask.id": labels.astype(np.uint32)})
    row = view.view_id, proposals, len(np.unique(labels[labels > 0])), wrong
    job.writer.part_done(view.name, [name], {"row": row})
    return row


def _described(own: SimpleNamespace) -> dict[str, Any]:
    checkpoint = check(vars(own))
    return {
        "checkpoint": own.checkpoint,
        "published_as": ORIGIN.repository,
        "revision": checkpoint.revision,
        "licence": ORIGIN.licence,
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
    }
