"""Columns of the summary of a batch: states and scores of a scene."""

from __future__ import annotations

from typing import NamedTuple

from iif_core.evaluation.catalogue import METRICS
from workflow.report.verdict import AMBER, GREEN, RED, WORDS

VERDICTS = {
    WORDS[GREEN]: "no check of its report found a fault",
    WORDS[AMBER]: "usable with care: a check of its report is in doubt",
    WORDS[RED]: "not to be relied on for what its report names",
}


class Score(NamedTuple):
    """One column of scores: mean over the views of a row of metrics.parquet. `split`: of these photographs alone."""

    column: str
    title: str
    quantity: str
    metric: str
    protocol: str
    split: str = ""

    @property
    def digits(self) -> int:
        """Decimals of a number of the column."""
        return METRICS[self.metric].decimals


SCORES = (
    Score("rgb_psnr", "re-rendering PSNR", "rgb", "psnr", "raw", "train"),
    Score("rgb_psnr_held_out", "held-out PSNR", "rgb_held_out", "psnr", "raw"),
    Score("albedo_psnr", "albedo PSNR", "albedo", "psnr", "raw"),
    Score("albedo_psnr_scaled", "albedo PSNR, scaled", "albedo", "psnr", "scaled"),
    Score("roughness_l2", "roughness L2", "roughness", "l2", "raw"),
    Score("metallic_l2", "metallic L2", "metallic", "l2", "raw"),
    Score("emission_iou", "emission IoU", "emission", "iou", "raw"),
)
