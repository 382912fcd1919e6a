"""Weights that stage `base_scores` reads where they are there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from workflow.models.lpips import VGG


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return the weights of VGG16; none if nobody fetched them."""
    return [VGG] if VGG.is_file() else []
