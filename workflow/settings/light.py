"""Settings of the emitters and of the light that they cast."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from iif_core.light.emission.sgd import SgdOptions
from workflow.settings.section import ON_OFF, Section, word_or_count, word_or_positive

_SGD = SgdOptions()
PUBLISHED = ("published", "published_repaired")
"""Solvers that are the published method from the photographs on."""
NOISE_OF_OBJECTS, NOISE_OF_TEXTURES = 0.2, 0.1
"""Noise of the diffuse light where numbers of objects are fitted to it, and where surface cells get materials of their own."""
_SHARED_PATHS_ALONE = ("samples", "levels", "cell_edge", "noise", "max_samples", "max_bounces", "indirect")
_OURS_ALONE = ("min_observations", "cache_edge", "max_bounces", "pixels", "rows", "prune", "environment")


class Emission(Section):
    """Which faces of the mesh emit light, and how bright they are."""

    IDLE: ClassVar = {
        "solver": {
            "direct": ("solver: sgd", ("preset", "iterations")),
            **{name: ("solver: direct` or `sgd", (*_OURS_ALONE, "preset")) for name in PUBLISHED},
        }
    }

    saturation: float = Field(0.99, gt=0, le=1)
    """Sensor value from which a pixel counts as saturated."""
    min_observations: int = Field(8, ge=1)
    """Pixels that must show a face (or a group of faces) before it can be an emitter."""
    cache_edge: float = Field(0.06, gt=0)
    """Edge of a radiance-cache voxel in metres."""
    max_bounces: int = Field(6, ge=1, le=64)
    """Longest path, in bounces, where the radiance cache holds no value."""
    pixels: int = Field(4_000_000, ge=1000)
    """Pixels of all photographs together that the stage looks at. Where there are more, a random choice of each photograph
    stands for it, and `min_observations` counts pixels of that choice."""
    rows: int = Field(40000, ge=100)
    """Number of pixels whose light transport is traced."""
    samples: int = Field(16, ge=2)
    """Paths per pixel, over two independent halves."""
    prune: float = Field(0.01, ge=0, lt=1)
    """Emitters of objects that give less than this share of the photographed light are dropped, unless it is missed."""
    environment: Annotated[Literal["auto", "on", "off"], ON_OFF] = "auto"
    """Light from outside the mesh: 42 directions, what is seen apart, or twelve where the mesh is open. `auto`: included when
    enough rays leave the mesh and what they meet is not black."""
    solver: Literal["direct", "sgd", "published", "published_repaired"] = "direct"
    """`direct`: non-negative least squares; `sgd`: the paper's gradient descent on the same pixels, for comparison. `published`:
    the paper's method; `published_repaired`: without its errors (lab/docs/published.md#emission)."""
    preset: Literal["safe", "paper"] = _SGD.preset
    """`sgd`: `paper`: the published step size and pruning; `safe`: steps scaled by the diagonal of the normal matrix, and the
    average of the last iterates."""
    iterations: int | None = Field(None, ge=1)
    """Steps. `sgd`: of 1024 pixels each, default 10,000; `published`: of 8192 pixels each, default one pass over all pixels."""


class Shading(Section):
    """Incident light that is cached for the fits: diffuse, and specular at several roughness levels."""

    IDLE: ClassVar = {
        "method": {"published": ("method: shared_paths", _SHARED_PATHS_ALONE)},
    }

    method: Literal["shared_paths", "published"] = "shared_paths"
    """`shared_paths`: all lobes from one set of paths, diffuse light once for every surface cell; `published`: as the paper has
    it, at every pixel 256 paths for diffuse light and 64 to 128 for each of 6 levels, of one bounce, and the denoiser
    (lab/docs/published.md#shading)."""

    pixels: Annotated[Literal["auto", "all"] | Annotated[int, Field(ge=100)], word_or_count("auto", "all", least=100)] = "auto"
    """Pixels of which specular light is traced, drawn evenly over the objects. `auto`: as many as the fit reads
    (`affines.pixels`), or `all` where it reads every pixel: for texture from the photographs, and for `model: fipt` and `iris`.
    Studies that compare models on the same light set `all`. A number must be at least `affines.pixels`."""
    samples: int = Field(32, ge=2)
    """Paths per pixel (specular), and paths per surface cell to begin with (diffuse), over both independent halves."""
    levels: int = Field(10, ge=3, le=32)
    """Number of roughness levels."""
    cell_edge: float = Field(0.03, gt=0)
    """Edge in metres of the surface cells for which diffuse light is cached, once for all views."""
    noise: Annotated[Literal["auto"] | Annotated[float, Field(gt=0)], word_or_positive("auto")] = "auto"
    """Relative standard error of diffuse light (median over an object) below which no more paths are added. `auto`: 0.2, or 0.1
    for texture from the photographs and for `model: fipt` and `iris`, in whose textures the noise of a cell would be seen.
    Studies that compare models on the same light set a number."""
    max_samples: int = Field(512, ge=2)
    """Largest number of paths per cell."""
    max_bounces: int = Field(6, ge=1, le=64)
    """Longest path, in bounces, where the radiance cache holds no value."""
    indirect: Literal["auto", "cache", "path"] = "auto"
    """Indirect light. `cache`: paths end at surface whose radiance was photographed; `path`: paths go on with the base
    materials; `auto`: `cache` if enough of the surface that secondary rays meet was photographed."""
