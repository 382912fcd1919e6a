"""Settings of relightings: pictures of the recovered scene under other light and from other positions."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator

from iif_core.errors import InputError
from workflow.settings.names import did_you_mean_path
from workflow.settings.section import Section


class RelightSphere(Section):
    """A black sphere that emits light, put into the room."""

    center: tuple[float, float, float]
    """Position in metres, world axes."""
    radius: float = Field(0.2, gt=0)
    """Radius in metres."""
    radiance: tuple[float, float, float] = (53.0, 50.0, 45.0)
    """R, G, B in the units of emitters.parquet."""
    path_to: tuple[float, float, float] | None = None
    """Position in the last frame; the sphere moves there in a straight line."""


class RelightCamera(Section):
    """A still camera, or a flight between views."""

    views: list[str] = Field(default_factory=list)
    """Names of the views to fly along, or of one view for a still camera; by default the first view."""
    frames: int = Field(1, ge=1, le=10000)
    """Number of pictures."""
    fov: float | None = Field(None, gt=1, lt=170)
    """Horizontal field of view in degrees; by default as photographed."""
    width: int | None = Field(None, ge=8, le=8192)
    """Width in pixels; by default that of the first view."""
    height: int | None = Field(None, ge=8, le=8192)
    """Height in pixels; by default that of the first view."""


class Relighting(Section):
    """One relighting of the recovered scene: `snakemake --cores 2 relight/<scene>` (docs/guide/relighting.md)."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")
    """Name of the folder of its pictures."""
    emitters: float = Field(1.0, ge=0)
    """Recovered emitters: `on`, `off`, or a factor on their radiance."""
    environment: Literal["keep", "off"] | tuple[float, float, float] | Path = "keep"
    """Light from outside: `keep`, `off`, a uniform radiance `[r, g, b]`, or a latitude-longitude EXR (top row = up)."""
    environment_turn: float = 0.0
    """Degrees by which the EXR is turned about the up axis."""
    sphere: RelightSphere | None = None
    """A lamp to add."""
    camera: RelightCamera = RelightCamera()
    """From where the pictures are taken."""
    exposure: float | None = Field(None, gt=0)
    """Factor on radiance before the camera response; by default chosen by the brightness of the first frame."""
    samples: int = Field(64, ge=1)
    """Paths per pixel."""
    max_bounces: int = Field(8, ge=1, le=64)
    """Longest path, in bounces."""
    denoise: bool = True
    """Denoise the pictures."""

    @field_validator("emitters", mode="before")
    @classmethod
    def _switch(cls, value: Any) -> Any:
        return {"on": 1.0, "off": 0.0}.get(value, value) if isinstance(value, str) else value

    @field_validator("environment", mode="before")
    @classmethod
    def _no_environment(cls, value: Any) -> Any:  # YAML reads a bare `off` as false
        return {False: "off", True: "keep"}[value] if isinstance(value, bool) else value


def require_relighting(document: dict[str, Any], scene: str) -> list[dict[str, Any]]:
    """Return the relightings of a dumped settings tree.

    Raises:
        InputError: there are none, or two have the same name.
    """
    wanted: list[dict[str, Any]] = document["relight"]
    if not wanted:
        raise InputError(
            f"config/scenes/{scene}.yaml: no relighting is configured. Add one, for example"
            " `relight: [{name: evening, emitters: off, sphere: {center: [2, 2, 1.5]}}]` (docs/guide/relighting.md)."
        )
    names = [entry["name"] for entry in wanted]
    if len(set(names)) < len(names):
        raise InputError(f"`relight`: found the names {', '.join(names)}; every relighting needs a name of its own")
    return wanted


def relight_files(document: dict[str, Any]) -> list[Path]:
    """Return the environment files that the relightings of a dumped settings tree name.

    Raises:
        InputError: one is missing, or is no EXR file.
    """
    named = [entry["environment"] for entry in document["relight"]]
    files = [Path(value) for value in named if isinstance(value, str) and value not in ("keep", "off")]
    for path in files:
        if path.suffix.lower() != ".exr" or not path.is_file():
            raise InputError(
                f"`relight.environment`: found {str(path)!r}, which is no EXR file here; allowed: keep, off, [r, g, b] or the"
                f" path of a latitude-longitude EXR.{did_you_mean_path(path)}"
            )
    return files
