"""Emitters, and the light that they cast."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from workflow.settings.section import Section


class Emission(Section):
    """Emitters: which faces, how bright."""

    saturation: float = Field(0.99, gt=0, le=1)
    """Sensor value at which a pixel counts as saturated."""
    min_observations: int = Field(8, ge=1)
    """Pixels that must have seen a face (or patch) before it can be an emitter."""
    cache_edge: float = Field(0.06, gt=0)
    """Edge of a radiance-cache voxel in metres."""
    max_bounces: int = Field(6, ge=1, le=64)
    """Path length where the cache does not answer."""
    rows: int = Field(40000, ge=100)
    """Pixels whose transport rows are traced."""
    samples: int = Field(16, ge=2)
    """Paths a row (two independent halves)."""
    prune: float = Field(0.01, ge=0, lt=1)
    """Groups below this share of the total power are dropped."""
    environment: Literal["auto", "on", "off"] = "auto"
    """Environment light (16 x 32 texels in groups; twelve directions where the mesh is open) for rays that escape;
    `auto`: when enough of them do."""
    solver: Literal["direct", "sgd"] = "direct"
    """`direct`: non-negative least squares; `sgd`: the paper's descent on the same rows, to compare with."""
    preset: Literal["safe", "paper"] = "safe"
    """`sgd`: `paper` = the published rate and pruning; `safe` = steps scaled by the diagonal, averaged."""
    iterations: int = Field(10000, ge=1)
    """`sgd`: batches of 1024 rows."""


class Shading(Section):
    """Cached incident shading: diffuse and split specular."""

    samples: int = Field(32, ge=2)
    """Paths a pixel (specular) and paths a cell to begin with (diffuse), over both halves."""
    levels: int = Field(10, ge=3, le=32)
    """Roughness levels."""
    cell_edge: float = Field(0.03, gt=0)
    """Diffuse light is cached once a piece of surface of this edge (metres), for all views."""
    noise: float = Field(0.1, gt=0)
    """Relative standard error of diffuse light (median of an object) at which no more paths are added."""
    max_samples: int = Field(512, ge=2)
    """Most paths a cell."""
    max_bounces: int = Field(6, ge=1, le=64)
    """Path length where the radiance cache does not answer."""
    indirect: Literal["auto", "cache", "path"] = "auto"
    """`cache`: paths end at surface whose radiance was photographed; `path`: always traced with the base materials; `auto`:
    `cache` where enough of what the surface sees was photographed."""
