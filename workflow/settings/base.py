"""Settings of stage `base`; its defaults are those of `FusionOptions`."""

from __future__ import annotations

from pydantic import Field

from iif_core.fusion.options import FusionOptions
from workflow.settings.section import Section

_DEFAULT = FusionOptions()


class Base(Section):
    """Fusing the K predictions of all views into one 3D base texture."""

    predictions: int | None = Field(None, ge=1)
    """Use only the first so many predictions of each view; default: all."""
    cell_edge: float | None = Field(None, gt=0)
    """Edge of a surface cell in metres; default: `cell_footprints` pixel footprints."""
    cell_footprints: float = Field(0.4, gt=0)
    """Cell edge in median pixel footprints."""
    border_weight: float = Field(0.1, gt=0, le=1)
    """Weight of pixels next to another object: real predictions bleed across borders."""
    footprint_power: float = Field(0.0, ge=0, le=4)
    """Weight pixels by (median footprint / own footprint) to this power: prefers near and frontal views of a surface."""
    robust: bool = _DEFAULT.robust
    """Cells take an M-estimate instead of the mean, which resists outliers in few views and costs sharpness."""
    sweeps: int = Field(_DEFAULT.sweeps, ge=1, le=200)
    """Alternations."""
    ridge: float = Field(_DEFAULT.ridge, gt=0)
    """Strength of the ridge of the affine maps towards the identity, per pixel."""
    temperature: float = Field(_DEFAULT.temperature, ge=0)
    """Selection temperature of the first sweep, in units of a segment's median error."""
    anneal: float = Field(_DEFAULT.anneal, gt=0, lt=1)
    """Factor on the selection temperature per sweep."""
    final_temperature: float = Field(_DEFAULT.final_temperature, ge=0)
    """Temperature at which annealing stops; 0 = the single best prediction, more = near-ties are averaged."""
    seams: bool = _DEFAULT.seams
    """Close seams between parts of an object that no photograph shows together."""


class SecondLook(Section):
    """Predicting and fusing once more, under the light that was found (prior `learned` alone)."""

    enabled: bool = True
    """`false`: the fit starts from the first base texture, which saves a sixth of the CPU time from `prior` to `affines`
    (docs/method/priors.md#a-second-look)."""
